import math

import pytest
import torch

from svim3d.color import luminance
from svim3d.numerics import normalize
from svim3d.synthesis.view_defects import (
    blurred,
    drifted,
    spread_outward,
    with_baked_light,
    with_moved_silhouette,
    with_tilted_normals,
)


def noise(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def disc(size, radius, centre=None):
    """Antialiased coverage of a disc."""
    place = torch.arange(size) + 0.5 - (size / 2 if centre is None else centre)
    distance = (place[:, None] ** 2 + place[None, :] ** 2).sqrt()
    return (radius - distance + 0.5).clamp(0.0, 1.0)[..., None]


def test_blur_has_the_deviation_asked_for():
    # The second moment of a blurred line, at 512 pixels where a nominal pixel is two.
    picture = torch.zeros(512, 512, 1)
    picture[:, 256] = 1.0
    full = torch.ones_like(picture)
    for px in (1.0, 2.5):
        line = blurred(picture, full, torch.full_like(full, px))[256, :, 0].double()
        offset = torch.arange(512.0).double() - 256
        deviation = float((line * offset**2).sum() / line.sum()) ** 0.5
        assert deviation == pytest.approx(2.0 * px, rel=0.02)


def test_blur_keeps_to_the_object_and_keeps_even_values():
    mask = disc(64, 20.0)
    even = 0.7 * torch.ones(64, 64, 3) * (mask > 0)
    soft = blurred(even, mask, torch.full_like(mask, 12.0))
    inside = mask[..., 0] > 0.01
    assert torch.allclose(soft[inside], torch.tensor(0.7), atol=1e-4)
    assert torch.equal(soft[mask[..., 0] == 0.0], even[mask[..., 0] == 0.0])


def test_blur_of_zero_at_a_pixel_leaves_that_pixel():
    picture, mask = noise(32, 32, 3), torch.ones(32, 32, 1)
    spread = torch.zeros(32, 32, 1)
    spread[16:] = 16.0
    soft = blurred(picture, mask, spread)
    assert torch.allclose(soft[:16], picture[:16], atol=1e-6)
    assert float(soft[20:].std()) < 0.5 * float(picture[20:].std())


def test_drift_is_exposure_of_linear_colour():
    colour = torch.rand(4, 4, 3)
    stops = torch.tensor([1.0, 0.0, -1.0]).expand(4, 4, 3)
    assert torch.allclose(drifted(colour, stops), colour * torch.tensor([2.0, 1.0, 0.5]))


def test_baked_light_brings_shading_in_and_keeps_mean_luminance():
    mask = torch.ones(32, 32, 1)
    basecolor = torch.tensor([0.4, 0.3, 0.2]).expand(32, 32, 3)
    shading = torch.linspace(0.5, 1.5, 32)[None, :, None]
    lit = 7.0 * basecolor * shading  # of another exposure
    baked = with_baked_light(basecolor, lit, mask, 0.5)
    assert torch.allclose(baked, basecolor * (0.5 + 0.5 * shading), atol=1e-5)
    assert float(luminance(baked).mean()) == pytest.approx(float(luminance(basecolor).mean()))
    assert torch.equal(with_baked_light(basecolor, lit, mask, 0.0), basecolor)


def test_baked_light_divides_radiance_by_coverage():
    basecolor = torch.full((8, 8, 3), 0.4)
    mask = torch.ones(8, 8, 1)
    mask[4:] = 0.25
    # Evenly lit: nothing changes, at silhouettes neither.
    assert torch.allclose(with_baked_light(basecolor, 2.0 * basecolor * mask, mask, 1.0), basecolor)


def test_tilt_is_bounded_and_reached_across_the_normal():
    normal = normalize(noise(200, 5, 3))
    normal[0] = 0.0
    field = normalize(noise(200, 5, 3, seed=1))
    tilted = with_tilted_normals(normal, field, 30.0)
    assert torch.equal(tilted[0], normal[0])
    length = torch.linalg.vector_norm(tilted[1:], dim=-1)
    assert torch.allclose(length, torch.ones_like(length), atol=1e-6)
    angle = (tilted * normal)[1:].sum(-1).clamp(-1.0, 1.0).acos()
    assert math.degrees(float(angle.max())) <= 30.0 + 0.1
    across = torch.tensor([[[1.0, 0.0, 0.0]]])
    up = with_tilted_normals(torch.tensor([[[0.0, 1.0, 0.0]]]), across, 30.0)
    assert math.degrees(math.atan2(float(up[0, 0, 0]), float(up[0, 0, 1]))) == pytest.approx(30.0)


@pytest.mark.parametrize("outward", [-6.0, -2.5, -0.5, 0.5, 2.5, 6.0])
def test_a_disc_grows_and_shrinks_by_what_was_asked(outward):
    mask = disc(256, 40.0)
    moved = with_moved_silhouette(mask, torch.full_like(mask, outward))
    radius = (float(moved.sum()) / math.pi) ** 0.5
    assert radius == pytest.approx(40.0 + outward, abs=0.3)
    assert float(moved.min()) >= 0.0
    assert float(moved.max()) <= 1.0


def test_silhouette_moves_by_the_same_share_of_a_smaller_picture():
    mask = disc(64, 10.0)
    moved = with_moved_silhouette(mask, torch.full_like(mask, 6.0))
    assert (float(moved.sum()) / math.pi) ** 0.5 == pytest.approx(11.5, abs=0.3)


def test_erosion_takes_thin_parts_and_dilation_closes_small_gaps():
    bar = torch.zeros(256, 256, 1)
    bar[:, 100:103] = 1.0
    eroded = with_moved_silhouette(bar, torch.full_like(bar, -3.0))
    assert float(eroded.max()) < 1e-4
    gap = 1.0 - bar
    assert float(with_moved_silhouette(gap, torch.full_like(gap, 3.0)).min()) > 1.0 - 1e-4
    thick = with_moved_silhouette(bar, torch.full_like(bar, 3.0))
    assert float(thick[128].sum()) == pytest.approx(9.0, abs=0.5)
    assert torch.allclose(thick[20:-20], thick[128].expand(216, -1, -1), atol=0.02)


def test_silhouette_that_moves_by_nothing_is_the_same():
    mask = disc(64, 20.0)
    assert torch.allclose(with_moved_silhouette(mask, torch.zeros_like(mask)), mask, atol=1e-5)


def test_values_spread_from_the_nearest_covered_pixel():
    mask = torch.zeros(8, 8, 1)
    mask[:, 2], mask[:, 5] = 1.0, 0.5
    picture = torch.zeros(8, 8, 1)
    picture[:, 2], picture[:, 5] = 3.0, 7.0
    spread = spread_outward(picture, mask)
    assert spread[0, :, 0].tolist() == [3.0, 3.0, 3.0, 3.0, 7.0, 7.0, 7.0, 7.0]
    assert torch.equal(spread_outward(picture, torch.zeros_like(mask)), picture)
