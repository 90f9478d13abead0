"""Deterministic sampling: Euler steps along the probability flow, which are DDIM steps.

With x = x_t / sqrt(abar) and sigma = sqrt((1 - abar) / abar), DDIM with eta 0 and an Euler step of
dx / dsigma = (x - D) / sigma are the same update. Source: Karras et al. 2022, algorithm 1, with
S_churn 0 and no second-order correction; Song et al. 2021, eq. 12.
"""

from collections.abc import Callable
from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor

# From a noisy latent and its noise level to the clean latent that the model expects.
Denoiser = Callable[[Tensor, float], Tensor]


def sample(
    denoise: Denoiser,
    noise: Float[Tensor, "*shape"],
    sigmas: Float[Tensor, "steps_and_one"],
    report: Callable[[int, int], None] | None = None,
) -> Float[Tensor, "*shape"]:
    """Walk from noise to a latent.

    Args:
        denoise: the model, guidance included.
        noise: standard normal; the sampler's state keeps its dtype, which should be float32 or
            more whatever the network computes in.
        sigmas: descending noise levels, ending in 0.
        report: called after each step with steps done and steps in all.
    """
    levels = sigmas.tolist()
    # At the first level the latent is noise of this variance: that of signal and noise together.
    state = noise * (1.0 + levels[0] ** 2) ** 0.5
    for step, (sigma, following) in enumerate(pairwise(levels)):
        state = euler_step(state, denoise(state, sigma), sigma, following)
        if report is not None:
            report(step + 1, len(levels) - 1)
    return state


def euler_step(
    state: Float[Tensor, "*shape"],
    clean: Float[Tensor, "*shape"],
    sigma: float,
    following: float,
) -> Float[Tensor, "*shape"]:
    """One step to the next noise level: x' = D + (sigma' / sigma) (x - D)."""
    return clean + (following / sigma) * (state - clean)


def seeded_noise(
    shape: tuple[int, ...], seed: int, *, device: torch.device
) -> Float[Tensor, "..."]:
    """Standard normal noise, drawn on the CPU so that a seed means the same on every device."""
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(shape, generator=generator).to(device)
