"""A mesh as an artist made it: one triangle soup with several metallic-roughness materials."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from svim3d.mesh.frames import tangent_frames
from svim3d.mesh.mesh import vertex_normals

MIN_EXTENT = 1e-9  # a mesh below this, in its own unit, is a point


@dataclass(frozen=True)
class SourceMaterial:
    """A glTF metallic-roughness material. Emission and transparency are left out.

    A texture multiplies its factor; None means that there is no texture. Textures repeat outside
    [0, 1].

    Attributes:
        basecolor_factor: linear.
        roughness_factor: perceptual.
        metallic_factor: in [0, 1].
        basecolor: linear in [0, 1].
        roughness_metallic: roughness and metallic, in [0, 1].
        normal_tangent: unit tangent-space normals, green up, the material's scale applied.
    """

    basecolor_factor: tuple[float, float, float] = (1.0, 1.0, 1.0)
    roughness_factor: float = 1.0
    metallic_factor: float = 1.0
    basecolor: Float[Tensor, "H W 3"] | None = None
    roughness_metallic: Float[Tensor, "H2 W2 2"] | None = None
    normal_tangent: Float[Tensor, "H3 W3 3"] | None = None


@dataclass(frozen=True)
class SourceMesh:
    """All primitives of a file, node transforms applied, in one index space.

    Attributes:
        vertices: world positions, in the file's unit.
        faces: counter-clockwise seen from outside.
        normals: unit.
        uv: glTF texture coordinates (origin top left); zero where a primitive has none.
        tangents: unit tangent and handedness (+1 or -1); zero where the material has no normal map.
        colors: linear colour that multiplies the basecolor; one where there is none.
        face_material: index into `materials`.
        materials: at least one.
    """

    vertices: Float[Tensor, "N 3"]
    faces: Int[Tensor, "F 3"]
    normals: Float[Tensor, "N 3"]
    uv: Float[Tensor, "N 2"]
    tangents: Float[Tensor, "N 4"]
    colors: Float[Tensor, "N 3"]
    face_material: Int[Tensor, "F"]
    materials: tuple[SourceMaterial, ...]


def normalised(mesh: SourceMesh, name: str) -> SourceMesh:
    """The same mesh, centred, with its bounding box's longest side 1; `name` is for the message.

    Raises:
        ValueError: the mesh has no extent.
    """
    used = mesh.vertices[torch.unique(mesh.faces.long())]
    low, high = used.amin(0), used.amax(0)
    extent = float((high - low).max())
    if not extent > MIN_EXTENT:
        raise ValueError(f"wanted a mesh with an extent, but all of {name} lies in one point")
    return replace(mesh, vertices=(mesh.vertices - (low + high) / 2) / extent)


def merge(parts: Sequence[SourceMesh]) -> SourceMesh:
    """Concatenate meshes that share one material list."""
    starts = [0]
    for part in parts:
        starts.append(starts[-1] + len(part.vertices))
    return SourceMesh(
        vertices=torch.cat([p.vertices for p in parts]),
        faces=torch.cat([p.faces + start for p, start in zip(parts, starts, strict=False)]),
        normals=torch.cat([p.normals for p in parts]),
        uv=torch.cat([p.uv for p in parts]),
        tangents=torch.cat([p.tangents for p in parts]),
        colors=torch.cat([p.colors for p in parts]),
        face_material=torch.cat([p.face_material for p in parts]),
        materials=parts[0].materials,
    )


def complete(
    vertices: Float[Tensor, "N 3"],
    faces: Int[Tensor, "F 3"],
    *,
    material: int,
    materials: tuple[SourceMaterial, ...],
    normals: Float[Tensor, "N 3"] | None = None,
    uv: Float[Tensor, "N 2"] | None = None,
    tangents: Float[Tensor, "N 4"] | None = None,
    colors: Float[Tensor, "N 3"] | None = None,
) -> SourceMesh:
    """Fill in what a primitive leaves out: smooth normals, MikkTSpace tangents, white colour.

    Normals are computed over welded positions, so that a mesh split along texture seams stays
    smooth across them.
    """
    count = len(vertices)
    if normals is None:
        welded, index = torch.unique(vertices, dim=0, return_inverse=True)
        normals = vertex_normals(welded, index[faces.long()])[index]
    has_uv = uv is not None
    uv = torch.zeros(count, 2) if uv is None else uv
    colors = torch.ones(count, 3) if colors is None else colors
    if tangents is None and has_uv and materials[material].normal_tangent is not None:
        frames = tangent_frames(vertices, faces, normals, uv)
        source, faces, tangents = frames.vertex_source.long(), frames.faces, frames.tangents
        vertices, normals, uv, colors = (a[source] for a in (vertices, normals, uv, colors))
    return SourceMesh(
        vertices=vertices,
        faces=faces,
        normals=normals,
        uv=uv,
        tangents=torch.zeros(len(vertices), 4) if tangents is None else tangents,
        colors=colors,
        face_material=torch.full((len(faces),), material, dtype=torch.int32),
        materials=materials,
    )
