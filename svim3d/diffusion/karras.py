"""Noise levels and preconditioning of the diffusion model.

Latents have unit variance, so EDM's sigma_data is 1. The network F sees `c_in * x` and the noise
level as `c_noise`, and answers with v; the denoised latent is `c_skip * x + c_out * F`.

Source: Karras et al. 2022, "Elucidating the Design Space of Diffusion-Based Generative Models",
table 1, with the v scaling of Salimans and Ho 2022.
"""

import torch
from jaxtyping import Float
from torch import Tensor


def noise_levels(
    steps: int, *, sigma_min: float, sigma_max: float, rho: float
) -> Float[Tensor, "steps_and_one"]:
    """Descending noise levels, the last of them 0; float64. Source: eq. 5.

    Raises:
        ValueError: fewer than one step.
    """
    if steps < 1:
        raise ValueError(f"wanted at least 1 sampling step, got {steps}")
    if steps == 1:
        return torch.tensor([sigma_max, 0.0], dtype=torch.float64)
    ramp = torch.linspace(0.0, 1.0, steps, dtype=torch.float64)
    top, bottom = sigma_max ** (1.0 / rho), sigma_min ** (1.0 / rho)
    sigmas = (top + ramp * (bottom - top)) ** rho
    return torch.cat([sigmas, sigmas.new_zeros(1)])


def c_skip(sigma: Float[Tensor, "*b"]) -> Float[Tensor, "*b"]:
    """Share of the noisy latent in the denoised one."""
    return 1.0 / (sigma**2 + 1.0)


def c_out(sigma: Float[Tensor, "*b"]) -> Float[Tensor, "*b"]:
    """Share of the network's answer in the denoised latent; negative, since v points to noise."""
    return -sigma / (sigma**2 + 1.0).sqrt()


def c_in(sigma: Float[Tensor, "*b"]) -> Float[Tensor, "*b"]:
    """Scale that brings a noisy latent to unit variance."""
    return 1.0 / (sigma**2 + 1.0).sqrt()


def c_noise(sigma: Float[Tensor, "*b"]) -> Float[Tensor, "*b"]:
    """The noise level as the network is told it."""
    return 0.25 * sigma.log()


def velocity(
    latent: Float[Tensor, "b *rest"], noise: Float[Tensor, "b *rest"], sigma: Float[Tensor, "b"]
) -> Float[Tensor, "b *rest"]:
    """What the network should answer: v = (noise - sigma * latent) / sqrt(1 + sigma^2).

    Its mean squared error equals EDM's denoising error weighted by (1 + sigma^2) / sigma^2, but
    never divides by a small sigma.
    """
    level = over_batch(sigma, latent)
    return (noise - level * latent) * c_in(level)


def denoised(
    noisy: Float[Tensor, "b *rest"], answer: Float[Tensor, "b *rest"], sigma: Float[Tensor, "b"]
) -> Float[Tensor, "b *rest"]:
    """The network's estimate of the clean latent. Source: eq. 7."""
    level = over_batch(sigma, noisy)
    return c_skip(level) * noisy + c_out(level) * answer


def draw_noise_levels(
    count: int, generator: torch.Generator, *, mean: float, spread: float
) -> Float[Tensor, "count"]:
    """Training noise levels: ln sigma is normal."""
    normal = torch.randn(count, generator=generator, device=generator.device)
    return (mean + spread * normal).exp()


def over_batch(values: Float[Tensor, "b"], like: Float[Tensor, "b *rest"]) -> Tensor:
    """One value per batch entry, shaped to be multiplied with `like`."""
    return values.view(-1, *[1] * (like.dim() - 1))
