"""Normals, volume and adjacency on solids whose answers are known."""

import torch

from svim3d.mesh.mesh import (
    face_adjacency,
    face_adjacency_sorted,
    face_normals_scaled,
    signed_volume,
    vertex_normals,
    vertex_normals_reference,
)

OCTAHEDRON = torch.tensor(
    [[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], dtype=torch.float64
)
FACES = torch.tensor(
    [[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]]
)


def test_octahedron_volume_and_area():
    assert torch.allclose(signed_volume(OCTAHEDRON, FACES), torch.tensor(4 / 3).double())
    area = face_normals_scaled(OCTAHEDRON, FACES).norm(dim=1).sum() / 2
    assert torch.allclose(area, torch.tensor(12.0).double().sqrt() * 2)


def test_vertex_normals_of_an_octahedron_point_outward():
    assert torch.allclose(vertex_normals(OCTAHEDRON, FACES), OCTAHEDRON)


def test_vertex_normals_are_differentiable():
    vertices = OCTAHEDRON.clone().requires_grad_(True)
    assert torch.autograd.gradcheck(lambda v: vertex_normals(v, FACES), (vertices,))


def test_the_torch_twin_gives_the_same_normals_and_gradients():
    draw = torch.Generator().manual_seed(0)
    vertices = torch.randn(40, 3, generator=draw)
    faces = torch.randint(0, 36, (90, 3), generator=draw)  # soup, flat faces, an idle vertex
    vertices[36:39] *= 1e-6  # a face so small that its normal's length is guarded
    faces = torch.cat([faces, torch.tensor([[36, 37, 38]])])
    pull = torch.randn(40, 3, generator=draw)
    found = []
    for normals in (vertex_normals, vertex_normals_reference):
        leaf = vertices.clone().requires_grad_()
        value = normals(leaf, faces)
        found.append((value.detach(), torch.autograd.grad((value * pull).sum(), leaf)[0]))
    assert torch.equal(found[0][0][39], torch.zeros(3))
    for fast, plain in zip(*found, strict=True):
        torch.testing.assert_close(fast, plain, rtol=1e-4, atol=1e-5)


def test_adjacency_is_mutual_and_complete_on_a_closed_mesh():
    neighbours = face_adjacency(FACES)
    assert (neighbours >= 0).all()
    for face, row in enumerate(neighbours.tolist()):
        for corner, other in enumerate(row):
            edge = {int(FACES[face, (corner + 1) % 3]), int(FACES[face, (corner + 2) % 3])}
            assert edge <= set(FACES[other].tolist())
            assert face in neighbours[other].tolist()


def test_adjacency_marks_boundaries():
    assert face_adjacency(FACES[:1]).tolist() == [[-1, -1, -1]]


def test_an_edge_of_three_faces_links_the_first_two():
    fan = torch.tensor([[0, 1, 2], [1, 0, 3], [0, 1, 4]])
    assert face_adjacency(fan)[:, 2].tolist() == [1, 0, -1]


def test_the_sorted_twin_gives_the_same_adjacency():
    soup = torch.randint(0, 12, (60, 3), generator=torch.Generator().manual_seed(0))
    for faces in (FACES, FACES[:5], soup, FACES[:0]):
        assert torch.equal(face_adjacency(faces), face_adjacency_sorted(faces))
