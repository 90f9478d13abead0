"""Orbits of the generator, and the bounds that its autoencoder sets."""

import torch
from torch import Tensor

from benchmarks.generator_views import Case, Views
from svim3d.diffusion.autoencoder import encode
from svim3d.diffusion.groups import as_network_input
from svim3d.diffusion.model import MaterialDiffusion, Sampling
from svim3d.numerics import normalize

SEEDS_PER_RUN = 1_000_000  # so that no object of one run shares noise with one of another


def object_seed(seed: int, index: int) -> int:
    """Each object draws its own noise, whatever the limit."""
    return seed * SEEDS_PER_RUN + index


def generate(model: MaterialDiffusion, case: Case, seed: int, sampling: Sampling) -> Views:
    """One orbit, at the cameras of a case.

    Raises:
        ValueError: the model's answer is not finite: no figure could be made of it.
    """
    told = model.condition(case.picture, case.elevation_deg, case.azimuth_deg)
    latents = model.draw(told, seed, sampling)
    if not bool(latents.isfinite().all()):
        raise ValueError(f"wanted finite latents of {case.name}, got others; check the weights")
    return Views.of_generated(model.decode(latents, sampling, told))


@torch.no_grad()
def round_trip(model: MaterialDiffusion, truth: Views) -> Views:
    """The truth through the autoencoder: what no sampler can surpass."""
    pictures = truth.pictures()
    stacked = torch.cat([as_network_input(pictures[name]) for name in model.spec.groups])
    latents = encode(model.autoencoder, stacked.to(model.device)) * model.spec.latent_scale
    return Views.of_generated(model.decode(torch.cat(latents.chunk(len(model.spec.groups)), 1)))


def mean_of(samples: list[Views]) -> Views:
    """The mean of some orbits, straight values weighted by their coverage."""
    mask = _stack(samples, "mask")
    total = mask.sum(0).clamp(min=1e-6)
    straight = {
        name: (_stack(samples, name) * mask).sum(0) / total for name in ("roughness", "metallic")
    }
    return Views(
        rgb=_stack(samples, "rgb").mean(0),
        basecolor=_stack(samples, "basecolor").mean(0),
        normal=normalize((_stack(samples, "normal") * mask).sum(0)),
        mask=mask.mean(0),
        **straight,
    )


def spread_of(samples: list[Views]) -> dict[str, float]:
    """Standard deviation over orbits, RMS over the pixels that most of them cover.

    Of normals in degrees: the RMS distance of unit vectors from their mean.
    """
    covered = (_stack(samples, "mask").mean(0) > 0.5).expand_as(samples[0].mask)[:-1]
    spreads = {}
    for name in ("rgb", "basecolor", "roughness", "metallic", "normal"):
        variance = _stack(samples, name).var(0, correction=0)[:-1]
        over = variance.sum(-1) if name == "normal" else variance.mean(-1)
        spread = over[covered[..., 0]].mean().sqrt()
        spreads[name] = float(torch.rad2deg(spread) if name == "normal" else spread)
    return spreads


def _stack(samples: list[Views], name: str) -> Tensor:
    return torch.stack([getattr(views, name) for views in samples])
