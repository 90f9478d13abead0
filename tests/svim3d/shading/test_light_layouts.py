"""Layouts of light: directions land where the published conventions put them, energy is exact."""

import math

import pytest
import torch

from svim3d.numerics import normalize, reflect
from svim3d.shading.environment import (
    direction_from_latlong,
    latlong_from_octahedral,
    latlong_solid_angles,
    rotate_about_y,
    sample_latlong,
)
from svim3d.shading.light_layouts import (
    FACE_AXES,
    FACE_PLACES,
    VERTICAL_CROSS,
    automatic_size,
    cube_solid_angles,
    detected_layout,
    octahedral_light,
)
from svim3d.shading.octahedral import (
    DOUBLE,
    sample_octahedral,
    texel_directions,
    texel_solid_angles,
)

AXES = torch.tensor(
    [[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], dtype=torch.float64
)
GRIDS = list(FACE_PLACES)


def markers(d: torch.Tensor) -> torch.Tensor:
    """A lobe of its own colour about every axis, none of them alike."""
    lobes = torch.exp(8.0 * (d @ AXES.T - 1.0))
    colours = torch.tensor(
        [[1, 0, 0], [0, 1, 1], [0, 1, 0], [1, 0, 1], [0, 0, 1], [1, 1, 0]], dtype=torch.float64
    )
    return lobes @ colours


def smooth(d: torch.Tensor) -> torch.Tensor:
    x, y, z = d.unbind(-1)
    return torch.stack([1.5 + x, 1.2 + y * z, 2.0 + (2.0 * z).sin() * x], -1)


def centres(n: int) -> torch.Tensor:
    return (torch.arange(n, dtype=torch.float64) + 0.5) / n


def latlong_directions(height: int) -> torch.Tensor:
    v, u = torch.meshgrid(centres(height), centres(2 * height), indexing="ij")
    return direction_from_latlong(torch.stack([u, v], -1))


def cube_picture(radiance, n: int, grid: tuple[int, int]) -> torch.Tensor:
    picture = torch.zeros(grid[0] * n, grid[1] * n, 3, dtype=torch.float64)
    v, u = torch.meshgrid(2 * centres(n) - 1, 2 * centres(n) - 1, indexing="ij")
    for (row, column), axes in zip(FACE_PLACES[grid], FACE_AXES, strict=True):
        ahead, right, down = torch.tensor(axes, dtype=torch.float64)
        face = radiance(normalize(ahead + u[..., None] * right + v[..., None] * down))
        if grid == VERTICAL_CROSS and row == 3:
            face = face.flip((0, 1))
        picture[row * n : (row + 1) * n, column * n : (column + 1) * n] = face
    return picture


def debevec_direction(u: torch.Tensor, v: torch.Tensor) -> torch.Tensor:
    """Direction of points of the vertical cross, u in [0, 1] to the right, v in [0, 1] down.

    Source: Debevec, in Reinhard et al., "High Dynamic Range Imaging", 9.4.4, image to world.
    """
    one = torch.ones_like(u)
    faces = {
        (0, 1): ((u - 1 / 2) * 6, one, (v - 1 / 8) * -8),
        (1, 0): (-one, (v - 3 / 8) * -8, (u - 1 / 6) * -6),
        (1, 1): ((u - 1 / 2) * 6, (v - 3 / 8) * -8, -one),
        (1, 2): (one, (v - 3 / 8) * -8, (u - 5 / 6) * 6),
        (2, 1): ((u - 1 / 2) * 6, -one, (v - 5 / 8) * 8),
        (3, 1): ((u - 1 / 2) * 6, (v - 7 / 8) * 8, one),
    }
    d = torch.zeros(*u.shape, 3, dtype=u.dtype)
    for (row, column), values in faces.items():
        inside = ((v * 4).floor() == row) & ((u * 3).floor() == column)
        d[inside] = torch.stack(values, -1)[inside]
    return normalize(d)


def energy(octahedral: torch.Tensor) -> torch.Tensor:
    omega = texel_solid_angles(octahedral.shape[0], DOUBLE)[..., None]
    return (octahedral.double() * omega).sum((0, 1))


def latlong_energy(picture: torch.Tensor) -> torch.Tensor:
    omega = latlong_solid_angles(*picture.shape[:2], DOUBLE)
    return (picture.double() * omega).sum((0, 1))


@pytest.mark.parametrize(
    ("height", "width", "expected"),
    [
        (64, 128, ("latlong", True)),
        (1, 2, ("latlong", True)),
        (64, 64, ("octahedral", True)),
        (1, 1, ("octahedral", True)),
        (48, 64, ("cube cross", True)),
        (64, 48, ("cube cross", True)),
        (8, 48, ("cube cross", True)),
        (48, 8, ("cube cross", True)),
        (9, 16, ("latlong", False)),
        (47, 64, ("latlong", False)),
    ],
)
def test_shape_tells_the_layout(height, width, expected):
    assert detected_layout(height, width) == expected


def test_automatic_size_keeps_the_number_of_texels():
    assert automatic_size(1, 2, "latlong") == 16
    assert [automatic_size(h, 2 * h, "latlong") for h in (64, 128, 256)] == [64, 128, 256]
    assert automatic_size(90, 180, "latlong") == 128
    assert automatic_size(256, 256, "octahedral") == 256
    assert automatic_size(3 * 64, 4 * 64, "cube cross") == 128  # 6 * 64^2 texels, half are paper
    assert automatic_size(4096, 8192, "latlong") == 512


@pytest.mark.parametrize("grid", GRIDS)
def test_cube_and_latlong_of_the_same_world_agree(grid):
    cube = octahedral_light(cube_picture(smooth, 32, grid), "cube cross", 32)
    latlong = octahedral_light(smooth(latlong_directions(64)), "latlong", 32)
    # Corner texels are four times as wide as those at the pole: a mean there is no point value.
    torch.testing.assert_close(cube, latlong, rtol=0, atol=0.015)
    torch.testing.assert_close(cube, smooth(texel_directions(32, DOUBLE)), rtol=0, atol=0.025)


@pytest.mark.parametrize("grid", GRIDS)
def test_every_axis_shows_its_own_marker(grid):
    light = octahedral_light(cube_picture(markers, 32, grid), "cube cross", 64)
    seen = sample_octahedral(light, AXES)
    torch.testing.assert_close(seen, markers(AXES), rtol=0, atol=0.05)


def test_vertical_cross_is_that_of_debevec():
    v, u = torch.meshgrid(centres(4 * 16), centres(3 * 16), indexing="ij")
    d = debevec_direction(u, v)
    lit = (d != 0).any(-1, keepdim=True)
    theirs = torch.where(lit, smooth(d), 0.0)
    torch.testing.assert_close(theirs, cube_picture(smooth, 16, VERTICAL_CROSS))


def test_horizontal_cross_reads_as_the_middle_of_a_panorama():
    # Along the horizon, cross and lat-long show front in the middle, right of it to the right.
    picture = torch.zeros(3 * 16, 4 * 16, 3, dtype=torch.float64)
    picture[16 + 8, 2 * 16 + 8] = 1.0  # middle of the face right of the front
    panorama = latlong_from_octahedral(octahedral_light(picture, "cube cross", 64), height=32)
    row, column = divmod(int(panorama.sum(-1).argmax()), 64)
    assert abs(row - 15.5) <= 2
    assert abs(column - 47.5) <= 2


def test_latlong_to_cross_to_octahedral_comes_back():
    latlong = smooth(latlong_directions(64))
    cross = cube_picture(lambda d: sample_latlong(latlong, d), 64, (3, 4))
    octahedral = octahedral_light(cross, "cube cross", 64)
    again = octahedral_light(octahedral, "octahedral", 32)
    direct = octahedral_light(latlong, "latlong", 32)
    torch.testing.assert_close(again, direct, rtol=0, atol=0.01)


def test_octahedral_picture_of_the_right_size_is_not_touched():
    picture = torch.rand(32, 32, 3, generator=torch.Generator().manual_seed(0))
    assert octahedral_light(picture, "octahedral", 32) is picture


def test_solid_angles_of_a_cube_face():
    omega = cube_solid_angles(8, DOUBLE)
    assert float(omega.sum()) == pytest.approx(2.0 * math.pi / 3.0, abs=1e-12)
    assert float(omega.max()) == float(omega[3, 3])


@pytest.mark.parametrize(("height", "width"), [(1, 2), (33, 65), (40, 250), (3, 1), (256, 512)])
@pytest.mark.parametrize("size", [16, 64])
def test_latlong_of_any_shape_keeps_energy_and_constants(height, width, size):
    generator = torch.Generator().manual_seed(height)
    picture = torch.rand(height, width, 3, generator=generator) ** 8
    found = energy(octahedral_light(picture, "latlong", size))
    torch.testing.assert_close(found, latlong_energy(picture), rtol=1e-6, atol=0)
    flat = octahedral_light(torch.full((height, width, 3), 3.0), "latlong", size)
    torch.testing.assert_close(flat, torch.full((size, size, 3), 3.0), rtol=1.1e-3, atol=0)


@pytest.mark.parametrize("place", [(0, 0), (0, 8), (16, 16), (20, 40), (31, 63)])
@pytest.mark.parametrize("size", [16, 128])
def test_latlong_lamp_of_one_texel_keeps_its_energy(place, size):
    picture = torch.zeros(32, 64, 3)
    picture[place] = 5e4
    found = energy(octahedral_light(picture, "latlong", size))
    torch.testing.assert_close(found, latlong_energy(picture), rtol=1e-6, atol=0)


@pytest.mark.parametrize("place", [(0, 0), (0, 31), (15, 16), (31, 31)])
@pytest.mark.parametrize("size", [16, 64])
def test_cube_and_octahedral_lamp_of_one_texel_keeps_its_energy(place, size):
    lamp = torch.zeros(32, 32, 3)
    lamp[place] = 5e4
    cross = torch.zeros(96, 128, 3)
    cross[32:64, 32:64] = lamp
    found = energy(octahedral_light(cross, "cube cross", size))[0]
    expected = 5e4 * cube_solid_angles(32, DOUBLE)[place]
    torch.testing.assert_close(found, expected, rtol=1e-6, atol=0)
    found = energy(octahedral_light(lamp, "octahedral", size))[0]
    torch.testing.assert_close(found, energy(lamp)[0], rtol=1e-6, atol=0)


@pytest.mark.parametrize("n", [1, 5, 30])
def test_octahedral_picture_of_any_side_keeps_constants(n):
    flat = octahedral_light(torch.full((n, n, 3), 3.0), "octahedral", 16)
    torch.testing.assert_close(flat, torch.full((16, 16, 3), 3.0), rtol=1.1e-3, atol=0)


@pytest.mark.parametrize("azimuth_deg", [0.0, 40.0, 130.0, 250.0])
@pytest.mark.parametrize("turn_deg", [0.0, 90.0, -90.0, 33.0])
def test_mirror_ball_shows_the_lamp_where_optics_says(azimuth_deg, turn_deg):
    # A camera on +z looks at a ball with x to the right and y up. The highlight of a lamp in
    # direction l lies where the normal is halfway between l and the camera: n ~ l + z.
    azimuth, elevation = math.radians(azimuth_deg), math.radians(20.0)
    lamp = torch.tensor(
        [
            math.cos(elevation) * math.sin(azimuth),
            math.sin(elevation),
            math.cos(elevation) * math.cos(azimuth),
        ],
        dtype=torch.float64,
    )
    picture = torch.exp(2e3 * (latlong_directions(128) @ lamp - 1.0))[..., None].repeat(1, 1, 3)
    light = rotate_about_y(octahedral_light(picture, "latlong", 128), turn_deg)
    turned = azimuth + math.radians(turn_deg)  # 0 on +z, 90 on +x
    seen = torch.tensor(
        [math.cos(elevation) * math.sin(turned), lamp[1], math.cos(elevation) * math.cos(turned)],
        dtype=torch.float64,
    )
    to_camera = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    axis = 2.0 * centres(128) - 1.0
    y, x = torch.meshgrid(-axis, axis, indexing="ij")
    inside = x * x + y * y < 1.0
    normal = torch.stack([x, y, (1.0 - x * x - y * y).clamp_min(0.0).sqrt()], -1)[inside]
    shown = sample_octahedral(light, reflect(to_camera.expand_as(normal), normal))[:, 0]
    brightest = normal[int(shown.argmax())]
    expected = normalize(seen + to_camera)
    # Half a texel of the map is 0.014 rad, half of it on the ball; a pixel of the ball 0.016.
    torch.testing.assert_close(brightest[:2], expected[:2], rtol=0, atol=0.025)


def test_unfit_pictures_and_sizes_are_refused():
    with pytest.raises(ValueError, match="power of two, got 48"):
        octahedral_light(torch.ones(8, 16, 3), "latlong", 48)
    with pytest.raises(ValueError, match="as high as wide, got 16 x 8"):
        octahedral_light(torch.ones(8, 16, 3), "octahedral")
    with pytest.raises(ValueError, match="4:3, 3:4, 6:1 or 1:6, got 16 x 8"):
        octahedral_light(torch.ones(8, 16, 3), "cube cross")
