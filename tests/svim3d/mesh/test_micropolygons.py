"""Triangles cut to short edges: the same surface, without gaps, with linear values kept."""

import torch

from svim3d.mesh.micropolygons import cut_long_edges


def two_faces_over_one_edge() -> torch.Tensor:
    """A slender triangle and a broad one."""
    a, b = torch.tensor([0.0, 0.0, 0.0]), torch.tensor([1.0, 0.3, 0.1])
    c, d = torch.tensor([0.5, 0.2, 0.0]), torch.tensor([0.2, -0.9, 0.4])
    return torch.stack([torch.stack([a, b, c]), torch.stack([b, a, d])])


def area(corners: torch.Tensor) -> torch.Tensor:
    a, b, c = corners[..., :3].double().unbind(1)
    return 0.5 * torch.linalg.cross(b - a, c - a)


def test_edges_are_short_and_the_surface_is_the_same():
    faces = two_faces_over_one_edge()
    pieces, face = cut_long_edges(faces, 0.1)
    assert float((pieces.roll(-1, 1) - pieces).norm(dim=-1).max()) <= 0.1
    # Vector areas: winding is kept too.
    for index in range(2):
        torch.testing.assert_close(
            area(pieces)[face == index].sum(0), area(faces)[index], rtol=1e-6, atol=1e-8
        )
    whole, of = cut_long_edges(faces, 10.0)
    assert torch.equal(whole, faces) and of.tolist() == [0, 1]


def test_both_sides_of_an_edge_are_cut_at_the_same_points():
    faces = two_faces_over_one_edge()
    pieces, face = cut_long_edges(faces, 0.1)
    b = faces[0, 1].double()
    on_edge = []
    for index in range(2):
        points = pieces[face == index].view(-1, 3)
        off = torch.linalg.cross(points.double(), b.expand(len(points), 3)).norm(dim=1)
        on_edge.append({tuple(p) for p in points[off < 1e-6].tolist()})
    assert on_edge[0] == on_edge[1] and len(on_edge[0]) == 17  # 1.05 long: halved four times


def test_values_are_interpolated():
    faces = two_faces_over_one_edge()
    slope = torch.tensor([[0.5, -2.0], [1.0, 0.25], [3.0, 1.0]])
    pieces, _ = cut_long_edges(torch.cat([faces, faces @ slope], -1), 0.15)
    torch.testing.assert_close(pieces[..., 3:], pieces[..., :3] @ slope, rtol=0.0, atol=1e-6)
