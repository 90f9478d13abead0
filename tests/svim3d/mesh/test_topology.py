import torch

from svim3d.mesh.topology import Topology
from svim3d.synthesis.hazards.things import pierced
from svim3d.synthesis.shapes import superquadric

SPHERE = superquadric(1.0, 1.0, 8)


def test_a_ball_is_closed_and_has_no_handles():
    found = Topology.of(SPHERE.vertices, SPHERE.faces)
    assert found == Topology(euler=2, parts=1, cavities=0, open_edges=0)
    assert found.is_closed


def test_seams_are_welded():
    corners = SPHERE.vertices[SPHERE.faces.long()].reshape(-1, 3)
    faces = torch.arange(len(corners), dtype=torch.int32).view(-1, 3)
    assert Topology.of(corners, faces) == Topology.of(SPHERE.vertices, SPHERE.faces)


def test_a_missing_face_leaves_three_open_edges():
    found = Topology.of(SPHERE.vertices, SPHERE.faces[1:])
    assert found.open_edges == 3 and not found.is_closed
    assert found.euler == 1


def test_a_ball_in_a_ball_is_a_cavity_if_it_faces_inward():
    vertices = torch.cat([SPHERE.vertices, 0.5 * SPHERE.vertices])
    inward = SPHERE.faces.flip(1) + len(SPHERE.vertices)
    found = Topology.of(vertices, torch.cat([SPHERE.faces, inward]))
    assert (found.euler, found.parts, found.cavities) == (4, 2, 1)
    outward = SPHERE.faces + len(SPHERE.vertices)
    assert Topology.of(vertices, torch.cat([SPHERE.faces, outward])).cavities == 0


def test_things_with_holes_have_the_handles_that_they_should():
    for kind, euler, cavities in (("ring", 0, 0), ("mug", 0, 0), ("eight", -2, 0), ("shell", 4, 1)):
        mesh = pierced(kind, 0.45, seed=0)
        found = Topology.of(mesh.vertices, mesh.faces)
        assert (found.euler, found.cavities) == (euler, cavities), kind
        assert found.is_closed


def test_nothing_has_no_topology():
    assert Topology.of(torch.zeros(0, 3), torch.zeros(0, 3, dtype=torch.int32)).parts == 0
