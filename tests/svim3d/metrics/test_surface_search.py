import numpy as np
import pytest
import torch

from svim3d.metrics import (
    distance_to_surface,
    occupancy,
    sample_surface,
    volume_iou,
)

CUBE_FACES = torch.tensor(
    [
        *([0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1]),
        *([2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]),
    ]
)


def cube(side: float = 1.0, centre: float = 0.0):
    corners = torch.cartesian_prod(*[torch.tensor([-0.5, 0.5])] * 3)
    return corners * side + centre, CUBE_FACES


def random_points(count: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(count, 3, generator=torch.Generator().manual_seed(seed))


def test_cube_winds_outward():
    vertices, faces = cube()
    normal = torch.linalg.cross(*[vertices[faces[:, i]] - vertices[faces[:, 0]] for i in (1, 2)])
    assert bool(((normal * vertices[faces].mean(1)).sum(1) > 0).all())


def test_samples_are_uniform_by_area():
    vertices = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [3, 0, 0]])
    faces = torch.tensor([[0, 1, 2], [1, 3, 2]])
    points = sample_surface(vertices, faces, 200_000, torch.Generator().manual_seed(0))
    # Centroid and second moment of the triangle (0,0), (3,0), (0,1).
    assert points.mean(0).tolist() == pytest.approx([1.0, 1 / 3, 0.0], abs=5e-3)
    assert float(points[:, 1].square().mean()) == pytest.approx(1 / 6, abs=2e-3)
    assert bool((points[:, 0] / 3 + points[:, 1] <= 1 + 1e-6).all())


def test_distance_to_a_cube_is_the_box_distance():
    vertices, faces = cube(0.8, 0.1)
    points = random_points(4000)
    q = (points - 0.1).abs() - 0.4
    outside = q.clamp_min(0).norm(dim=1) + q.amax(1).clamp_max(0)
    torch.testing.assert_close(
        distance_to_surface(points, vertices, faces), outside.abs(), rtol=1e-5, atol=1e-6
    )


@pytest.mark.parametrize("count", [1, 2, 3, 257])
def test_distance_to_a_soup_equals_brute_force(count):
    corners = random_points(3 * count, seed=1)
    corners[3:6] = corners[3:4]  # a triangle that is a point
    corners[-1] = corners[-2]  # and one that is a segment
    faces = torch.arange(3 * count).view(-1, 3)
    points = random_points(50, seed=2)
    weights = torch.cartesian_prod(*[torch.linspace(0, 1, 65, dtype=torch.float64)] * 2)
    weights = weights[weights.sum(1) <= 1]
    weights = torch.cat([weights, 1 - weights.sum(1, keepdim=True)], 1)
    dense = (weights @ corners.double()[faces]).reshape(-1, 3)
    nearest = torch.stack([(dense - p).norm(dim=1).min() for p in points.double()])
    exact = distance_to_surface(points.double(), corners.double(), faces)
    assert bool((exact <= nearest + 1e-12).all())
    # The dense samples stand at most 1/64 of an edge apart.
    torch.testing.assert_close(exact, nearest, rtol=0, atol=0.02)


def test_occupancy_of_a_lattice_cube_is_exact():
    grid = occupancy(*cube(), resolution=16, half_extent=1.0)
    inside = torch.zeros(16, 16, 16, dtype=torch.bool)
    inside[4:12, 4:12, 4:12] = True
    assert torch.equal(grid, inside)


def test_occupancy_keeps_axes_apart():
    vertices, faces = cube()
    grid = occupancy(
        vertices * torch.tensor([0.5, 1.0, 1.5]), faces, resolution=32, half_extent=1.0
    )
    assert grid.any(2).any(1).sum() == 8
    assert grid.any(2).any(0).sum() == 16
    assert grid.any(1).any(0).sum() == 24


def test_overlapping_parts_and_a_missing_face_stay_solid():
    (a, faces), (b, _) = cube(0.9), cube(0.9, 0.05)
    whole = occupancy(a, faces, resolution=24, half_extent=0.75)
    union = occupancy(
        torch.cat([a, b]), torch.cat([faces, faces + 8]), resolution=24, half_extent=0.75
    )
    assert torch.equal(union, whole | occupancy(b, faces, resolution=24, half_extent=0.75))
    assert torch.equal(occupancy(a, faces[1:], resolution=24, half_extent=0.75), whole)


def test_inward_shell_makes_a_cavity():
    (a, faces), (b, _) = cube(1.0), cube(0.5)
    grid = occupancy(
        torch.cat([a, b]), torch.cat([faces, faces.flip(1) + 8]), resolution=16, half_extent=0.5
    )
    assert grid.float().mean() == pytest.approx(1 - 0.125)


def test_iou_of_shifted_cubes():
    a = torch.zeros(8, 8, 8, dtype=torch.bool)
    b = a.clone()
    a[:4], b[2:6] = True, True
    assert volume_iou(a, b) == pytest.approx(2 / 6)
    assert volume_iou(a & False, b & False) == 1.0


def test_distances_do_not_depend_on_the_number_of_threads():
    import numba

    vertices, faces = cube()
    points = random_points(1000)
    many = distance_to_surface(points, vertices, faces)
    numba.set_num_threads(1)
    try:
        assert np.array_equal(distance_to_surface(points, vertices, faces), many)
    finally:
        numba.set_num_threads(numba.config.NUMBA_NUM_THREADS)
