import math

import pytest
import torch

from svim3d.cameras import orbit_cameras
from svim3d.mesh.marching import extract_surface
from svim3d.raster.zbuffer import BACKGROUND, rasterize, rasterize_scatter

SIZE = 16


def sphere(nodes: int = 17, radius: float = 0.4):
    axis = torch.linspace(-0.5, 0.5, nodes)
    grid = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1)
    return extract_surface(radius - grid.norm(dim=-1), 0.5)


def flat(points, z=0.0) -> torch.Tensor:
    """NDC points of a plane facing the camera."""
    return torch.tensor([[x, y, z, 1.0] for x, y in points])


def test_a_fan_of_triangles_covers_every_pixel_centre_of_a_square_once():
    # The corners, the diagonals and the hub of the fan all lie on pixel centres of a 16 x 16 image.
    hub, half = (1 / 16, -1 / 16), 8 / 16
    ring = [
        (hub[0] + half * x, hub[1] + half * y)
        for x, y in [(-1, -1), (0, -1), (1, -1), (1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0)]
    ]
    clip = flat([hub, *ring])
    faces = torch.tensor([[0, 1 + k, 1 + (k + 1) % 8] for k in range(8)])
    count = torch.zeros(SIZE, SIZE)
    for face in faces:
        count += (rasterize(clip, face[None], SIZE, SIZE).triangle != BACKGROUND).float()
    whole = rasterize(clip, faces, SIZE, SIZE).triangle != BACKGROUND
    assert count.max() == 1.0
    assert torch.equal(count > 0, whole)
    assert int(count.sum()) == 64  # 8 x 8 pixels: of two opposite sides one owns its centres


def test_coverage_matches_half_plane_tests_at_pixel_centres():
    corners = [(-0.83, -0.61), (0.72, -0.34), (-0.11, 0.87)]
    covered = rasterize(flat(corners), torch.tensor([[0, 1, 2]]), SIZE, SIZE).triangle == 0
    for row in range(SIZE):
        for column in range(SIZE):
            x, y = (column + 0.5) * 2 / SIZE - 1, 1 - (row + 0.5) * 2 / SIZE
            inside = all(
                (bx - ax) * (y - ay) - (by - ay) * (x - ax) > 0
                for (ax, ay), (bx, by) in zip(corners, corners[1:] + corners[:1], strict=True)
            )
            assert bool(covered[row, column]) == inside


def test_the_nearer_face_wins_and_equal_depth_goes_to_the_first():
    square = [(-0.9, -0.9), (0.9, -0.9), (0.0, 0.9)]
    clip = torch.cat([flat(square, 0.5), flat(square, -0.25), flat(square, -0.25)])
    faces = torch.tensor([[0, 1, 2], [3, 4, 5], [6, 7, 8]])
    fragments = rasterize(clip, faces, SIZE, SIZE)
    hit = fragments.triangle != BACKGROUND
    assert torch.equal(fragments.triangle[hit].unique(), torch.tensor([1], dtype=torch.int32))
    assert torch.equal(fragments.depth[hit].unique(), torch.tensor([0.375]))
    assert bool(torch.isinf(fragments.depth[~hit]).all())


def test_depth_is_that_of_the_plane_equation():
    clip = torch.tensor([[-0.9, -0.8, 0.1, 1.0], [1.6, -1.2, 0.4, 2.0], [0.1, 1.2, -0.3, 1.5]])
    fragments = rasterize(clip, torch.tensor([[0, 1, 2]]), SIZE, SIZE)
    ndc = (clip[:, :3] / clip[:, 3:]).double()
    plane = torch.linalg.solve(
        torch.cat([ndc[:, :2], torch.ones(3, 1, dtype=torch.float64)], 1), ndc[:, 2:]
    )
    row, column = torch.nonzero(fragments.triangle == 0, as_tuple=True)
    assert len(row) > 20
    x, y = (column + 0.5) * 2 / SIZE - 1, 1 - (row + 0.5) * 2 / SIZE
    z = plane[0] * x + plane[1] * y + plane[2]
    assert torch.allclose(fragments.depth[row, column].double(), 0.5 * z + 0.5, atol=1e-7)


def test_faces_seen_from_behind_are_culled_or_shown():
    clip, face = flat([(-0.9, -0.9), (0.0, 0.9), (0.9, -0.9)]), torch.tensor([[0, 1, 2]])
    assert len(rasterize(clip, face, SIZE, SIZE).pixels) == 0
    shown = rasterize(clip, face, SIZE, SIZE, cull_backfaces=False)
    flipped = rasterize(clip, face.flip(1), SIZE, SIZE)
    assert torch.equal(shown.triangle, flipped.triangle)


def test_a_plane_that_reaches_behind_the_camera_ends_at_its_horizon():
    # A floor one unit below a camera that looks along it: visible in exactly the lower half.
    cameras = orbit_cameras([(0.0, 0.0)], radius=1.0, fov_y_deg=60.0, size=SIZE)
    floor = torch.tensor([[-90.0, -1, 90], [90, -1, 90], [90, -1, -90], [-90, -1, -90]])
    faces = torch.tensor([[0, 1, 2], [0, 2, 3]])
    covered = rasterize(cameras.project(floor)[0], faces, SIZE, SIZE).triangle != BACKGROUND
    rows = covered.sum(1)
    assert torch.equal(rows, torch.tensor([0] * 8 + [SIZE] * 8))


def test_what_lies_before_the_near_plane_or_behind_the_camera_is_not_seen():
    cameras = orbit_cameras([(0.0, 0.0)], radius=1.0, fov_y_deg=60.0, size=SIZE)
    for z in (0.97, 1.5):  # the camera stands at z = 1, its near plane 0.05 before it
        wall = torch.tensor([[-5.0, -5, z], [5, -5, z], [0, 5, z]])
        seen = rasterize(
            cameras.project(wall)[0], torch.tensor([[0, 1, 2]]), SIZE, SIZE, cull_backfaces=False
        )
        assert len(seen.pixels) == 0


def test_from_inside_a_closed_object_every_pixel_sees_a_back_face():
    vertices, faces = sphere()
    clip = orbit_cameras([(10.0, 20.0)], radius=0.1, fov_y_deg=90.0, size=SIZE).project(vertices)[0]
    assert len(rasterize(clip, faces, SIZE, SIZE).pixels) == 0
    both = rasterize(clip, faces, SIZE, SIZE, cull_backfaces=False)
    assert len(both.pixels) == SIZE * SIZE


def test_nan_and_degenerate_faces_are_left_out():
    clip = flat([(-0.9, -0.9), (0.9, -0.9), (0.0, 0.9), (math.nan, 0.0)])
    faces = torch.tensor([[0, 1, 3], [0, 0, 1], [0, 1, 2]])
    for draw in (rasterize, rasterize_scatter):
        triangle = draw(clip, faces, SIZE, SIZE).triangle
        assert triangle.unique().tolist() == [BACKGROUND, 2]


def test_no_faces_see_nothing():
    fragments = rasterize(torch.zeros(0, 4), torch.zeros(0, 3, dtype=torch.int32), 4, 6)
    assert fragments.triangle.shape == (4, 6)
    assert len(fragments.pixels) == 0


@pytest.mark.parametrize("radius", [2.0, 0.45, 0.3])
@pytest.mark.parametrize("cull", [True, False])
def test_the_torch_twin_makes_the_same_fragments_to_the_bit(radius: float, cull: bool):
    vertices, faces = sphere()
    cameras = orbit_cameras([(25.0, 40.0)], radius=radius, fov_y_deg=40.0, size=48)
    clip = cameras.project(vertices)[0]
    fast = rasterize(clip, faces, 40, 48, cull_backfaces=cull)
    plain = rasterize_scatter(clip, faces, 40, 48, cull_backfaces=cull)
    assert torch.equal(fast.triangle, plain.triangle)
    assert torch.equal(fast.depth, plain.depth)
