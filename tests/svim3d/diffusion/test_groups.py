"""Views packed as training data packs them come out as they went in, at every coverage."""

import pytest
import torch

from svim3d.color import linear_from_srgb
from svim3d.diffusion.groups import BACKGROUND_COVERAGE, coverage, unpack
from svim3d.numerics import normalize

SIDE = 6


def packed(covered: float) -> tuple[dict[str, torch.Tensor], dict[str, torch.Tensor]]:
    """Straight values, and the four pictures of them at one coverage over white and black."""
    draw = torch.Generator().manual_seed(0)
    normal = normalize(
        torch.randn(1, SIDE, SIDE, 3, generator=draw) + torch.tensor([0.0, 0.0, 3.0])
    )
    straight = {
        "rgb": torch.rand(1, SIDE, SIDE, 3, generator=draw),
        "basecolor": torch.rand(1, SIDE, SIDE, 3, generator=draw),
        "orm": torch.rand(1, SIDE, SIDE, 3, generator=draw) * torch.tensor([0.0, 1.0, 1.0]),
        "normal": (normal + 1.0) / 2.0,
    }
    backgrounds = {"rgb": 1.0, "basecolor": 1.0, "orm": 0.0, "normal": 0.0}
    pictures = {
        name: 2.0 * (covered * value + (1.0 - covered) * backgrounds[name]).movedim(-1, 1) - 1.0
        for name, value in straight.items()
    }
    return straight | {"normal": normal}, pictures


@pytest.mark.parametrize("covered", [0.2, 0.5, 0.7, 0.89, 1.0])
def test_materials_come_back_at_every_coverage(covered):
    straight, pictures = packed(covered)
    views = unpack(pictures)
    # Rounding of float32 divided by the coverage.
    tolerance = {"atol": 1e-5 / covered, "rtol": 1e-4}
    torch.testing.assert_close(
        views.basecolor, linear_from_srgb(straight["basecolor"]), **tolerance
    )
    torch.testing.assert_close(views.rgb_linear, linear_from_srgb(straight["rgb"]), **tolerance)
    torch.testing.assert_close(views.roughness, straight["orm"][..., 1:2], **tolerance)
    torch.testing.assert_close(views.metallic, straight["orm"][..., 2:], **tolerance)
    torch.testing.assert_close(views.normal_camera, straight["normal"], atol=1e-3, rtol=0.0)


@pytest.mark.parametrize("covered", [0.05, 0.3, 0.8, 1.0])
@pytest.mark.parametrize("length", [1.0, 0.8])
def test_coverage_is_read_off_the_normals(covered, length):
    straight, _ = packed(1.0)
    pixels = covered * (length * straight["normal"] + 1.0) / 2.0
    found = coverage(pixels, length)
    torch.testing.assert_close(found, torch.full_like(found, covered), atol=1e-4, rtol=0.0)


def test_a_nearly_empty_pixel_is_empty():
    _, pictures = packed(BACKGROUND_COVERAGE / 2.0)
    views = unpack(pictures)
    for name, value in vars(views).items():
        assert float(value.abs().max()) == 0.0, name
