"""The sampler where the truth is known: one step is DDIM's, Gaussian data has a closed form."""

from itertools import pairwise

import pytest
import torch

from svim3d.diffusion.karras import noise_levels
from svim3d.diffusion.sampler import euler_step, sample, seeded_noise

MEAN, SPREAD, SIGMA_MAX = 0.7, 0.6, 80.0


def gaussian_denoiser(noisy: torch.Tensor, sigma: float) -> torch.Tensor:
    """E[z | z + sigma n] for z normal with MEAN and SPREAD."""
    return MEAN + SPREAD**2 / (SPREAD**2 + sigma**2) * (noisy - MEAN)


def levels(steps: int) -> torch.Tensor:
    return noise_levels(steps, sigma_min=0.002, sigma_max=SIGMA_MAX, rho=7.0)


def landing(steps: int, noise: torch.Tensor) -> torch.Tensor:
    return sample(gaussian_denoiser, noise, levels(steps))


def flow_end(noise: torch.Tensor) -> torch.Tensor:
    """Where the probability flow carries the start: x - mean shrinks with sqrt(S^2 + sigma^2)."""
    start = noise * (1.0 + SIGMA_MAX**2) ** 0.5
    return MEAN + SPREAD / (SPREAD**2 + SIGMA_MAX**2) ** 0.5 * (start - MEAN)


def test_a_step_is_ddims():
    # x_t = sqrt(abar) x; Song et al. 2021, eq. 12 with eta 0.
    generator = torch.Generator().manual_seed(0)
    state, clean = torch.randn(2, 100, generator=generator, dtype=torch.float64)
    sigma, following = 3.7, 1.9
    abar, abar_next = 1.0 / (1.0 + sigma**2), 1.0 / (1.0 + following**2)
    x_t = abar**0.5 * state
    noise = (x_t - abar**0.5 * clean) / (1.0 - abar) ** 0.5
    ddim = abar_next**0.5 * clean + (1.0 - abar_next) ** 0.5 * noise
    assert torch.allclose(
        abar_next**0.5 * euler_step(state, clean, sigma, following), ddim, atol=1e-12
    )


def test_last_step_takes_the_clean_latent():
    state, clean = torch.tensor([5.0]), torch.tensor([2.0])
    assert euler_step(state, clean, 0.1, 0.0) == clean


def test_gaussian_data_is_reached_at_first_order():
    noise = torch.linspace(-3.0, 3.0, 101, dtype=torch.float64)
    steps = [50, 100, 200, 400]
    errors = [float((landing(n, noise) - flow_end(noise)).abs().max()) for n in steps]
    ratios = [coarse / fine for coarse, fine in pairwise(errors)]
    # Halving the steps' size halves Euler's error.
    assert all(ratio == pytest.approx(2.0, abs=0.12) for ratio in ratios)


def test_gaussian_data_keeps_its_law():
    noise = torch.randn(40000, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    drawn = landing(400, noise)
    # Standard error of the mean 0.6 / 200 = 0.003; Euler's own bias at 400 steps is below 0.005.
    assert torch.allclose(drawn.mean(0), torch.full((2,), MEAN, dtype=torch.float64), atol=0.015)
    covariance = torch.cov(drawn.T)
    expected = SPREAD**2 * torch.eye(2, dtype=torch.float64)
    assert torch.allclose(covariance, expected, atol=0.015)


def test_the_map_is_affine_for_any_number_of_steps():
    # Each Euler step on Gaussian data multiplies x - mean by one factor.
    noise = torch.tensor([-1.0, 0.0, 2.0], dtype=torch.float64)
    expected = MEAN * torch.ones(3, dtype=torch.float64)
    factor = 1.0
    sigmas = levels(7).tolist()
    for sigma, following in pairwise(sigmas):
        kept = SPREAD**2 / (SPREAD**2 + sigma**2)
        factor *= kept + following / sigma * (1.0 - kept)
    start = noise * (1.0 + SIGMA_MAX**2) ** 0.5
    assert torch.allclose(landing(7, noise), expected + factor * (start - MEAN), atol=1e-12)


def test_progress_is_reported_after_each_step():
    seen = []
    sample(gaussian_denoiser, torch.zeros(1), levels(3), lambda done, of: seen.append((done, of)))
    assert seen == [(1, 3), (2, 3), (3, 3)]


def test_noise_depends_on_the_seed_alone():
    cpu = torch.device("cpu")
    first, again = (seeded_noise((2, 3), 5, device=cpu) for _ in range(2))
    assert torch.equal(first, again)
    assert not torch.equal(first, seeded_noise((2, 3), 6, device=cpu))
