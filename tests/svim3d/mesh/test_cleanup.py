import math

import pytest
import torch

from svim3d.fields.sdf_grid import node_positions, sample_sdf
from svim3d.mesh import cleanup
from svim3d.mesh.cleanup import clean_surface, decimate, is_closed
from svim3d.mesh.marching import extract_surface
from svim3d.mesh.mesh import signed_volume

LIMITS = {"min_area_share": 0.002, "min_extent_share": 0.05}
HALF, RADIUS = 0.55, 0.3


def grid(nodes=24):
    points = node_positions(nodes, HALF, like=torch.zeros(1))
    return RADIUS - points.norm(dim=-1), points


@pytest.fixture(scope="module")
def sphere():
    return extract_surface(grid()[0], HALF)


def rod(points, x=0.4, radius=0.03, half_length=0.3):
    axis = torch.stack([points[..., 0] - x, points[..., 2]], -1).norm(dim=-1)
    return torch.minimum(radius - axis, half_length - points[..., 1].abs())


def test_a_sound_mesh_comes_back_as_it_is(sphere):
    mesh = clean_surface(*sphere, **LIMITS)
    assert mesh.notes == ()
    assert torch.equal(mesh.vertices, sphere[0])
    assert torch.equal(mesh.faces, sphere[1])


def test_floaters_go_and_a_detached_thin_rod_stays():
    sdf, points = grid(40)
    floater = 0.05 - (points - torch.tensor([0.45, 0.45, 0.45])).norm(dim=-1)
    both = torch.maximum(torch.maximum(sdf, rod(points)), floater)
    mesh = clean_surface(*extract_surface(both, HALF), min_area_share=0.1, min_extent_share=0.2)
    assert any("removed 1 floaters" in note for note in mesh.notes)
    assert mesh.vertices[:, 0].max() > 0.4  # the rod, 4 % of the area
    assert not (mesh.vertices.min(1).values > 0.4).any()
    assert is_closed(mesh.faces)


def test_a_hidden_cavity_goes(sphere):
    sdf, points = grid()
    hollow = torch.minimum(sdf, points.norm(dim=-1) - 0.15)
    mesh = clean_surface(*extract_surface(hollow, HALF), **LIMITS)
    assert mesh.notes == ("removed 1 hidden cavities",)
    assert signed_volume(mesh.vertices, mesh.faces) == pytest.approx(
        float(signed_volume(*sphere)), rel=1e-6
    )


def test_broken_input_is_mended(sphere):
    vertices, faces = sphere
    split = vertices[faces.long()].reshape(-1, 3)  # a soup: three vertices per face
    soup = torch.arange(len(split)).view(-1, 3)
    junk = torch.tensor([[0, 0, 1], [3, 4, 5], [len(split), 1, 2]])
    split = torch.cat([split, torch.tensor([[math.nan, 0, 0]])])
    mesh = clean_surface(split, torch.cat([soup, junk]), **LIMITS)
    assert is_closed(mesh.faces)
    assert len(mesh.faces) == len(faces)
    assert len(mesh.vertices) == len(vertices)


def test_small_holes_close_and_faces_turn_outward(sphere):
    vertices, faces = sphere
    mesh = clean_surface(vertices, faces[1:, [0, 2, 1]], **LIMITS)
    assert is_closed(mesh.faces)
    assert signed_volume(mesh.vertices, mesh.faces) > 0.1


def test_nothing_sound_gives_no_faces():
    vertices = torch.full((3, 3), math.nan)
    assert not len(clean_surface(vertices, torch.tensor([[0, 1, 2]]), **LIMITS).faces)
    empty = clean_surface(torch.zeros(0, 3), torch.zeros(0, 3, dtype=torch.int64), **LIMITS)
    assert not len(empty.faces)


def test_decimation_stays_closed_and_near(sphere):
    mesh = decimate(*sphere, max_faces=500)
    assert is_closed(mesh.faces)
    assert 450 <= len(mesh.faces) <= 525
    assert mesh.notes == ()
    error = sample_sdf(grid()[0], mesh.vertices, HALF)[0].abs()
    # The middle of an even triangle of edge a on a sphere lies a^2 / (6 r) off; 500 faces have
    # a = 0.072, so 2.9e-3; uneven ones get twice that.
    assert error.max() < 5.8e-3
    assert float(signed_volume(mesh.vertices, mesh.faces)) == pytest.approx(
        float(signed_volume(*sphere)), rel=0.02
    )
    assert decimate(*sphere, max_faces=10**6).faces is sphere[1]


@pytest.mark.parametrize("broken", ["empty", "nan", "raises"])
def test_a_step_that_fails_is_left_out_and_told(sphere, monkeypatch, broken):
    def simplify(vertices, faces, **_):
        if broken == "raises":
            raise RuntimeError("out of ideas")
        return (vertices * math.nan, faces) if broken == "nan" else (vertices[:0], faces[:0])

    monkeypatch.setattr(cleanup.fast_simplification, "simplify", simplify)
    mesh = decimate(*sphere, max_faces=500)  # pymeshlab does it then
    assert is_closed(mesh.faces)
    assert len(mesh.faces) <= 525
    monkeypatch.setattr(cleanup, "_collapse_carefully", lambda mesh, _: simplify(None, None))
    mesh = decimate(*sphere, max_faces=500)
    assert torch.equal(mesh.faces, sphere[1])
    assert "instead of 500" in mesh.notes[0]


def test_closedness():
    tetrahedron = torch.tensor([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])
    assert is_closed(tetrahedron)
    assert not is_closed(tetrahedron[1:])
    assert not is_closed(torch.cat([tetrahedron[:1, [0, 2, 1]], tetrahedron[1:]]))
    assert not is_closed(tetrahedron[:0])
