"""Trains the expectation: a regression of all views' latents on the reference view's.

It comes before the generator, which diffuses what it leaves open. Frames are told together, so a
step costs a hundredth of the generator's and batches can be large.
"""

import time
from collections.abc import Sequence
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from stages.base import Context
from stages.errors import InputError
from stages.precision import products_in
from stages.settings.training import ExpectationTrainingConfig
from stages.training_batches import SeenClip, draw_seen
from svim3d.diffusion.clips import StoredClip
from svim3d.diffusion.expectation import Expectation
from svim3d.diffusion.groups import GROUPS
from svim3d.diffusion.model import MaterialDiffusion
from svim3d.diffusion.training import weighted_loss
from svim3d.io.clip_file import read_clip
from svim3d.optim import NamedAdam, Rate, cosine

ADAM_EPS = 1e-8
FINAL_RATE = 0.01
SCALE_BATCHES = 32  # what the residual's scale is measured on


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
        errors, good = _errors(model, expectation, clips, f"step {step}", config, ctx)
        loss = weighted_loss(errors, good)
        terms = dict(zip(GROUPS, errors.detach().mean(0).tolist(), strict=True))
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


def _errors(
    model: MaterialDiffusion,
    expectation: Expectation,
    clips: Sequence[StoredClip],
    name: str,
    config: ExpectationTrainingConfig,
    ctx: Context,
) -> tuple[Float[Tensor, "b groups"], Bool[Tensor, "b"]]:
    """Mean squared errors of a random batch, and whose materials can be trusted."""
    generator = ctx.generator(name)
    seen = draw_seen(clips, config.batch, generator)
    keep = (torch.rand(config.batch, generator=generator) >= config.drop_share).float()
    latents = _stacked(seen, "latents", ctx) * model.spec.latent_scale
    keep = keep.view(-1, 1, 1, 1).to(ctx.device)
    reference = _stacked(seen, "reference", ctx) * keep
    picture = _stacked(seen, "picture", ctx) * keep
    camera = torch.stack([one.camera(model.spec) for one in seen]).to(ctx.device)
    with products_in(config.precision, ctx.device):
        answer = expectation(reference, picture, camera)
    squares = (answer.float() - latents) ** 2
    good = torch.tensor([one.clip.has_good_materials for one in seen], device=ctx.device)
    return squares.unflatten(2, (len(GROUPS), -1)).mean((1, 3, 4, 5)), good


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
    squares = [
        _errors(model, expectation, clips, f"scale {batch}", config, ctx)[0].mean()
        for batch in range(SCALE_BATCHES)
    ]
    return float(torch.stack(squares).mean().sqrt())
