"""Views of surfaces whose colour is a function of the place: true views agree."""

import math

import pytest
import torch

from svim3d.cameras import Cameras, orbit_cameras
from svim3d.render.view_consistency import correspond, mesh_depth, view_consistency

SIZE, FOV_DEG, DISTANCE = 48, 40.0, 2.0


def side_by_side(*shifts: float) -> Cameras:
    """Cameras at z = 2 that look along -z, shifted to the right."""
    poses = torch.eye(4).repeat(len(shifts), 1, 1)
    poses[:, 2, 3] = DISTANCE
    poses[:, 0, 3] = torch.tensor(shifts)
    return Cameras(poses, FOV_DEG, SIZE, SIZE)


def wall(z: float, low: float, high: float):
    """A square wall across [low, high] in x, and wide in y."""
    corners = torch.tensor([[low, -9.0, z], [high, -9.0, z], [high, 9.0, z], [low, 9.0, z]])
    return corners, torch.tensor([[0, 1, 2], [0, 2, 3]])


def sphere(radius: float = 0.5, rings: int = 48):
    """A closed sphere of quads."""
    theta = torch.linspace(0, math.pi, rings + 1)[:, None]
    phi = torch.linspace(0, 2 * math.pi, 2 * rings + 1)[None]
    x, y, z = theta.sin() * phi.sin(), theta.cos() + 0 * phi, theta.sin() * phi.cos()
    vertices = radius * torch.stack([x, y, z], -1).reshape(-1, 3)
    index = torch.arange(len(vertices)).view(rings + 1, 2 * rings + 1)
    a, b, c, d = (
        i.reshape(-1) for i in (index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:])
    )
    return vertices, torch.cat([torch.stack([a, b, c], -1), torch.stack([a, c, d], -1)])


def positions(cameras: Cameras, depth: torch.Tensor) -> torch.Tensor:
    points = []
    for view in range(len(cameras)):
        origins, directions = cameras.rays(view)
        forward = -cameras.c2w[view, :3, 2]
        along = depth[view].reshape(-1, 1) / (directions @ forward)[:, None]
        points.append((origins + directions * along).view(SIZE, SIZE, 3))
    return torch.stack(points)


def test_depth_of_a_wall_is_its_distance():
    depth, mask = mesh_depth(*wall(0.25, -9.0, 9.0), side_by_side(0.0))
    assert bool(mask.all())
    torch.testing.assert_close(depth, torch.full_like(depth, DISTANCE - 0.25), atol=1e-4, rtol=0)
    _, mask = mesh_depth(*wall(0.0, 0.0, 9.0), side_by_side(0.0))
    assert mask[0, :, :, 0].float().mean() == pytest.approx(0.5)


def test_pixels_of_a_wall_move_by_the_parallax():
    cameras = side_by_side(0.0, 0.3)
    depth, mask = mesh_depth(*wall(0.0, -9.0, 9.0), cameras)
    found = correspond(depth, mask, cameras, 0, 1)
    shift = 0.3 * cameras.focal_px / DISTANCE
    column = (found.pixels % SIZE) + 0.5
    torch.testing.assert_close(found.column, column - shift, atol=1e-4, rtol=0, check_dtype=False)
    # All but the columns that leave the picture, and centres at its very border, are compared.
    expected = sum(0.5 <= c + 0.5 - shift <= SIZE - 0.5 for c in range(SIZE)) / SIZE
    assert len(found.pixels) / SIZE**2 == pytest.approx(expected, abs=2.5 / SIZE)


def test_what_the_other_view_cannot_see_is_not_compared():
    # A red strip in front of a blue wall hides different parts of it from each camera.
    cameras = side_by_side(-0.3, 0.3)
    wide, strip = wall(-0.5, -9.0, 9.0), wall(0.4, -0.1, 0.1)
    faces = torch.cat([wide[1], strip[1] + 4])
    depth, mask = mesh_depth(torch.cat([wide[0], strip[0]]), faces, cameras)
    red = (depth < DISTANCE).float()
    found = view_consistency(red, depth, mask, cameras)
    assert found.error == 0.0
    assert found.rmse == 0.0
    # Seen by one view alone: the strip's shadow on the wall, a strip of pixels beside it, and the
    # margins that leave the other picture.
    focal = cameras.focal_px
    margin = 0.6 * focal / (DISTANCE + 0.5)
    shadow = 0.2 * focal / (DISTANCE - 0.4)
    assert found.share == pytest.approx((SIZE - margin - shadow) / SIZE, abs=4.0 / SIZE)


def test_pixels_that_are_masked_out_are_not_compared():
    cameras = side_by_side(0.0, 0.3)
    depth, mask = mesh_depth(*wall(0.0, -9.0, 9.0), cameras)
    mask[1, :, : SIZE // 2] = False
    found = correspond(depth, mask, cameras, 0, 1)
    assert len(found.pixels)
    # All four pixels around the place are to be of the object.
    assert float(found.column.min()) >= SIZE // 2 + 0.5
    mask[1] = False
    assert not len(correspond(depth, mask, cameras, 0, 1).pixels)


def test_true_views_of_a_painted_sphere_agree():
    cameras = orbit_cameras(
        [(10.0, 24.0 * i) for i in range(15)], radius=2.0, fov_y_deg=FOV_DEG, size=SIZE
    )
    depth, mask = mesh_depth(*sphere(), cameras)
    images = 0.5 + positions(cameras, depth)
    found = view_consistency(images, depth, mask, cameras)
    # Colour is linear in the place, so that only the curvature between pixels is left.
    assert found.error < 2e-3
    assert 0.6 < found.share < 0.9
    assert found.pixels == pytest.approx(found.share * int(mask.sum()))


def test_views_that_differ_by_a_known_step_show_it():
    cameras = orbit_cameras(
        [(10.0, 22.5 * i) for i in range(16)], radius=2.0, fov_y_deg=FOV_DEG, size=SIZE
    )
    depth, mask = mesh_depth(*sphere(), cameras)
    images = torch.full((16, SIZE, SIZE, 3), 0.4)
    images[::2] += 0.1
    assert view_consistency(images, depth, mask, cameras).error == pytest.approx(0.1, abs=1e-6)
    assert view_consistency(images, depth, mask, cameras).rmse == pytest.approx(0.1, abs=1e-6)
    # Every second view is alike.
    assert view_consistency(images, depth, mask, cameras, step=2).error == pytest.approx(
        0, abs=1e-6
    )


def test_views_that_share_nothing_have_no_figure():
    cameras = orbit_cameras([(0.0, 0.0), (0.0, 180.0)], radius=2.0, fov_y_deg=FOV_DEG, size=SIZE)
    depth, mask = mesh_depth(*sphere(), cameras)
    found = view_consistency(torch.zeros(2, SIZE, SIZE, 1), depth, mask, cameras)
    assert math.isnan(found.error)
    assert (found.share, found.pixels) == (0.0, 0)
