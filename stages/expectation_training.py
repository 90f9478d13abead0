"""Trains the expectation: a regression of all views' latents on the reference view's.

It comes before the generator, which diffuses what it leaves open. Frames are told together, so a
step costs a hundredth of the generator's and batches can be large.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from stages.base import Context
from stages.errors import InputError
from stages.precision import products_in
from stages.settings.training import ExpectationTrainingConfig
from stages.training_batches import SeenClip, draw_seen
from svim3d.diffusion.autoencoder import decode
from svim3d.diffusion.clips import StoredClip
from svim3d.diffusion.expectation import Expectation
from svim3d.diffusion.groups import GROUPS
from svim3d.diffusion.model import MaterialDiffusion
from svim3d.diffusion.training import material_difference, weighted_loss
from svim3d.io.clip_file import read_clip
from svim3d.optim import NamedAdam, Rate, cosine

ADAM_EPS = 1e-8
FINAL_RATE = 0.01
SCALE_BATCHES = 32  # what the residual's scale is measured on
SHOWN = ("orm", "normal")  # groups that tell materials, and where the object is
DECODED = 16  # clips of a batch whose materials are looked at: decoding costs as much as the rest


def train_expectation(
    model: MaterialDiffusion,
    clip_files: Sequence[Path],
    config: ExpectationTrainingConfig,
    ctx: Context,
    stop_after_s: float | None = None,
) -> float | None:
    """Train in place; goes on from a checkpoint of an interrupted run.

    Args:
        model: whose expectation is trained.
        clip_files: as `precompute_latents` leaves them.
        config: settings.
        ctx: gives checkpoints and random numbers.
        stop_after_s: stop at the first step after this many seconds; the next call goes on.

    Returns:
        Root mean square of what it leaves open, the model's `residual_scale`; None if it was
        stopped.

    Raises:
        InputError: no clips.
    """
    expectation = model.expectation
    if expectation is None:
        raise ValueError("wanted a model with an expectation")
    clips = [read_clip(file) for file in clip_files]
    if not clips:
        raise InputError("wanted clips to train on, got none")
    expectation.train().requires_grad_(True)
    named = dict(expectation.named_parameters())
    adam = NamedAdam(named, {name: Rate(config.rate, ADAM_EPS) for name in named})
    saved = ctx.checkpoints.load()
    first = 0
    if saved is not None:
        first, tensors = saved
        adam.load_state(tensors)
    started_s = time.monotonic()
    for step in range(first, config.steps):
        is_over = stop_after_s is not None and time.monotonic() - started_s > stop_after_s
        if step > first and (is_over or ctx.checkpoints.due()):
            ctx.checkpoints.save(step, adam.state())
            if is_over:
                return None
        batch = _Batch.draw(model, clips, f"step {step}", config, ctx)
        answer = batch.answer(expectation, config)
        errors = batch.errors(answer)
        loss = weighted_loss(errors, batch.good)
        terms = dict(zip(GROUPS, errors.detach().mean(0).tolist(), strict=True))
        if config.material_weight:
            materials = batch.material_error(answer, model, ctx.generator(f"frames {step}"))
            loss = loss + config.material_weight * materials
            terms["materials"] = float(materials.detach())
        if ctx.is_finite(step, {"loss": loss}):
            adam.zero_grad()
            loss.backward()
            norm = nn.utils.clip_grad_norm_(named.values(), config.clip)
            if ctx.is_finite(step, {"gradient": norm}):
                adam.step(cosine(step, config.steps, config.warm_up, FINAL_RATE))
        ctx.report(step + 1, config.steps, {"loss": float(loss.detach())} | terms)
    if first < config.steps:
        ctx.checkpoints.save(config.steps, adam.state())
    expectation.eval().requires_grad_(False)
    return _left_open(model, expectation, clips, config, ctx)


@dataclass(frozen=True)
class _Batch:
    """Random clips in random lights, each seen from one of its frames.

    Attributes:
        reference: latent of the view that is seen; zero where it is withheld.
        picture: that view; likewise.
        camera: of each frame.
        latents: what is to be told, of unit variance.
        good: whose materials can be trusted.
    """

    reference: Float[Tensor, "b z h w"]
    picture: Float[Tensor, "b 3 t t"]
    camera: Float[Tensor, "b k 3"]
    latents: Float[Tensor, "b k c h w"]
    good: Bool[Tensor, "b"]

    @classmethod
    def draw(
        cls,
        model: MaterialDiffusion,
        clips: Sequence[StoredClip],
        name: str,
        config: ExpectationTrainingConfig,
        ctx: Context,
    ) -> "_Batch":
        """The batch of this name."""
        generator = ctx.generator(name)
        seen = draw_seen(clips, config.batch, generator)
        keep = (torch.rand(config.batch, generator=generator) >= config.drop_share).float()
        keep = keep.view(-1, 1, 1, 1).to(ctx.device)
        return cls(
            reference=_stacked(seen, "reference", ctx) * keep,
            picture=_stacked(seen, "picture", ctx) * keep,
            camera=torch.stack([one.camera(model.spec) for one in seen]).to(ctx.device),
            latents=_stacked(seen, "latents", ctx) * model.spec.latent_scale,
            good=torch.tensor([one.clip.has_good_materials for one in seen], device=ctx.device),
        )

    def answer(
        self, expectation: Expectation, config: ExpectationTrainingConfig
    ) -> Float[Tensor, "b k c h w"]:
        """What is expected of it."""
        with products_in(config.precision, self.latents.device):
            return expectation(self.reference, self.picture, self.camera).float()

    def errors(self, answer: Float[Tensor, "b k c h w"]) -> Float[Tensor, "b groups"]:
        """Mean squared errors."""
        squares = (answer - self.latents) ** 2
        return squares.unflatten(2, (len(GROUPS), -1)).mean((1, 3, 4, 5))

    def material_error(
        self,
        answer: Float[Tensor, "b k c h w"],
        model: MaterialDiffusion,
        generator: torch.Generator,
    ) -> Float[Tensor, ""]:
        """Of a random frame of clips that can be trusted, decoded; at most `DECODED` of them."""
        clips = self.good.nonzero()[:DECODED, 0]
        if not len(clips):
            return answer.new_zeros(())
        count = answer.shape[1]
        frames = torch.randint(count, (len(clips),), generator=generator).to(clips.device)
        told, true = (
            {name: self._decoded(side[clips, frames], name, model) for name in SHOWN}
            for side in (answer, self.latents)
        )
        difference = material_difference(told, true, model.spec.normal_length)
        return difference.mean()

    @staticmethod
    def _decoded(latents: Tensor, group: str, model: MaterialDiffusion) -> Tensor:
        chosen = latents.unflatten(1, (len(GROUPS), -1))[:, GROUPS.index(group)]
        return decode(model.autoencoder, chosen / model.spec.latent_scale, chunk=DECODED)


def _stacked(seen: Sequence[SeenClip], what: str, ctx: Context) -> Tensor:
    return torch.stack([getattr(one, what) for one in seen]).to(ctx.device)


@torch.no_grad()
def _left_open(
    model: MaterialDiffusion,
    expectation: Expectation,
    clips: Sequence[StoredClip],
    config: ExpectationTrainingConfig,
    ctx: Context,
) -> float:
    squares = []
    for number in range(SCALE_BATCHES):
        batch = _Batch.draw(model, clips, f"scale {number}", config, ctx)
        squares.append(batch.errors(batch.answer(expectation, config)).mean())
    return float(torch.stack(squares).mean().sqrt())
