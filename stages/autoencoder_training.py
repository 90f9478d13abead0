"""Trains the autoencoder on the pictures of rendered examples, all four groups alike."""

from collections.abc import Sequence
from pathlib import Path

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from stages.base import Context
from stages.errors import InputError
from stages.settings.training import AutoencoderTrainingConfig
from svim3d.diffusion.autoencoder import AutoencoderKL, encode
from svim3d.diffusion.groups import as_network_input
from svim3d.diffusion.training import autoencoder_loss
from svim3d.io.training_data import read_example
from svim3d.optim import NamedAdam, Rate, cosine

ADAM_EPS = 1e-8
WARM_UP_STEPS, FINAL_RATE = 100, 0.01
LOG_VARIANCE_BOUNDS = (-30.0, 20.0)  # those of diffusers' DiagonalGaussianDistribution
# Pictures whose latents tell the variance that the generator's latents are scaled to.
SCALE_PICTURES = 512


def train_autoencoder(
    autoencoder: AutoencoderKL,
    examples: Sequence[Path],
    config: AutoencoderTrainingConfig,
    ctx: Context,
) -> float:
    """Train in place; goes on from a checkpoint of an interrupted run.

    Returns:
        The factor that brings latents to unit variance.
    """
    pictures = load_pictures(examples[: config.objects])
    named = dict(autoencoder.named_parameters())
    adam = NamedAdam(named, {name: Rate(config.rate, ADAM_EPS) for name in named})
    saved = ctx.checkpoints.load()
    first = 0
    if saved is not None:
        first, tensors = saved
        adam.load_state(tensors)
    autoencoder.train()
    for step in range(first, config.steps):
        if ctx.checkpoints.due():
            ctx.checkpoints.save(step, adam.state())
        terms = _losses(autoencoder, _batch(pictures, step, config, ctx), step, config, ctx)
        if ctx.is_finite(step, terms):
            adam.zero_grad()
            torch.stack(list(terms.values())).sum().backward()
            if ctx.is_finite(step, adam.gradients()):
                adam.step(cosine(step, config.steps, WARM_UP_STEPS, FINAL_RATE))
        ctx.report(step + 1, config.steps, {n: float(t.detach()) for n, t in terms.items()})
    ctx.checkpoints.save(config.steps, adam.state())
    autoencoder.eval()
    return latent_scale(autoencoder, pictures, ctx)


def load_pictures(examples: Sequence[Path]) -> UInt8[Tensor, "n H W 3"]:
    """Every picture of the examples; RGB in the first light alone, so that no group prevails."""
    found = []
    for file in examples:
        example = read_example(file)
        found += [example.rgb[0], example.basecolor, example.orm, example.normal]
    if not found:
        raise InputError("wanted examples to train on, got none; make some: svim3d data render")
    return torch.cat(found)


def _batch(
    pictures: UInt8[Tensor, "n H W 3"], step: int, config: AutoencoderTrainingConfig, ctx: Context
) -> Float[Tensor, "b 3 H W"]:
    """The pictures of a step, a function of the seed alone."""
    generator = ctx.generator(f"batch {step}")
    chosen = torch.randint(len(pictures), (config.batch,), generator=generator)
    return as_network_input(pictures[chosen].float() / 255.0).to(ctx.device)


def _losses(
    autoencoder: AutoencoderKL,
    pictures: Float[Tensor, "b 3 H W"],
    step: int,
    config: AutoencoderTrainingConfig,
    ctx: Context,
) -> dict[str, Tensor]:
    autocast = torch.autocast(
        ctx.device.type, torch.bfloat16, enabled=config.precision == "bfloat16"
    )
    with autocast:
        mean, log_variance = autoencoder.encode(pictures).latent_dist.parameters.chunk(2, 1)
        mean, log_variance = mean.float(), log_variance.float().clamp(*LOG_VARIANCE_BOUNDS)
        noise = torch.randn(mean.shape, generator=ctx.generator(f"noise {step}")).to(ctx.device)
        answer = autoencoder.decode(mean + (0.5 * log_variance).exp() * noise).sample.float()
    return autoencoder_loss(
        answer,
        pictures,
        mean,
        log_variance,
        edge_weight=config.edge_weight,
        divergence_weight=config.divergence_weight,
    )


@torch.no_grad()
def latent_scale(
    autoencoder: AutoencoderKL, pictures: UInt8[Tensor, "n H W 3"], ctx: Context
) -> float:
    """One over the standard deviation of latents over all groups, channels and places."""
    chosen = torch.randint(len(pictures), (SCALE_PICTURES,), generator=ctx.generator("scale"))
    some = as_network_input(pictures[chosen].float() / 255.0).to(ctx.device)
    return float(1.0 / encode(autoencoder, some).std())
