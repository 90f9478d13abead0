"""A whole draw: against its plain twin, by seed, by cameras, with every option."""

from dataclasses import replace

import pytest
import torch
from tiny_diffusion import EXPECTING, FRAMES, SPEC, tiny_model

from svim3d.cameras import CameraPath
from svim3d.diffusion.guidance import GuidanceInterval, guide
from svim3d.diffusion.model import MaterialDiffusion, Sampling
from svim3d.diffusion.sampler import sample, seeded_noise

PATH = CameraPath.orbit(FRAMES, 10.0)


def a_picture() -> torch.Tensor:
    return torch.rand(16, 16, 3, generator=torch.Generator().manual_seed(0))


def plain_draw(model, told, seed, sampling) -> torch.Tensor:
    """Euler steps of the plain network, one call for each branch of guidance."""
    weights = model.guidance(told, sampling)

    def denoise(noisy, sigma):
        given = model.denoise(noisy, sigma, told)
        if not sampling.interval.holds(sigma):
            return given
        return guide(model.denoise(noisy, sigma, told.dropped(torch.ones(1))), given, weights)

    with torch.no_grad():
        noise = seeded_noise((1, FRAMES, 16, 8, 8), seed, device=model.device)
        return sample(denoise, noise, model.noise_levels(sampling))[0]


@pytest.mark.parametrize(
    "sampling",
    [
        Sampling(),
        Sampling(steps=3, guidance_by="azimuth", guidance_max=1.8),
        Sampling(steps=5, interval=GuidanceInterval(0.28, 5.42)),
    ],
)
@pytest.mark.parametrize("spec", [SPEC, EXPECTING], ids=["plain", "expecting"])
def test_drawing_is_its_plain_twin(sampling, spec):
    model = tiny_model(spec)
    told = model.condition(a_picture(), *PATH.tensors())
    drawn = model.draw(told, 3, sampling)
    slow = plain_draw(model, told, 3, sampling)
    # Latents are of about unit variance, and rounding adds up over the steps.
    assert torch.allclose(drawn, slow, atol=1e-4)


def test_same_seed_same_bytes_another_seed_another_orbit():
    model = tiny_model()
    told = model.condition(a_picture(), *PATH.tensors())
    first, again, other = (model.draw(told, seed, Sampling(steps=2)) for seed in (7, 7, 8))
    assert torch.equal(first, again)
    assert float((first - other).abs().mean()) > 0.1


def test_guidance_of_exactly_1_is_no_guidance():
    model = tiny_model()
    told = model.condition(a_picture(), *PATH.tensors())
    all_ones = Sampling(steps=2, guidance_max=1.0)
    nowhere = Sampling(steps=2, interval=GuidanceInterval(1e6, 1e7))
    assert torch.equal(model.draw(told, 0, all_ones), model.draw(told, 0, nowhere))


def test_the_conditioning_is_of_the_picture_and_the_cameras():
    model = tiny_model()
    told = model.condition(a_picture(), *PATH.tensors())
    assert told.token.shape == (1, 1, 16)
    assert told.latent.shape == (1, 4, 8, 8)
    assert told.camera.shape == (1, FRAMES, 3)
    # The posterior's mode, not scaled as the noisy latents are.
    pixels = 2.0 * a_picture().permute(2, 0, 1)[None] - 1.0
    mode = model.autoencoder.encode(pixels).latent_dist.mode()
    assert torch.allclose(told.latent, mode, atol=1e-5)


def test_a_bigger_picture_is_brought_to_the_models_size():
    model = tiny_model()
    told = model.condition(torch.full((50, 50, 3), 0.3), *PATH.tensors())
    small = model.condition(torch.full((16, 16, 3), 0.3), *PATH.tensors())
    assert torch.allclose(told.latent, small.latent, atol=1e-5)


def test_decoding_scales_groups_and_keeps_their_order():
    model = tiny_model()
    latents = torch.randn(FRAMES, 16, 8, 8, generator=torch.Generator().manual_seed(0))
    views = model.decode(latents)
    assert views.rgb_linear.shape == (FRAMES, 16, 16, 3)
    assert views.roughness.shape == (FRAMES, 16, 16, 1)
    # Another material latent, another roughness, but the same normals and mask.
    changed = latents.clone()
    changed[:, 8:12] += 1.0
    other = model.decode(changed)
    assert not torch.equal(other.roughness, views.roughness)
    assert torch.equal(other.normal_camera, views.normal_camera)
    assert torch.equal(other.rgb_linear, views.rgb_linear)
    # A model whose latents are twice as wide shows the same when they are scaled twice as much.
    wider = model.described(latent_scale=1.0)
    assert torch.equal(wider.decode(2.0 * latents).rgb_linear, views.rgb_linear)


def test_the_network_draws_what_the_expectation_leaves_open():
    """A denoiser of residuals at the residual's noise level, and back."""
    model = tiny_model(EXPECTING)
    told = model.condition(a_picture(), *PATH.tensors())
    noisy, sigma, scale = torch.randn(1, FRAMES, 16, 8, 8), 3.0, EXPECTING.residual_scale
    expected = model.expectation(told.latent, told.picture, told.camera)
    unscaled = MaterialDiffusion(SPEC, *list(model.parts.values())[:3])
    seeing = replace(told, expected=expected)
    shifted = expected + (noisy - expected) / scale
    residual = unscaled.denoise(shifted, sigma / scale, seeing) - expected
    wanted = expected + scale * residual
    torch.testing.assert_close(model.denoise(noisy, sigma, told), wanted, rtol=1e-4, atol=1e-4)


def test_a_withheld_reference_view_is_not_in_what_is_expected():
    model = tiny_model(EXPECTING)
    told = model.expecting(model.condition(a_picture(), *PATH.tensors()))
    other = model.expecting(model.condition(1.0 - a_picture(), *PATH.tensors()))
    assert not torch.equal(told.expected, other.expected)
    both = model.expecting(told.beside_unconditional())
    torch.testing.assert_close(both.expected[1:], told.expected)
    nothing = model.expecting(other.dropped(torch.ones(1)))
    torch.testing.assert_close(both.expected[:1], nothing.expected)


def test_half_precision_weights_keep_a_float32_state():
    model = tiny_model()
    told = model.condition(a_picture(), *PATH.tensors())
    full = model.draw(told, 0, Sampling(steps=3))
    model.unet.to(torch.bfloat16)
    half = model.draw(told, 0, Sampling(steps=3))
    assert half.dtype == torch.float32
    # bfloat16 keeps 8 bits; three network calls with weights that amplify.
    assert float((half - full).square().mean().sqrt() / full.std()) < 0.1


def test_weights_of_guidance_follow_the_cameras_of_any_path():
    model = tiny_model()
    path = CameraPath(((5.0, 180.0), (40.0, 90.0), (-10.0, 270.0), (0.0, 45.0), (10.0, 0.0)))
    told = model.condition(a_picture(), *path.tensors())
    weights = model.guidance(told, Sampling(guidance_by="azimuth"))
    expected = torch.tensor([2.5, 1.75, 1.75, 1.375, 1.0])
    assert torch.allclose(weights, expected, atol=1e-5)
    assert torch.isfinite(model.draw(told, 0, Sampling(steps=1, guidance_by="azimuth"))).all()
