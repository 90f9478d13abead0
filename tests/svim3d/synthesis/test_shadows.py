"""Soft shadows of an object on itself, against closed forms."""

import math

import pytest
import torch

from svim3d.numerics import normalize
from svim3d.render.deferred import Geometry
from svim3d.synthesis.bodies import box
from svim3d.synthesis.shadows import (
    DIRECTIONS,
    DepthPictures,
    direction_frames,
    seen_shares,
    seen_shares_plainly,
)
from svim3d.synthesis.shapes import assemble, superquadric


def geometry(*shapes):
    whole = assemble(shapes)
    return Geometry(
        vertices=whole.vertices,
        faces=whole.faces,
        normals=whole.normals,
        attributes=torch.zeros(len(whole.vertices), 0),
    )


def openness(scene, points, normals):
    """Share of the cosine lobe that leaves the object."""
    points, normals = torch.tensor(points), torch.tensor(normals)
    alpha = torch.full((len(points), 1), 0.25)
    light = torch.ones(DIRECTIONS, 3)
    return seen_shares(points, normals, normals, alpha, light, DepthPictures.of(scene))


def test_directions_are_spread_evenly():
    forward = direction_frames(DIRECTIONS)[:, 2]
    # Even moments of the sphere: mean 0, second moment a third of the identity.
    torch.testing.assert_close(forward.mean(0), torch.zeros(3), atol=0.01, rtol=0.0)
    second = forward.T @ forward / DIRECTIONS
    torch.testing.assert_close(second, torch.eye(3) / 3.0, atol=0.01, rtol=0.0)


def test_frames_are_right_handed():
    frames = direction_frames(DIRECTIONS)
    torch.testing.assert_close(
        frames @ frames.transpose(1, 2), torch.eye(3).expand(DIRECTIONS, 3, 3), atol=1e-5, rtol=0.0
    )
    torch.testing.assert_close(
        torch.linalg.det(frames), torch.ones(DIRECTIONS), atol=1e-5, rtol=0.0
    )


def test_a_sphere_does_not_shadow_itself():
    generator = torch.Generator().manual_seed(0)
    normals = normalize(torch.randn(500, 3, generator=generator))
    sphere = geometry(superquadric(1.0, 1.0, 40).placed(scale=(0.5, 0.5, 0.5)))
    shares = openness(sphere, (0.5 * normals).tolist(), normals.tolist())
    # Directions along the surface count little; depth pictures may still take one or two.
    assert float(shares.open_diffuse.min()) > 0.97


def test_a_wall_hides_half_of_the_sky():
    floor = box(0.8, 0.03, 0.8).placed(offset=(0.0, -0.3, 0.0))
    wall = box(0.03, 0.8, 0.8).placed(offset=(-0.03, 0.5, 0.0))
    # The foot of the wall's face: an endless wall leaves half of the cosine lobe, this one, 1.3
    # high and 0.06 away, hides a little less.
    shares = openness(geometry(floor, wall), [[0.06, -0.27, 0.0]], [[0.0, 1.0, 0.0]])
    assert float(shares.open_diffuse) == pytest.approx(0.5, abs=0.08)


def test_a_closed_box_lets_no_light_in():
    walls = [
        box(*(0.05 if a == axis else 0.5 for a in range(3))).placed(
            offset=tuple(side * 0.45 if a == axis else 0.0 for a in range(3))
        )
        for axis in range(3)
        for side in (-1.0, 1.0)
    ]
    shares = openness(geometry(*walls), [[0.0, -0.4, 0.0]], [[0.0, 1.0, 0.0]])
    assert float(shares.open_diffuse) == 0.0
    assert float(shares.diffuse.max()) == 0.0


def test_light_from_behind_the_wall_is_the_light_that_is_lost():
    floor = box(0.8, 0.03, 0.8).placed(offset=(0.0, -0.3, 0.0))
    wall = box(0.03, 0.8, 0.8).placed(offset=(-0.03, 0.5, 0.0))
    pictures = DepthPictures.of(geometry(floor, wall))
    forward = direction_frames(DIRECTIONS)[:, 2]
    lit = [(forward[:, :1] * sign > 0.3).float().expand(-1, 3) for sign in (-1.0, 1.0)]
    up, point = torch.tensor([[0.0, 1.0, 0.0]]), torch.tensor([[0.06, -0.27, 0.0]])
    shares = seen_shares(point, up, up, torch.ones(1, 1), torch.cat(lit, 1), pictures)
    assert float(shares.diffuse[0, :3].max()) < 0.1
    assert float(shares.diffuse[0, 3:].min()) == 1.0


def test_the_compiled_kernel_is_its_twin():
    generator = torch.Generator().manual_seed(1)
    scene = geometry(
        box(0.3, 0.2, 0.4),
        superquadric(1.0, 1.0, 12).placed(scale=(0.2,) * 3, offset=(0.3, 0.3, 0.0)),
    )
    points = scene.vertices
    normals = scene.normals
    mirrored = normalize(torch.randn(len(points), 3, generator=generator))
    alpha = torch.rand(len(points), 1, generator=generator)
    light = torch.rand(DIRECTIONS, 6, generator=generator)
    pictures = DepthPictures.of(scene)
    compiled = seen_shares(points, normals, mirrored, alpha, light, pictures)
    plain = seen_shares_plainly(points, normals, mirrored, alpha, light, pictures)
    for name in ("diffuse", "specular", "open_diffuse", "open_specular"):
        difference = (getattr(compiled, name) - getattr(plain, name)).abs()
        # Rounding puts a point in the next depth pixel now and then: one direction of one point.
        assert float((difference > 1e-4).float().mean()) < 0.005
        assert float(difference.max()) < 0.5
    assert math.isfinite(float(compiled.specular.sum()))
