"""The expectation: what it can tell of frames, and how a draw goes through it."""

import math

import pytest
import torch
from tiny_diffusion import FRAMES, GROUP_CHANNELS, SIDE, some_conditioning, stir

from svim3d.diffusion.conditioning import camera_numbers
from svim3d.diffusion.expectation import Expectation

PICTURE = torch.rand(1, 3, 2 * SIDE, 2 * SIDE, generator=torch.Generator().manual_seed(5))


def tiny_expectation(harmonics: int = 2) -> Expectation:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        made = Expectation(
            latent_channels=GROUP_CHANNELS,
            side=SIDE,
            picture_side=2 * SIDE,
            groups=4,
            width=16,
            layers=1,
            heads=2,
            harmonics=harmonics,
        )
    return made.eval().requires_grad_(False)


def stirred() -> Expectation:
    made = tiny_expectation()
    stir(made, torch.Generator().manual_seed(1))
    return made


def test_a_fresh_one_expects_nothing():
    told = some_conditioning()
    frames = tiny_expectation()(told.latent, PICTURE, told.camera)
    assert frames.shape == (1, FRAMES, 4 * GROUP_CHANNELS, SIDE, SIDE)
    assert not frames.any()


def test_frames_are_a_fourier_series_of_the_azimuth():
    """Frames at unseen azimuths follow from as many frames as the series has terms."""
    model, told = stirred(), some_conditioning()

    def level_orbit(azimuths: list[float]) -> torch.Tensor:
        azimuth = torch.tensor([azimuths])
        camera = camera_numbers(torch.full_like(azimuth, 20.0), azimuth, 1e-5)
        return model(told.latent, PICTURE, camera)[0].double()

    terms = [360.0 * step / 5 for step in (1, 2, 3, 4, 0)]  # 1, cos, sin, cos 2, sin 2
    known, asked = level_orbit(terms), level_orbit([33.0, 190.0, 0.0])
    for frame, azimuth in zip(asked[:2], (33.0, 190.0), strict=True):
        # Dirichlet's kernel of five even samples.
        gaps = [math.radians(azimuth - t) for t in terms]
        kernel = [(1 + 2 * math.cos(g) + 2 * math.cos(2 * g)) / 5 for g in gaps]
        wanted = sum(k * f for k, f in zip(kernel, known, strict=True))
        torch.testing.assert_close(frame, wanted, rtol=1e-4, atol=1e-4)


def test_climbing_from_the_reference_view_matters_and_standing_above_it_too():
    model, told = stirred(), some_conditioning()
    azimuth = torch.tensor([[90.0, 180.0, 0.0]])

    def seen(*elevation: float) -> torch.Tensor:
        camera = camera_numbers(torch.tensor([elevation]), azimuth, 1e-5)
        return model(told.latent, PICTURE, camera)

    level, climbing, above = seen(0.0, 0.0, 0.0), seen(30.0, 0.0, 0.0), seen(30.0, 30.0, 30.0)
    assert not torch.allclose(level[:, 0], climbing[:, 0], atol=1e-3)
    assert torch.equal(level[:, 1:], climbing[:, 1:])
    assert not torch.allclose(level[:, 1:], above[:, 1:], atol=1e-3)


def test_every_cell_of_the_reference_view_is_seen_by_every_cell():
    model, told = stirred(), some_conditioning()
    latent, picture = told.latent.clone(), PICTURE.clone()
    latent[..., 0, 0] += 1.0
    picture[..., 0, 0] += 1.0
    plain = model(told.latent, PICTURE, told.camera)
    for one, other in ((latent, PICTURE), (told.latent, picture)):
        moved = (model(one, other, told.camera) - plain).abs().amax((0, 1, 2))
        assert bool((moved > 0.0).all())


@pytest.mark.parametrize("side", [SIDE // 2, SIDE * 2])
def test_latents_of_another_side_are_refused(side):
    told = some_conditioning()
    with pytest.raises(RuntimeError):
        stirred()(torch.zeros(1, GROUP_CHANNELS, side, side), PICTURE, told.camera)
