"""Trains the generator on stored clips, in two phases.

Phase 1 leaves temporal attention alone and takes all examples, those of poor materials for RGB and
normals only; phase 2 frees everything and takes the others. What a step sees is a function of seed
and step, so that a run which went on from a checkpoint ends like one that never stopped.

Source: Engelhardt et al. 2025, SViM3D, section 4.
"""

import contextlib
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor, nn

from stages.base import Context
from stages.errors import InputError
from stages.precision import products_in
from stages.settings.training import GeneratorTrainingConfig
from stages.training_batches import SeenClip, draw_seen
from svim3d.diffusion.clips import StoredClip
from svim3d.diffusion.conditioning import Conditioning, embed_picture
from svim3d.diffusion.groups import GROUPS
from svim3d.diffusion.model import MaterialDiffusion
from svim3d.diffusion.training import (
    Clips,
    Draws,
    MovingAverage,
    separate_frames,
    velocity_errors,
    weighted_loss,
)
from svim3d.io.clip_file import read_clip
from svim3d.optim import NamedAdam, Rate, cosine

ADAM_EPS = 1e-8
AVERAGE = "average."  # prefix of moving averages in a checkpoint


@dataclass
class _Fit:
    """All that a step changes."""

    model: MaterialDiffusion
    named: dict[str, nn.Parameter]
    adam: NamedAdam
    average: MovingAverage

    @classmethod
    def start(
        cls, model: MaterialDiffusion, config: GeneratorTrainingConfig, from_scratch: bool
    ) -> "_Fit":
        parts = {"unet": model.unet}
        if from_scratch:
            parts["image_encoder"] = model.image_encoder
        named = {f"{p}.{n}": v for p, net in parts.items() for n, v in net.named_parameters()}
        adam = NamedAdam(named, {name: Rate(config.rate_1, ADAM_EPS) for name in named})
        return cls(model, named, adam, MovingAverage(named.items(), config.decay))

    def state(self) -> dict[str, Tensor]:
        averages = {f"{AVERAGE}{name}": value for name, value in self.average.values.items()}
        return self.adam.state() | averages

    def load_state(self, tensors: dict[str, Tensor]) -> None:
        self.adam.load_state(tensors)
        for name, value in self.average.values.items():
            value.copy_(tensors[f"{AVERAGE}{name}"])

    def adopt_averages(self) -> None:
        """The moving averages become the model's weights."""
        self._put(self.average.values)

    @contextlib.contextmanager
    def averaged(self) -> Iterator[None]:
        """Within this context the model's weights are the moving averages."""
        kept = {name: p.detach().clone() for name, p in self.named.items()}
        self.adopt_averages()
        try:
            yield
        finally:
            self._put(kept)

    @torch.no_grad()
    def _put(self, values: dict[str, Tensor]) -> None:
        for name, parameter in self.named.items():
            parameter.copy_(values[name])


def train_generator(
    model: MaterialDiffusion,
    clip_files: Sequence[Path],
    config: GeneratorTrainingConfig,
    ctx: Context,
    *,
    from_scratch: bool,
    on_checkpoint: Callable[[int], None],
    on_sheet: Callable[[int], None],
    stop_after_s: float | None = None,
) -> int:
    """Train in place; ends with the moving averages as the model's weights.

    Args:
        model: whose UNet is trained.
        clip_files: as `precompute_latents` leaves them.
        config: settings.
        ctx: gives checkpoints and random numbers.
        from_scratch: the model began with random weights: frames shall not meet at first, and the
            image encoder learns with the UNet in phase 1.
        on_checkpoint: called with the steps done whenever a checkpoint was written, while the model
            holds the moving averages.
        on_sheet: the same, less often.
        stop_after_s: stop at the first step after this many seconds; the next call goes on.

    Returns:
        Steps done, in this and earlier calls.
    """
    clips = [read_clip(file) for file in clip_files]
    good = [clip for clip in clips if clip.has_good_materials]
    if not clips or (config.phase_2_steps and not good):
        raise InputError(
            f"wanted clips to train on, got {len(clips)}, {len(good)} of them with good materials"
        )
    if config.gradient_checkpointing:
        model.unet.enable_gradient_checkpointing()
    for part in model.parts.values():
        part.requires_grad_(False)
    fit = _Fit.start(model, config, from_scratch)
    saved = ctx.checkpoints.load()
    first = 0
    if saved is not None:
        first, tensors = saved
        fit.load_state(tensors)
    elif from_scratch:
        separate_frames(model.unet)
        fit.average = MovingAverage(fit.named.items(), config.decay)
    total = config.phase_1_steps + config.phase_2_steps
    started_s = sheet_s = time.monotonic()
    done = first
    for step in range(first, total):
        phase = 1 if step < config.phase_1_steps else 2
        _set_free(model, phase, from_scratch)
        batch = draw_clips(clips if phase == 1 else good, model, step, config, ctx)
        _step(fit, batch, step, phase, config, ctx)
        done = step + 1
        is_last = done == total or _is_over(started_s, stop_after_s)
        if is_last or ctx.checkpoints.due():
            ctx.checkpoints.save(done, fit.state())
            with fit.averaged():
                on_checkpoint(done)
                if is_last or time.monotonic() - sheet_s > config.sheet_every_s:
                    sheet_s = time.monotonic()
                    on_sheet(done)
        if is_last:
            break
    fit.adopt_averages()
    return done


def _is_over(started_s: float, stop_after_s: float | None) -> bool:
    return stop_after_s is not None and time.monotonic() - started_s > stop_after_s


def _set_free(model: MaterialDiffusion, phase: int, from_scratch: bool) -> None:
    """What learns in a phase."""
    model.unet.requires_grad_(True)
    if phase == 1:
        for parameter in model.unet.temporal_attention():
            parameter.requires_grad_(False)
    model.image_encoder.requires_grad_(from_scratch and phase == 1)


def draw_clips(
    clips: Sequence[StoredClip],
    model: MaterialDiffusion,
    step: int,
    config: GeneratorTrainingConfig,
    ctx: Context,
) -> Clips:
    """The batch of a step: objects, lights and reference views, a function of the seed alone."""
    seen = draw_seen(clips, config.batch, ctx.generator(f"clips {step}"))
    latents = torch.stack([one.latents for one in seen]) * model.spec.latent_scale
    return Clips(
        latents=latents.to(ctx.device),
        conditioning=Conditioning(
            token=torch.cat([_token(one, model, config, ctx) for one in seen]),
            latent=torch.stack([one.reference for one in seen]).to(ctx.device),
            camera=torch.stack([one.camera(model.spec) for one in seen]).to(ctx.device),
            picture=torch.stack([one.picture for one in seen]).to(ctx.device),
        ),
        has_good_materials=torch.tensor(
            [one.clip.has_good_materials for one in seen], device=ctx.device
        ),
    )


def _token(
    seen: SeenClip, model: MaterialDiffusion, config: GeneratorTrainingConfig, ctx: Context
) -> Float[Tensor, "1 1 d"]:
    """The embedding of the reference view: as stored, unless the image encoder learns."""
    if seen.clip.tokens is not None:
        return seen.clip.tokens[seen.light, seen.order[-1]].float().to(ctx.device)[None, None]
    with products_in(config.precision, ctx.device):
        return embed_picture(model.image_encoder, seen.picture[None].to(ctx.device)).float()


def _step(
    fit: _Fit, clips: Clips, step: int, phase: int, config: GeneratorTrainingConfig, ctx: Context
) -> None:
    """One optimiser step; a non-finite one is skipped and counted."""
    draws = Draws.of(
        clips.latents.shape,
        ctx.generator(f"noise {step}"),
        mean=config.noise_mean,
        spread=config.noise_spread,
        drop_share=config.drop_share,
    ).to(ctx.device)
    told = fit.model.expecting(clips.conditioning.dropped(draws.drop))
    left = replace(clips, latents=fit.model.residual(clips.latents, told), conditioning=told)
    with products_in(config.precision, ctx.device):
        errors = velocity_errors(fit.model.unet, left, draws)
    loss = weighted_loss(errors, clips.has_good_materials)
    terms = {"loss": float(loss.detach())}
    terms |= dict(zip(GROUPS, errors.detach().mean(0).tolist(), strict=True))
    if ctx.is_finite(step, {"loss": loss}):
        fit.adam.zero_grad()
        loss.backward()
        norm = nn.utils.clip_grad_norm_(fit.named.values(), config.clip)
        terms["gradient"] = float(norm)
        if ctx.is_finite(step, {"gradient": norm}):
            fit.adam.step(_rate(step, phase, config))
            fit.average.update(fit.named, step)
    ctx.report(step + 1, config.phase_1_steps + config.phase_2_steps, terms)


def _rate(step: int, phase: int, config: GeneratorTrainingConfig) -> float:
    """Share of `rate_1` at which a step is taken."""
    if phase == 1:
        return min(1.0, (step + 1) / config.warm_up)
    into = step - config.phase_1_steps
    share = cosine(into, config.phase_2_steps, config.warm_up, config.final_rate)
    return share * config.rate_2 / config.rate_1
