"""Closed shapes: watertight, wound outward, of known volume, with normals that respect creases."""

import math

import pytest
import torch

from svim3d.mesh.mesh import signed_volume
from svim3d.synthesis.bodies import box, random_body, turned
from svim3d.synthesis.dice import Dice
from svim3d.synthesis.objects import random_object
from svim3d.synthesis.outlines import (
    handle_path,
    polygon,
    random_outline,
    random_path,
    random_profile,
    vessel_profile,
)
from svim3d.synthesis.recipes import RECIPES
from svim3d.synthesis.shapes import (
    assemble,
    circle,
    creased,
    extrusion,
    lathe,
    superquadric,
    tube,
)
from svim3d.synthesis.solids import ellipsoid, grid_points, random_figure, shape_from_distance


def is_watertight(shape):
    """Every directed edge occurs once, and its reverse once."""
    f = shape.faces.long()
    edges = torch.cat([f[:, [0, 1]], f[:, [1, 2]], f[:, [2, 0]]])
    forward = torch.unique(edges, dim=0, return_counts=True)
    backward = torch.unique(edges.flip(1), dim=0)
    return bool((forward[1] == 1).all()) and torch.equal(forward[0], backward)


def dice(seed):
    return Dice(torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("seed", range(12))
def test_random_bodies_are_closed_and_face_outward(seed):
    shape = random_body(dice(seed))
    assert is_watertight(shape)
    assert float(signed_volume(shape.vertices, shape.faces)) > 0.0


@pytest.mark.parametrize("seed", range(4))
def test_pots_handles_springs_and_statuettes_are_closed(seed):
    d = dice(seed)
    path, spring = handle_path(0.5, -0.4, 0.5, 0.4), random_path(d)
    for shape in (
        lathe(vessel_profile(d), circle(24)),
        lathe(random_profile(d), circle(24)),
        tube(path, torch.full((len(path),), 0.08), circle(10)),
        tube(spring, torch.full((len(spring),), 0.1), circle(8)),
        extrusion(random_outline(d), 0.5, 0.05),
        random_figure(d),
    ):
        assert is_watertight(shape)
        assert float(signed_volume(shape.vertices, shape.faces)) > 0.0


def test_a_sphere_and_a_box_have_their_volumes():
    sphere = superquadric(1.0, 1.0, 80)
    # A chord polyhedron lacks about (pi / 80)^2 / 3 in each direction; the poles are cut flat.
    assert float(signed_volume(sphere.vertices, sphere.faces)) == pytest.approx(
        4.0 / 3.0 * math.pi, rel=3e-3
    )
    block = box(0.5, 0.3, 0.2, bevel=1e-4)
    assert float(signed_volume(block.vertices, block.faces)) == pytest.approx(0.24, rel=2e-3)


def test_a_closed_loop_has_the_volume_of_a_torus():
    path = torch.nn.functional.pad(circle(96), (0, 1))
    loop = tube(path, torch.full((96,), 0.25), circle(48), joined=True)
    assert is_watertight(loop)
    # Pappus: 2 pi R times the cross-section's area, both of polygons.
    expected = 2.0 * math.pi * math.pi * 0.25**2
    assert float(signed_volume(loop.vertices, loop.faces)) == pytest.approx(expected, rel=5e-3)


def test_a_turned_cylinder_has_its_volume():
    profile = torch.tensor([[0.01, -1.0], [0.5, -1.0], [0.5, 1.0], [0.01, 1.0]])
    body = lathe(profile, circle(64))
    area = 0.5 * 64 * math.sin(2.0 * math.pi / 64) * 0.25
    assert float(signed_volume(body.vertices, body.faces)) == pytest.approx(2.0 * area, rel=1e-4)


def test_the_largest_body_of_a_distance_is_kept():
    points = grid_points()
    large = ellipsoid(points - torch.tensor([0.5, 0.0, 0.0]), torch.tensor([0.4, 0.4, 0.4]))
    small = ellipsoid(points + torch.tensor([0.7, 0.0, 0.0]), torch.tensor([0.15, 0.15, 0.15]))
    shape = shape_from_distance(torch.maximum(large, small))
    assert float(shape.vertices[:, 0].min()) > 0.0


def test_mirroring_keeps_the_outside_outside():
    body = random_body(dice(3)).placed(scale=(-1.0, 1.0, 1.0), rotation=turned(1, 30.0))
    assert float(signed_volume(body.vertices, body.faces)) > 0.0


def test_normals_of_a_box_are_those_of_its_sides():
    block = extrusion(polygon(4, 4, math.pi / 4), 1.0, 0.0)
    vertices, faces, normals = creased(block)
    corners = vertices[faces.long()]
    flat = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    large = flat.norm(dim=1) > 1e-6  # the empty bevel's faces have no direction
    flat = torch.nn.functional.normalize(flat[large], dim=1)
    cosine = (normals[faces.long()[large]] * flat[:, None]).sum(-1)
    assert float(cosine.min()) > 1.0 - 1e-5


def test_normals_of_a_sphere_point_away_from_its_centre():
    vertices, _, normals = creased(superquadric(1.0, 1.0, 40))
    inner = vertices[:, 1].abs() < 0.9  # the poles are cut flat
    cosine = (normals[inner] * torch.nn.functional.normalize(vertices[inner], dim=1)).sum(1)
    assert float(cosine.min()) > math.cos(math.radians(1.0))


def test_an_assembly_knows_which_part_each_face_is_of():
    parts = [box(0.5, 0.5, 0.5), superquadric(1.0, 1.0, 8)]
    whole = assemble(parts)
    assert torch.bincount(whole.face_part).tolist() == [len(p.faces) for p in parts]
    assert int(whole.faces.max()) < len(whole.vertices)


@pytest.mark.parametrize("recipe", [recipe for recipe, _ in RECIPES])
def test_every_recipe_makes_finite_closed_parts(recipe):
    for seed in range(3):
        for part in recipe(dice(seed)):
            assert bool(torch.isfinite(part.shape.vertices).all())
            assert is_watertight(part.shape)
            assert 0 <= part.material <= 3


def test_objects_are_centred_with_longest_side_one():
    for seed in range(6):
        vertices = random_object(dice(seed)).assembly.vertices
        low, high = vertices.amin(0), vertices.amax(0)
        assert float((high - low).max()) == pytest.approx(1.0, abs=1e-5)
        assert float((low + high).abs().max()) < 1e-5
