import math

import pytest
import torch

from svim3d.metrics import distance_to_surface
from svim3d.metrics.surface_agreement import compare_surfaces, f_score, squared_chamfer
from svim3d.metrics.surface_search import nearest_face, sample_faces


def square(height: float, *, side: float = 1.0, flip: bool = False):
    """A horizontal square of two triangles."""
    corners = torch.tensor([[0.0, 0, 0], [side, 0, 0], [side, side, 0], [0, side, 0]])
    faces = torch.tensor([[0, 1, 2], [0, 2, 3]])
    return corners + torch.tensor([0.0, 0, height]), faces.flip(1) if flip else faces


def seeded() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def test_parallel_squares_have_every_figure_in_closed_form():
    found = compare_surfaces(
        square(0.03), square(0.0, flip=True), seeded(), samples=500, thresholds=(0.02, 0.031)
    )
    assert found.accuracy == pytest.approx(0.03, abs=1e-7)
    assert found.completeness == pytest.approx(0.03, abs=1e-7)
    assert found.chamfer == pytest.approx(0.03, abs=1e-7)
    assert found.chamfer_squared == pytest.approx(0.03**2, abs=1e-8)
    assert [s.f for s in found.f_scores.values()] == [0.0, 1.0]
    # The normals are opposite: consistency is blind to orientation.
    assert found.normal_consistency == pytest.approx(1.0)


def test_half_a_square_is_precise_and_incomplete():
    # Of the truth [0, 2] x [0, 2], the part beyond t of [0, 1] x [0, 1] is 4 minus the area that
    # lies within t of the small square: 1 + 2 t + pi t^2 / 4.
    t = 0.3
    found = compare_surfaces(
        square(0.0), square(0.0, side=2.0), seeded(), samples=100_000, thresholds=(t,)
    )
    score = found.f_scores[t]
    recall = (1 + 2 * t + math.pi * t * t / 4) / 4
    assert score.precision == 1.0
    assert score.recall == pytest.approx(recall, abs=5e-3)  # three deviations of 100k samples
    assert score.f == pytest.approx(2 * score.recall / (1 + score.recall))
    assert found.accuracy == pytest.approx(0.0, abs=1e-7)


def test_tilted_square_shows_the_cosine():
    angle = math.radians(10.0)
    turn = torch.tensor(
        [[1, 0, 0], [0, math.cos(angle), -math.sin(angle)], [0, math.sin(angle), math.cos(angle)]]
    )
    vertices, faces = square(0.0)
    found = compare_surfaces((vertices @ turn.T, faces), (vertices, faces), seeded(), samples=100)
    assert found.normal_consistency == pytest.approx(math.cos(angle), abs=1e-6)


def test_equal_meshes_score_zero_and_one():
    found = compare_surfaces(square(0.0), square(0.0), seeded(), samples=1000)
    assert found.chamfer == pytest.approx(0.0, abs=1e-7)
    assert all(score.f == 1.0 for score in found.f_scores.values())


def test_f_score_of_nothing_near_is_zero():
    far = torch.ones(5)
    assert f_score(far, far, 0.5).f == 0.0
    half = torch.tensor([0.1, 0.9])
    assert f_score(half, torch.tensor([0.1]), 0.5).f == pytest.approx(2 / 3)


def test_squared_chamfer_is_the_brute_force_one():
    a, b = (torch.randn(n, 3, generator=seeded(), dtype=torch.float64) for n in (70, 90))
    squared = (a[:, None] - b[None]).square().sum(-1)
    expected = 0.5 * float(squared.amin(1).mean() + squared.amin(0).mean())
    assert squared_chamfer(a, b) == pytest.approx(expected, rel=1e-12)
    # In units twice as large it is a quarter: it is squared.
    assert squared_chamfer(a / 2, b / 2) == pytest.approx(expected / 4, rel=1e-12)


def test_nearest_face_attains_the_distance():
    corners = torch.randn(3 * 200, 3, generator=seeded(), dtype=torch.float64)
    faces = torch.arange(600).view(-1, 3)
    points = torch.randn(40, 3, generator=seeded(), dtype=torch.float64)
    distance, face = nearest_face(points, corners, faces)
    for point, d, f in zip(points, distance, face, strict=True):
        alone = distance_to_surface(point[None], corners, faces[f][None])
        assert float(alone) == pytest.approx(float(d), rel=1e-12)


def test_samples_lie_on_the_face_that_is_named():
    corners = torch.randn(30, 3, generator=seeded(), dtype=torch.float64)
    faces = torch.arange(30).view(-1, 3)
    points, face = sample_faces(corners, faces, 50, seeded())
    for point, f in zip(points, face, strict=True):
        alone = distance_to_surface(point[None], corners, faces[f][None])
        assert float(alone) == pytest.approx(0.0, abs=1e-12)
