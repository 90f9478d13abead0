import numpy as np
import torch

from svim3d.mesh.frames import (
    NORMAL_MIN_Z,
    bitangents,
    tangent_frames,
    tangent_from_world,
    world_from_tangent,
)
from svim3d.numerics import normalize

OCTAHEDRON = torch.tensor([[1.0, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]])
FACES = torch.tensor(
    [[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]]
)
UV = torch.tensor([[0.9, 0.4], [0.1, 0.6], [0.4, 0.1], [0.7, 0.9], [0.5, 0.45], [0.45, 0.3]])
# Tangents that mikktspace.c (npm package mikktspace 1.1.1) gives at vertices 0 to 5 of the
# octahedron above, seen from faces 0 to 3 and 4 to 7; w has the sign for v upwards. The lower half
# is mirrored in texture space, so the four vertices of the equator need two tangents each.
UPPER = {
    0: [0.0, -0.13202, -0.99125],
    1: [0.0, -0.36865, 0.92957],
    2: [0.99211, 0.0, 0.12539],
    3: [0.99220, 0.0, -0.12466],
    4: [0.97020, -0.24232, 0.0],
}
LOWER = {
    0: [0.0, 0.25667, 0.96650],
    1: [0.0, -0.61541, -0.78821],
    2: [0.99462, 0.0, -0.10356],
    3: [0.99333, 0.0, 0.11529],
    5: [0.98049, -0.19659, 0.0],
}


def test_tangents_match_the_reference_implementation():
    frames = tangent_frames(OCTAHEDRON, FACES, OCTAHEDRON, UV)
    assert len(frames.vertex_source) == 10
    assert frames.vertex_source[:6].tolist() == list(range(6))
    for index, face in enumerate(frames.faces.tolist()):
        for vertex in face:
            source = int(frames.vertex_source[vertex])
            expected = [*(UPPER if index < 4 else LOWER)[source], 1.0 if index < 4 else -1.0]
            assert np.allclose(frames.tangents[vertex].tolist(), expected, atol=2e-5)


def test_plane_has_the_texture_axes_of_gltf():
    vertices = torch.tensor([[0.0, 0, 0], [2, 0, 0], [2, 1, 0], [0, 1, 0]])
    faces = torch.tensor([[0, 1, 2], [0, 2, 3]])
    normals = torch.tensor([[0.0, 0, 1]]).expand(4, 3)
    upright = torch.tensor([[0.0, 1], [1, 1], [1, 0], [0, 0]])  # v = 0 at the top of the picture
    frames = tangent_frames(vertices, faces, normals, upright)
    assert torch.equal(frames.tangents, torch.tensor([[1.0, 0, 0, 1]]).expand(4, 4))
    # Green up: the bitangent points to the top of the picture, here +y.
    up = bitangents(normals, frames.tangents)
    assert torch.equal(up, torch.tensor([[0.0, 1, 0]]).expand(4, 3))
    flipped = tangent_frames(vertices, faces, normals, upright * torch.tensor([-1.0, 1]))
    assert torch.equal(flipped.tangents, torch.tensor([[-1.0, 0, 0, -1]]).expand(4, 4))


def sphere_patch(n=33):
    """Part of a sphere with u along the longitude and v along the latitude, glTF orientation."""
    u, v = torch.meshgrid(torch.linspace(0, 1, n), torch.linspace(0, 1, n), indexing="xy")
    longitude, latitude = 2.0 * u - 1.0, 0.8 - 1.6 * v
    points = torch.stack(
        [
            latitude.cos() * longitude.sin(),
            latitude.sin(),
            latitude.cos() * longitude.cos(),
        ],
        -1,
    ).reshape(-1, 3)
    index = torch.arange(n * n).view(n, n)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]
    faces = torch.cat([torch.stack([a, c, b], -1), torch.stack([b, c, d], -1)]).reshape(-1, 3)
    return points, faces, torch.stack([u, v], -1).reshape(-1, 2), longitude.reshape(-1)


def test_sphere_tangents_point_east():
    points, faces, uv, longitude = sphere_patch()
    frames = tangent_frames(points, faces, points, uv)
    east = torch.stack([longitude.cos(), torch.zeros_like(longitude), -longitude.sin()], -1)
    interior = ((uv > 0.01) & (uv < 0.99)).all(1)
    cosine = (frames.tangents[:, :3] * east).sum(1)
    assert len(frames.vertex_source) == len(points)
    assert cosine[interior].min() > np.cos(np.radians(0.2))
    assert (frames.tangents[:, 3] == 1).all()


def test_tangents_are_unit_and_orthogonal_even_for_degenerate_faces():
    generator = torch.Generator().manual_seed(0)
    vertices = torch.rand(40, 3, generator=generator)
    faces = torch.randint(0, 40, (80, 3), generator=generator)
    faces[:5, 1] = faces[:5, 0]
    normals = normalize(torch.rand(40, 3, generator=generator) - 0.5)
    uv = torch.rand(40, 2, generator=generator)
    uv[:10] = 0.5  # no texture space at all
    vertices[10:15] = vertices[15:20]
    frames = tangent_frames(vertices, faces, normals, uv)
    normal = normals[frames.vertex_source]
    assert torch.isfinite(frames.tangents).all()
    assert torch.allclose(frames.tangents[:, :3].norm(dim=1), torch.ones(len(normal)), atol=1e-5)
    assert (frames.tangents[:, :3] * normal).sum(1).abs().max() < 1e-5
    assert torch.equal(frames.vertex_source[frames.faces], faces)


def test_tangent_and_world_normals_are_inverse_also_in_skewed_frames():
    generator = torch.Generator().manual_seed(0)
    normal, tangent = normalize(torch.randn(2, 500, 3, generator=generator))
    bitangent = normalize(torch.linalg.cross(normal, tangent) + 0.2 * tangent + 0.1 * normal)
    local = torch.randn(500, 3, generator=generator) * torch.tensor([1.0, 1.0, 0.0])
    local = normalize(local * 0.4 + torch.tensor([0.0, 0, 1]))
    skewed = (tangent * normal).sum(1).abs() < 0.8
    world = world_from_tangent(local, normal, tangent, bitangent)
    back = tangent_from_world(world, normal, tangent, bitangent)
    assert torch.allclose(back[skewed], local[skewed], atol=1e-4)


def test_normals_below_the_surface_are_raised_to_what_a_texture_can_hold():
    axes = torch.eye(3)
    down = normalize(torch.tensor([[1.0, 0, -1]]))
    local = tangent_from_world(down, axes[2:], axes[:1], axes[1:2])
    assert NORMAL_MIN_Z * 0.9 < float(local[0, 2]) < 0.1
