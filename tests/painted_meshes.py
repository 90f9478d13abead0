"""One tetrahedron, painted in every way that an asset may be."""

from dataclasses import replace

import torch
from torch.nn.functional import normalize

from stages.artifacts import TexturedMesh
from svim3d.mesh.frames import tangent_frames


def textured_mesh(size=32, offset=(0.1, 0.2, -0.3)):
    """Off the origin, one corner of the texture per face, smooth maps."""
    corners = torch.tensor([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) * 0.4
    order = torch.tensor([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]])
    vertices = corners[order.reshape(-1)]
    faces = torch.arange(12).view(4, 3)
    normals = normalize(vertices, dim=1)
    inner = torch.tensor([[0.05, 0.05], [0.45, 0.05], [0.05, 0.45]])
    offsets = torch.tensor([[0.0, 0], [0.5, 0], [0, 0.5], [0.5, 0.5]])
    uv = (inner[None] + offsets[:, None]).reshape(-1, 2)
    row, column = torch.meshgrid(*(torch.linspace(0, 1, size),) * 2, indexing="ij")
    return TexturedMesh(
        vertices=vertices + torch.tensor(offset),
        faces=faces,
        normals=normals,
        uv=uv,
        tangents=tangent_frames(vertices, faces, normals, uv).tangents,
        basecolor=torch.stack([row, column, 0.5 * row], -1),
        orm=torch.stack([1 - 0.3 * row, 0.2 + 0.7 * column, row], -1),
        normal_tangent=normalize(torch.stack([0.4 * row, 0.2 * column, 1 + 0 * row], -1), dim=-1),
    )


def constant_mesh():
    """Gold: one value per map, no pictures."""
    return replace(
        textured_mesh(),
        uv=None,
        tangents=None,
        normal_tangent=None,
        basecolor=torch.tensor([1.0, 0.71, 0.29]),
        orm=torch.tensor([1.0, 0.3, 1.0]),
    )


def painted_mesh():
    """Coloured per vertex."""
    steps = torch.linspace(0.0, 1.0, 12)
    return replace(
        constant_mesh(),
        basecolor=torch.stack([steps, 1 - steps, 0.5 * steps], 1),
        orm=torch.stack([torch.ones(12), 0.2 + 0.5 * steps, 0.5 * steps], 1),
    )


def partly_constant_mesh():
    """Roughness is a picture; metallic and occlusion are left to the factor."""
    mesh = textured_mesh()
    orm = torch.stack([torch.ones(32, 32), mesh.orm[..., 1], torch.ones(32, 32)], -1)
    return replace(mesh, orm=orm, orm_factor=torch.tensor([1.0, 1.0, 0.25]))


KINDS = {
    "textured": textured_mesh,
    "constant": constant_mesh,
    "painted": painted_mesh,
    "partly constant": partly_constant_mesh,
}
