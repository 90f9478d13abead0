"""The mesh door: any common mesh file in, one self-contained glTF binary out.

The writer is our own: a GLB is a JSON chunk and a buffer, and only so are the bytes a function of
the content alone (no time stamps, no dictionary order of a library), tangents and normal maps are
written as given, and the Khronos validator finds nothing to remark. Reading back is tested with
other libraries.
"""

import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import trimesh
from jaxtyping import Float, Int
from torch import Tensor

from svim3d.color import linear_from_srgb
from svim3d.io.glb_parts import (
    CONSTANT,
    FACTORS,
    PER_VERTEX,
    GlbParts,
    check_layout,
    glb_material,
)
from svim3d.io.gltf import read_gltf
from svim3d.io.image import encode_png, encode_small_png
from svim3d.io.obj import read_obj
from svim3d.mesh.source_mesh import SourceMesh
from svim3d.numerics import normalize


def read_mesh(file: Path) -> SourceMesh:
    """Read a .glb, .gltf or .obj file with its materials.

    Raises:
        ValueError: the file is missing, of another kind, damaged, or without triangles.
    """
    readers = {".glb": read_gltf, ".gltf": read_gltf, ".obj": read_obj}
    if file.suffix.lower() not in readers:
        raise ValueError(
            f"{file.name} is no mesh that can be read; wanted one of {', '.join(readers)}"
        )
    if not file.is_file():
        raise ValueError(f"there is no mesh file {file}")
    mesh = readers[file.suffix.lower()](file)
    if not all(bool(torch.isfinite(a).all()) for a in (mesh.vertices, mesh.normals, mesh.uv)):
        raise ValueError(f"{file.name} holds NaN or infinite vertices; repair it before use")
    return mesh


def glb_bytes(
    *,
    vertices: Float[Tensor, "N 3"],
    faces: Int[Tensor, "F 3"],
    normals: Float[Tensor, "N 3"],
    basecolor: Float[Tensor, "*texels 3"],
    orm: Float[Tensor, "*orm_texels 3"],
    uv: Float[Tensor, "N 2"] | None = None,
    tangents: Float[Tensor, "N 4"] | None = None,
    normal_tangent: Float[Tensor, "M M 3"] | None = None,
    orm_factor: Float[Tensor, "3"] | None = None,
    name: str = "asset",
) -> bytes:
    """A GLB with one mesh and one metallic-roughness material; equal input gives equal bytes.

    `basecolor` and `orm` are textures [T, T, 3], which need `uv`; or one value [3], which becomes
    the material's factors; or per vertex [N, 3]: the colour becomes COLOR_0, and since glTF knows
    no roughness per vertex, the material takes the mean roughness and metallic of all vertices.

    Args:
        vertices: positions.
        faces: counter-clockwise seen from outside.
        normals: unit.
        basecolor: linear in [0, 1]; a texture is stored with the sRGB curve, 8 bit.
        orm: occlusion, roughness, metallic in [0, 1]; a texture is stored as it is, 8 bit. One
            value's occlusion must be 1: glTF has no factor for it.
        uv: glTF texture coordinates, origin at the top left.
        tangents: MikkTSpace tangent and handedness.
        normal_tangent: unit, green up; needs `tangents`.
        orm_factor: multiplies `orm`, the constant channels of which are 1; where it is given,
            pictures are stored as small as they go.
        name: of the node, mesh and material.
    """
    check_layout(basecolor, orm, uv, tangents, normal_tangent)
    parts = GlbParts()
    attributes = {
        "POSITION": parts.floats(vertices, bounds=True),
        "NORMAL": parts.floats(normalize(normals)),
    }
    if tangents is not None:
        attributes["TANGENT"] = parts.floats(
            torch.cat([normalize(tangents[:, :3]), tangents[:, 3:]], 1)
        )
    if basecolor.ndim == PER_VERTEX:
        attributes["COLOR_0"] = parts.floats(basecolor.clamp(0.0, 1.0))
    if uv is not None:
        attributes["TEXCOORD_0"] = parts.floats(uv)
    encode = encode_png if orm_factor is None else encode_small_png
    material = glb_material(parts, basecolor, orm, normal_tangent, orm_factor, encode)
    primitive = {
        "attributes": attributes,
        "indices": parts.indices(faces, len(vertices)),
        "material": 0,
    }
    return parts.pack(
        {
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": [{"name": name, "mesh": 0}],
            "meshes": [{"name": name, "primitives": [primitive]}],
            "materials": [{"name": name, **material}],
        }
    )


@dataclass(frozen=True)
class ReopenedGlb:
    """What another reader (trimesh) makes of a GLB, in the terms of `glb_bytes`.

    Attributes:
        vertices: positions.
        faces: vertex indices.
        uv: glTF texture coordinates, or None.
        basecolor: linear; texture, per vertex, or one colour to 8 bits.
        orm: texture times factors, or the factors alone, occlusion being 1.
        normal_tangent: texture, or None.
    """

    vertices: Float[Tensor, "N 3"]
    faces: Int[Tensor, "F 3"]
    uv: Float[Tensor, "N 2"] | None
    basecolor: Float[Tensor, "*texels 3"]
    orm: Float[Tensor, "*orm_texels 3"]
    normal_tangent: Float[Tensor, "M M 3"] | None


def reopen_glb(content: bytes) -> ReopenedGlb:
    """Read a GLB of one mesh with trimesh, to check what was written."""
    scene = trimesh.load(io.BytesIO(content), file_type="glb", process=False, force="scene")
    (mesh,) = scene.geometry.values()
    material = getattr(mesh.visual, "material", None)

    def texture(name: str) -> Tensor | None:
        picture = getattr(material, name, None)
        if picture is None:
            return None
        return torch.from_numpy(np.asarray(picture.convert("RGB"), np.float32) / 255.0)

    basecolor, normal = texture("baseColorTexture"), texture("normalTexture")
    if basecolor is not None:
        painted = linear_from_srgb(basecolor)
    elif "color" in getattr(mesh.visual, "vertex_attributes", {}):
        colors = mesh.visual.vertex_attributes["color"]  # COLOR_0, linear as stored
        painted = torch.from_numpy(np.array(colors, np.float32))
    else:
        colour = np.asarray(getattr(material, "baseColorFactor", None), np.float32)[:3]
        painted = torch.from_numpy(colour / 255.0)
    factors = [getattr(material, name, None) for name in FACTORS]
    orm = torch.tensor([1.0, *(1.0 if f is None else f for f in factors)])
    for name, channels in (("metallicRoughnessTexture", [1, 2]), ("occlusionTexture", [0])):
        picture = texture(name)
        if picture is not None:
            if orm.ndim == CONSTANT:
                orm = orm.expand_as(picture).clone()
            orm[..., channels] *= picture[..., channels]
    uv = getattr(mesh.visual, "uv", None)
    # trimesh turns v upwards.
    upright = None if uv is None else np.asarray(uv, np.float64) * [1.0, -1.0] + [0.0, 1.0]
    return ReopenedGlb(
        vertices=torch.from_numpy(np.asarray(mesh.vertices, np.float32)),
        faces=torch.from_numpy(np.asarray(mesh.faces, np.int64)),
        uv=None if upright is None else torch.from_numpy(upright.astype(np.float32)),
        basecolor=painted,
        orm=orm,
        normal_tangent=None if normal is None else normal * 2.0 - 1.0,
    )
