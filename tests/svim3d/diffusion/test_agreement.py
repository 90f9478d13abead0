"""Choosing among samples: the middle one wins, confidence has a closed form."""

import math

import torch

from svim3d.diffusion import agreement
from svim3d.diffusion.groups import GeneratedViews


def drawn(metallic: float = 0.0, grey: float = 0.5, turn: float = 0.0, mask: float = 1.0):
    """Two flat views of 3 x 3 pixels."""
    flat = torch.ones(2, 3, 3, 1)
    normal = flat * torch.tensor([math.sin(turn), 0.0, math.cos(turn)])
    return GeneratedViews(
        rgb_linear=flat.expand(-1, -1, -1, 3),
        basecolor=flat.expand(-1, -1, -1, 3) * grey,
        roughness=flat * 0.5,
        metallic=flat * metallic,
        normal_camera=normal,
        mask=flat * mask,
    )


def test_equal_samples_are_trusted_wholly():
    best, confidence = agreement.choose([drawn(), drawn(), drawn()])
    assert best == 0
    assert bool((confidence == 1.0).all()) and confidence.shape == (2, 3, 3, 1)


def test_the_sample_in_the_middle_is_kept():
    assert agreement.choose([drawn(turn=0.0), drawn(turn=1.0), drawn(turn=0.4)])[0] == 2
    assert agreement.choose([drawn(grey=0.2), drawn(grey=0.9), drawn(grey=0.85)])[0] == 2


def test_confidence_is_the_exponential_of_the_mean_squared_spread():
    _, confidence = agreement.choose([drawn(mask=1.0), drawn(mask=0.5)])
    # Both lie 1/4 from the mean: of the mask, of normals times it, of encoded grey times it.
    encoded = 1.055 * 0.5 ** (1 / 2.4) - 0.055
    spread = (
        (0.25 / agreement.MASK_SCALE) ** 2
        + (0.25 / agreement.NORMAL_SCALE) ** 2
        + (0.25 * encoded / agreement.BASECOLOR_SCALE) ** 2
    )
    torch.testing.assert_close(confidence, torch.full_like(confidence, math.exp(-spread)))


def test_doubt_stays_where_samples_differ():
    one, two = drawn(), drawn()
    two.normal_camera[1, 2, 2] = torch.tensor([1.0, 0.0, 0.0])
    confidence = agreement.choose([one, two])[1]
    assert float(confidence[1, 2, 2]) < 0.1
    confidence[1, 2, 2] = 1.0
    assert bool((confidence == 1.0).all())
