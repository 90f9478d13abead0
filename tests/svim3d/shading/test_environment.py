import math

import pytest
import torch

from svim3d.numerics import normalize
from svim3d.shading.environment import (
    blurred_latlong,
    direction_from_latlong,
    downsample_latlong,
    latlong_from_direction,
    latlong_from_octahedral,
    latlong_solid_angles,
    octahedral_from_latlong,
    physical_radiance,
    rotate_about_y,
    sample_latlong,
)
from svim3d.shading.octahedral import (
    DOUBLE,
    sample_octahedral,
    texel_directions,
    texel_solid_angles,
)


def smooth_radiance(d: torch.Tensor) -> torch.Tensor:
    x, y, z = d.unbind(-1)
    return torch.stack([1.5 + x, 1.2 + y * z, 2.0 + (2.0 * z).sin() * x], -1)


def latlong_picture(height: int) -> torch.Tensor:
    v, u = torch.meshgrid(
        (torch.arange(height, dtype=torch.float64) + 0.5) / height,
        (torch.arange(2 * height, dtype=torch.float64) + 0.5) / (2 * height),
        indexing="ij",
    )
    return smooth_radiance(direction_from_latlong(torch.stack([u, v], -1)))


def test_convention_of_the_picture():
    d = torch.tensor([[0.0, 0, -1], [1, 0, 0], [0, 1, 0], [-1, 0, -1e-6]])
    uv = latlong_from_direction(d)
    torch.testing.assert_close(uv[:2], torch.tensor([[0.5, 0.5], [0.75, 0.5]]))
    assert float(uv[2, 1]) == 0.0  # +y is the top row
    assert float(uv[3, 0]) == pytest.approx(0.25)


def test_latlong_round_trip_of_directions():
    d = normalize(torch.randn(200, 3, dtype=torch.float64))
    torch.testing.assert_close(direction_from_latlong(latlong_from_direction(d)), d)


def test_latlong_lookup_is_continuous_at_the_date_line_and_the_pole():
    picture = torch.rand(8, 16, 3, dtype=torch.float64)
    west = torch.tensor([[-1e-9, 0.3, 1.0]], dtype=torch.float64)
    east = torch.tensor([[1e-9, 0.3, 1.0]], dtype=torch.float64)
    torch.testing.assert_close(
        sample_latlong(picture, normalize(west)), sample_latlong(picture, normalize(east))
    )
    pole = torch.tensor([[1e-9, 1.0, 0.0], [-1e-9, 1.0, 0.0]], dtype=torch.float64)
    one, other = sample_latlong(picture, pole)
    torch.testing.assert_close(one, other)


@pytest.mark.parametrize("height", [16, 64])
def test_round_trip_keeps_a_smooth_map(height):
    picture = latlong_picture(height)
    octahedral = octahedral_from_latlong(picture, 64)
    # Bilinear lookup and means over texels err by squares of sides; corner texels are wide.
    tolerance = (math.pi / height) ** 2 + 3.5 * (math.pi / 64) ** 2
    expected = smooth_radiance(texel_directions(64, DOUBLE))
    torch.testing.assert_close(octahedral, expected, rtol=0, atol=tolerance)
    back = latlong_from_octahedral(octahedral, height=height)
    torch.testing.assert_close(back, picture, rtol=0, atol=2 * tolerance)


@pytest.mark.parametrize("row", [0, 1, 20, 63])  # the first and last are slivers at the poles
def test_downward_resampling_keeps_the_energy_of_a_lamp_of_one_texel(row):
    picture = torch.zeros(64, 128, 3, dtype=torch.float64)
    picture[row, 37] = 1000.0
    energy = (picture * latlong_solid_angles(64, 128, picture)).sum()
    octahedral = octahedral_from_latlong(picture, 16)
    found = (octahedral * texel_solid_angles(16, DOUBLE)[..., None]).sum()
    assert float(found / energy) == pytest.approx(1.0, abs=1e-9)


def test_mirror_ball_orientation():
    # A lamp at +x: seen by a camera on +z (towards -z) it is right of the picture's centre.
    d = texel_directions(32, DOUBLE)
    lamp = (d[..., :1] > 0.95).double().expand(-1, -1, 3)
    picture = latlong_from_octahedral(lamp, height=32)
    row, column = divmod(int(picture.sum(-1).argmax()), 64)
    assert abs(row - 15.5) <= 4
    assert abs(column - 47.5) <= 4


def test_solid_angles_and_blocks():
    like = torch.zeros(1, dtype=torch.float64)
    omega = latlong_solid_angles(12, 24, like)
    assert float(omega.sum()) == pytest.approx(4 * math.pi, abs=1e-12)
    picture = torch.rand(12, 24, 3, dtype=torch.float64)
    small = downsample_latlong(picture, 4)
    energy = (small * latlong_solid_angles(3, 6, like)).sum((0, 1))
    torch.testing.assert_close(energy, (picture * omega).sum((0, 1)))
    with pytest.raises(ValueError, match="12 x 24 picture"):
        downsample_latlong(picture, 5)


def test_blur_keeps_a_constant_and_ignores_block_edges():
    flat = torch.full((32, 64, 3), 2.0, dtype=torch.float64)
    torch.testing.assert_close(blurred_latlong(flat, height=8), flat[::4, ::4])
    lamp = torch.zeros(64, 128, 3, dtype=torch.float64)
    beside = lamp.clone()
    lamp[31, 63], beside[32, 64] = 1.0, 1.0  # across the edge of a block of 4 x 4
    one, other = blurred_latlong(lamp, height=16), blurred_latlong(beside, height=16)
    # Two Gaussians 4 degrees apart, each of width 5.6 degrees, differ by 2 erf(0.25) = 0.55.
    difference = float((one - other).abs().sum() / one.sum())
    assert difference == pytest.approx(2.0 * math.erf(4.0 / (2**1.5 * 5.625)), abs=0.05)
    blocks = downsample_latlong(lamp, 4) - downsample_latlong(beside, 4)
    assert float(blocks.abs().sum() / downsample_latlong(lamp, 4).sum()) == pytest.approx(2.0)


def test_quarter_turn_is_exact_and_turns_counter_clockwise_from_above():
    lamp = torch.zeros(8, 8, 3)
    lamp[7, 3:5] = 1.0  # towards +z
    turned = rotate_about_y(lamp, 90.0)
    expected = torch.zeros(8, 8, 3)
    expected[3:5, 7] = 1.0  # towards +x
    torch.testing.assert_close(turned, expected, rtol=0, atol=1e-5)


def test_rotation_about_y_matches_rotated_lookup():
    values = smooth_radiance(texel_directions(128, DOUBLE))
    turned = rotate_about_y(values, 33.0)
    angle = math.radians(33.0)
    generator = torch.Generator().manual_seed(2)
    d = normalize(torch.randn(500, 3, dtype=torch.float64, generator=generator))
    x, y, z = d.unbind(-1)
    moved = torch.stack(
        [math.cos(angle) * x + math.sin(angle) * z, y, math.cos(angle) * z - math.sin(angle) * x],
        -1,
    )
    torch.testing.assert_close(
        sample_octahedral(turned, moved), sample_octahedral(values, d), rtol=0, atol=5e-3
    )


def test_unphysical_radiance_is_mended_and_counted():
    radiance = torch.ones(2, 2, 3)
    radiance[0, 0, 0], radiance[0, 1, 1], radiance[1, 0, 2] = -5.0, math.nan, math.inf
    radiance[1, 1] = 7.0
    mended, count = physical_radiance(radiance)
    assert count == 3
    assert float(mended[0, 0, 0]) == 0.0
    assert float(mended[0, 1, 1]) == 0.0
    assert float(mended[1, 0, 2]) == 7.0
    assert torch.equal(mended[1, 1], radiance[1, 1])
