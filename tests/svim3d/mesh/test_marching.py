"""Surfaces with known volume, area and topology; the band against the whole lattice."""

import math

import pytest
import torch

from svim3d.mesh.marching import (
    MIN_DIFFERENCE,
    crossing_points,
    crossing_points_reference,
    extract_surface,
    find_crossings,
    find_crossings_reference,
)
from svim3d.mesh.mesh import face_adjacency, face_normals_scaled, signed_volume
from svim3d.mesh.tetrahedra import (
    EDGE_ENDS,
    TETRAHEDRA_PER_NODE,
    cell_centres,
    close_border,
    lattice_around_surface,
    node_values,
)

HALF = 0.55


def points(nodes: int) -> torch.Tensor:
    axis = torch.linspace(-HALF, HALF, nodes)
    return torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1)


def sphere(nodes: int, radius: float = 0.4) -> torch.Tensor:
    return radius - points(nodes).norm(dim=-1)


def torus(nodes: int) -> torch.Tensor:
    p = points(nodes)
    return 0.12 - torch.hypot(torch.hypot(p[..., 0], p[..., 2]) - 0.3, p[..., 1])


def euler_number(vertices: torch.Tensor, faces: torch.Tensor) -> int:
    edges = torch.cat([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).sort(1).values
    return len(vertices) - len(torch.unique(edges, dim=0)) + len(faces)


def test_a_sphere_has_its_volume_its_area_and_euler_number_2():
    vertices, faces = extract_surface(sphere(49), HALF)
    assert euler_number(vertices, faces) == 2
    volume = float(signed_volume(vertices, faces))
    area = float(face_normals_scaled(vertices, faces).norm(dim=1).sum() / 2)
    assert volume == pytest.approx(4 / 3 * math.pi * 0.4**3, rel=4e-3)  # positive: outward
    assert area == pytest.approx(4 * math.pi * 0.4**2, rel=4e-3)
    assert bool((face_adjacency(faces) >= 0).all())
    assert float((vertices.norm(dim=1) - 0.4).abs().max()) < 0.1 * 2 * HALF / 48


def test_halving_the_cells_quarters_the_error_of_the_volume():
    errors = []
    for nodes in (17, 33, 65):
        volume = float(signed_volume(*extract_surface(sphere(nodes), HALF)))
        errors.append(4 / 3 * math.pi * 0.4**3 - volume)
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.15)
    assert errors[1] / errors[2] == pytest.approx(4.0, rel=0.15)


def test_a_torus_has_euler_number_0():
    vertices, faces = extract_surface(torus(41), HALF)
    assert euler_number(vertices, faces) == 0
    volume = float(signed_volume(vertices, faces))
    assert volume == pytest.approx(2 * math.pi**2 * 0.3 * 0.12**2, rel=2e-2)


def test_a_plane_is_exact_and_the_box_it_cuts_is_closed():
    normal = torch.tensor([0.6, 0.64, 0.48])
    vertices, faces = extract_surface(0.1 - points(14) @ normal, HALF)
    assert bool((face_adjacency(faces) >= 0).all())
    assert euler_number(vertices, faces) == 2
    cell = 2 * HALF / 13
    inner = (vertices.abs() < HALF - 0.5 * cell).all(1)
    assert int(inner.sum()) > 100
    assert float((vertices[inner] @ normal - 0.1).abs().max()) < 1e-6
    within = HALF + cell
    assert float(vertices.abs().max()) <= within + 1e-6


@pytest.mark.parametrize("level", [-1.0, 0.0])
def test_a_field_that_is_nowhere_inside_gives_an_empty_surface(level: float):
    vertices, faces = extract_surface(torch.full((6, 6, 6), level), HALF)
    assert vertices.shape == (0, 3)
    assert faces.shape == (0, 3)


def test_a_field_that_is_inside_everywhere_gives_a_closed_cube():
    vertices, faces = extract_surface(torch.ones(6, 6, 6), HALF)
    assert euler_number(vertices, faces) == 2
    assert float(signed_volume(vertices, faces)) > (2 * HALF) ** 3


def test_values_that_are_exactly_zero_leave_the_surface_closed_and_finite():
    p = points(12)
    sdf = torch.round(8 * (0.35 - p.abs().amax(-1))) / 8  # many nodes at exactly 0
    assert int((sdf == 0).sum()) > 50
    vertices, faces = extract_surface(sdf, HALF)
    assert bool(torch.isfinite(vertices).all())
    assert bool((face_adjacency(faces) >= 0).all())


def test_the_band_gives_the_same_surface_as_the_whole_lattice():
    corners, centres = close_border(torus(25), cell_centres(torus(25)), 2 * HALF / 24)
    surfaces = []
    for reach in (0.0, 0.1, math.inf):
        lattice = lattice_around_surface(corners, centres, HALF, reach=reach)
        values = node_values(lattice, corners, centres)
        edges, faces = find_crossings(values > 0, lattice)
        surfaces.append((crossing_points(lattice.nodes, values, edges), faces))
    for vertices, faces in surfaces[:2]:
        assert torch.equal(vertices, surfaces[2][0])
        assert torch.equal(faces, surfaces[2][1])


def test_the_whole_lattice_fills_its_cube_with_positive_tetrahedra_of_equal_size():
    n = 5
    lattice = lattice_around_surface(
        torch.ones(n + 1, n + 1, n + 1), torch.ones(n, n, n), HALF, reach=math.inf
    )
    corners = lattice.nodes[lattice.tetrahedra.long()].double()
    spans = corners[:, 1:] - corners[:, :1]
    volume = torch.linalg.det(spans) / 6
    assert lattice.spacing == pytest.approx(2 * HALF / n)
    assert torch.allclose(volume, torch.full_like(volume, lattice.spacing**3 / 12), rtol=1e-5)
    assert len(volume) == 12 * n * n * (n - 1)
    # Only nodes away from the border have all 24 tetrahedra around them.
    assert int((~lattice.fixed).sum()) == (n - 1) ** 3 + (n - 2) ** 3
    counts = torch.bincount(lattice.tetrahedra.reshape(-1).long())
    assert int(counts.max()) == TETRAHEDRA_PER_NODE


def test_the_edge_table_names_the_edges_of_each_tetrahedron():
    corners = sphere(9)
    lattice = lattice_around_surface(corners, cell_centres(corners), HALF)
    ends = lattice.tetrahedra[:, torch.tensor(EDGE_ENDS)].sort(-1).values
    assert torch.equal(lattice.edges[lattice.tetrahedron_edges.long()], ends)
    assert len(torch.unique(lattice.edges, dim=0)) == len(lattice.edges)


def test_the_torch_twin_gives_the_same_crossings():
    corners = torus(21)
    lattice = lattice_around_surface(corners, cell_centres(corners), HALF, reach=0.1)
    inside = torch.rand(len(lattice.nodes), generator=torch.Generator().manual_seed(0)) > 0.5
    for fast, plain in zip(
        find_crossings(inside, lattice), find_crossings_reference(inside, lattice), strict=True
    ):
        assert torch.equal(fast, plain)


def test_vertices_are_differentiable_in_sdf_and_nodes():
    corners = sphere(6)
    centres = cell_centres(corners)
    lattice = lattice_around_surface(corners, centres, HALF)
    sdf = node_values(lattice, corners, centres).double()
    edges, _ = find_crossings(sdf > 0, lattice)
    nodes = lattice.nodes.double()
    assert torch.autograd.gradcheck(
        lambda n, s: crossing_points(n, s, edges[:40]),
        (nodes.requires_grad_(), sdf.requires_grad_()),
    )


def test_the_torch_twin_gives_the_same_points_and_gradients():
    corners = torus(21)
    lattice = lattice_around_surface(corners, cell_centres(corners), HALF, reach=0.1)
    draw = torch.Generator().manual_seed(0)
    values = torch.randn(len(lattice.nodes), generator=draw)
    values[::7] *= 1e-8  # differences that are held off zero
    edges, _ = find_crossings(values > 0.0, lattice)
    pull = torch.randn(len(edges), 3, generator=draw)
    found = []
    for points_on in (crossing_points, crossing_points_reference):
        nodes, sdf = lattice.nodes.clone().requires_grad_(), values.clone().requires_grad_()
        points = points_on(nodes, sdf, edges)
        found.append((points.detach(), *torch.autograd.grad((points * pull).sum(), (nodes, sdf))))
    assert float((values[edges.long()].diff(dim=1)).abs().min()) < MIN_DIFFERENCE
    for fast, plain in zip(*found, strict=True):
        torch.testing.assert_close(fast, plain, rtol=1e-3, atol=1e-4)


def test_a_zero_at_the_end_of_an_edge_is_that_end_to_the_bit():
    nodes = torch.rand(2000, 3, generator=torch.Generator().manual_seed(0))
    edges = torch.arange(2000).view(-1, 2)
    sdf = torch.where(torch.arange(2000) % 2 == 0, -torch.rand(2000) - 0.1, 0.0)
    for found in (crossing_points, crossing_points_reference):
        assert torch.equal(found(nodes, sdf, edges), nodes[1::2])


def test_growing_the_sdf_moves_the_surface_outward_by_as_much():
    corners = sphere(33)
    centres = cell_centres(corners)
    lattice = lattice_around_surface(corners, centres, HALF, reach=0.1)
    sdf = node_values(lattice, corners, centres).requires_grad_()
    edges, faces = find_crossings(sdf.detach() > 0, lattice)
    volume = signed_volume(crossing_points(lattice.nodes, sdf, edges), faces)
    (gradient,) = torch.autograd.grad(volume, sdf)
    # d volume / d radius = area, and raising every node by d raises the radius by d.
    assert float(gradient.sum()) == pytest.approx(4 * math.pi * 0.4**2, rel=1e-2)
