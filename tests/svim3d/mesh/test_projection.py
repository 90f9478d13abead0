import torch

from svim3d.fields.sdf_grid import node_positions
from svim3d.mesh.marching import extract_surface
from svim3d.mesh.mesh import vertex_normals
from svim3d.mesh.projection import project_onto
from svim3d.numerics import normalize

HALF = 0.55


def test_points_land_on_the_sphere_radially():
    points = node_positions(40, HALF, like=torch.zeros(1))
    vertices, faces = extract_surface(0.4 - points.norm(dim=-1), HALF)
    direction = normalize(torch.randn(2000, 3, generator=torch.Generator().manual_seed(0)))
    hits = project_onto(0.43 * direction, direction, vertices, faces)
    found = hits.interpolate(faces, vertices)
    assert (found.norm(dim=1) - 0.4).abs().max() < 1.5e-3
    assert torch.allclose(hits.distance, (found - 0.43 * direction).norm(dim=1), atol=1e-6)
    # The foot of the perpendicular, up to the facets' own slope.
    assert (normalize(found) * direction).sum(1).min() > 0.9995
    assert (hits.interpolate(faces, vertex_normals(vertices, faces)) * direction).sum(
        1
    ).min() > 0.99
    assert torch.allclose(hits.barycentric.sum(1), torch.ones(2000), atol=1e-5)
    assert hits.barycentric.min() > -1e-5


def test_the_two_sides_of_a_thin_plate_keep_apart():
    points = node_positions(48, HALF, like=torch.zeros(1))
    plate = torch.tensor([0.4, 0.03, 0.4]) - points.abs()
    vertices, faces = extract_surface(plate.min(-1).values, HALF)
    query = torch.rand(500, 3, generator=torch.Generator().manual_seed(0)) * 0.6 - 0.3
    query[:, 1] = 0.012  # decimation has pushed the top below the middle of what is left of it
    normal = torch.tensor([[0.0, 1, 0]]).expand(500, 3)
    top = project_onto(query, normal, vertices, faces).interpolate(faces, vertices)
    assert (top[:, 1] > 0.02).all()
