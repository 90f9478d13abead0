"""Noise levels and preconditioning, against diffusers' scheduler and by what defines them."""

import math

import pytest
import torch
from diffusers import EulerDiscreteScheduler

from svim3d.diffusion.karras import (
    c_in,
    c_noise,
    c_out,
    c_skip,
    denoised,
    draw_noise_levels,
    noise_levels,
    velocity,
)

SV3D = {"sigma_min": 0.002, "sigma_max": 700.0, "rho": 7.0}


def scheduler(steps: int) -> EulerDiscreteScheduler:
    made = EulerDiscreteScheduler(
        beta_start=0.00085,
        beta_end=0.012,
        beta_schedule="scaled_linear",
        prediction_type="v_prediction",
        use_karras_sigmas=True,
        timestep_type="continuous",
        timestep_spacing="leading",
        sigma_min=0.002,
        sigma_max=700.0,
    )
    made.set_timesteps(steps)
    return made


@pytest.mark.parametrize("steps", [2, 25, 50])
def test_levels_are_those_of_diffusers_scheduler(steps):
    ours, theirs = noise_levels(steps, **SV3D), scheduler(steps)
    # Theirs are float32: 700 is known to 3e-5, and rho 7 multiplies the error of the root by 7.
    assert torch.allclose(ours, theirs.sigmas.double(), rtol=2e-6, atol=0.0)
    told = c_noise(ours[:-1])
    assert torch.allclose(told, theirs.timesteps.double(), atol=1e-6)


def test_ends_of_the_levels():
    levels = noise_levels(50, **SV3D)
    assert len(levels) == 51
    assert levels[0] == pytest.approx(700.0, rel=1e-12)
    assert levels[49] == pytest.approx(0.002, rel=1e-12)
    assert levels[50] == 0.0
    assert (levels.diff() < 0.0).all()
    assert int((levels > 80.0).sum()) == 16
    told = c_noise(levels[:-1])
    assert (float(told[0]), float(told[-1])) == (
        pytest.approx(1.638, abs=5e-4),
        pytest.approx(-1.554, abs=5e-4),
    )


def test_one_step_begins_at_the_top():
    assert noise_levels(1, **SV3D).tolist() == [700.0, 0.0]


def test_no_steps_are_refused():
    with pytest.raises(ValueError, match="at least 1"):
        noise_levels(0, **SV3D)


def test_input_and_target_have_unit_variance():
    # For latents z and noise n of unit variance: var(c_in (z + s n)) = c_in^2 (1 + s^2), and
    # v = (n - s z) c_in likewise.
    sigma = torch.logspace(-3, 3, 31, dtype=torch.float64)
    assert torch.allclose(c_in(sigma) ** 2 * (1.0 + sigma**2), torch.ones_like(sigma))


def test_a_perfect_answer_denoises_perfectly():
    generator = torch.Generator().manual_seed(0)
    latent, noise = torch.randn(2, 7, 3, 4, generator=generator, dtype=torch.float64)
    sigma = torch.logspace(-2.5, 2.8, 7, dtype=torch.float64)
    noisy = latent + sigma.view(-1, 1, 1) * noise
    assert torch.allclose(denoised(noisy, velocity(latent, noise, sigma), sigma), latent)


def test_error_of_v_is_the_weighted_error_of_the_latent():
    generator = torch.Generator().manual_seed(0)
    latent, noise, answer = torch.randn(3, 7, 3, 4, generator=generator, dtype=torch.float64)
    sigma = torch.logspace(-2.5, 2.8, 7, dtype=torch.float64)
    noisy = latent + sigma.view(-1, 1, 1) * noise
    weight = (1.0 + sigma**2) / sigma**2
    ours = weight * ((denoised(noisy, answer, sigma) - latent) ** 2).sum((1, 2))
    theirs = ((answer - velocity(latent, noise, sigma)) ** 2).sum((1, 2))
    assert torch.allclose(ours, theirs, rtol=1e-9)


def test_preconditioning_is_edms_with_unit_data():
    # Karras et al., table 1, column "EDM", c_skip with sigma_data 1; c_out has the sign of v.
    sigma = torch.tensor([0.3, 2.0, 50.0], dtype=torch.float64)
    assert torch.allclose(c_skip(sigma), 1.0 / (sigma**2 + 1.0))
    assert torch.allclose(c_out(sigma) ** 2, sigma**2 / (1.0 + sigma**2))
    assert (c_out(sigma) < 0.0).all()
    assert c_noise(torch.tensor([math.e**4])).item() == pytest.approx(1.0)


def test_training_levels_are_log_normal():
    drawn = draw_noise_levels(20000, torch.Generator().manual_seed(0), mean=1.0, spread=1.6).log()
    # Standard errors: 1.6 / sqrt(20000) = 0.011 and 0.008; four of them.
    assert float(drawn.mean()) == pytest.approx(1.0, abs=0.045)
    assert float(drawn.std()) == pytest.approx(1.6, abs=0.032)
