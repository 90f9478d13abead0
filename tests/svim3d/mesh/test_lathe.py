import math

import pytest
import torch

from svim3d.mesh.lathe import revolve, smooth_curve, sweep
from svim3d.mesh.mesh import face_normals_scaled, signed_volume


def half_circle(points: int) -> torch.Tensor:
    angle = torch.linspace(-math.pi / 2, math.pi / 2, points)
    profile = torch.stack([angle.cos(), angle.sin()], 1)
    profile[[0, -1], 0] = 0.0
    return profile


def is_watertight(vertices, faces) -> bool:
    """Every edge is met once in each direction after welding equal positions."""
    welded = torch.unique((vertices * 1e5).round().long(), dim=0, return_inverse=True)[1]
    corners = welded[faces.long()]
    corners = corners[(corners != corners.roll(1, 1)).all(1)]
    edges = torch.cat([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]])
    key = edges[:, 0] * len(vertices) + edges[:, 1]
    back = edges[:, 1] * len(vertices) + edges[:, 0]
    return bool(torch.equal(key.sort().values, back.sort().values)) and len(key.unique()) == len(
        key
    )


def test_curve_keeps_ends_and_the_corner_given_twice():
    points = torch.tensor([[0.0, 0.0], [1.0, 0.0], [1.0, 0.0], [1.0, 1.0]])
    curve, parameter = smooth_curve(points, 6)
    assert torch.equal(curve[[0, -1]], points[[0, -1]])
    assert parameter[0] == 0 and parameter[-1] == 3
    assert bool((parameter.diff() > 0).all())
    assert float((curve - points[1]).norm(dim=1).min()) == 0.0


def test_curve_converges_to_the_quadratic_spline():
    points = torch.tensor([[0.0], [1.0], [0.0], [1.0], [0.0]], dtype=torch.float64)
    curve, parameter = smooth_curve(points, 9)
    # At the middle of an inner span the spline passes through the mean of its two controls.
    middle = curve[(parameter - 1.5).abs().argmin()]
    assert float(middle) == pytest.approx(0.5, abs=1e-2)
    # At an inner control point it is (1, 6, 1) / 8 of the neighbours.
    assert float(curve[(parameter - 2.0).abs().argmin()]) == pytest.approx(0.25, abs=1e-2)


def test_turned_half_circle_is_a_sphere():
    body = revolve(half_circle(65), rounds=0, segments=128)
    assert is_watertight(body.vertices, body.faces)
    assert float(signed_volume(body.vertices, body.faces)) == pytest.approx(
        4 * math.pi / 3, rel=2e-3
    )
    torch.testing.assert_close(body.normals, body.vertices, rtol=0, atol=2e-2)
    torch.testing.assert_close(body.normals.norm(dim=1), torch.ones(len(body.normals)))


def test_texture_runs_around_and_along():
    body = revolve(half_circle(9), rounds=0, segments=16)
    angle = torch.atan2(body.vertices[:, 0], body.vertices[:, 2]) / (2 * math.pi) % 1.0
    inner = body.vertices[:, 1].abs() < 0.99
    inner &= (body.uv[:, 0] > 0) & (body.uv[:, 0] < 1)
    torch.testing.assert_close(body.uv[inner, 0], angle[inner], rtol=0, atol=1e-6)
    height = (2 / math.pi) * torch.asin(body.vertices[:, 1].clamp(-1, 1)) / 2 + 0.5
    torch.testing.assert_close(body.uv[:, 1], height, rtol=0, atol=1e-3)


def test_straight_tube_is_a_cylinder():
    path = torch.tensor([[0.0, 0, 0, 0.2], [0.0, 0, 1, 0.2], [0.0, 0, 2, 0.2]])
    body = sweep(path, rounds=3, segments=256)
    assert is_watertight(body.vertices, body.faces)
    volume = float(signed_volume(body.vertices, body.faces))
    assert volume == pytest.approx(math.pi * 0.04 * 2.0, rel=1e-3)


def test_bent_tube_obeys_pappus():
    angle = torch.linspace(0, 1.5 * math.pi, 65)
    ring = torch.stack([angle.cos(), torch.zeros_like(angle), angle.sin()], 1)
    path = torch.cat([ring, torch.full((65, 1), 0.1)], 1)
    body = sweep(path, rounds=0, segments=64)
    assert is_watertight(body.vertices, body.faces)
    volume = float(signed_volume(body.vertices, body.faces))
    assert volume == pytest.approx(math.pi * 0.01 * 1.5 * math.pi, rel=1e-2)
    faced = face_normals_scaled(body.vertices, body.faces)
    vertex = body.normals[body.faces.long()].mean(1)
    assert bool(((faced * vertex).sum(1) > 0).all())


def test_open_profile_is_refused():
    with pytest.raises(ValueError, match="starts and ends on the axis"):
        revolve(torch.tensor([[0.1, 0.0], [0.0, 1.0]]), rounds=1, segments=8)
