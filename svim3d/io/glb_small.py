"""The asset as a smaller GLB: quantised or compressed triangles, JPEG where PNG is longer.

Vertices are whole numbers of 16 bits in a cube around the object, which the node's scale undoes;
all else stands for [0, 1] or [-1, 1]. Tangents are left out where Draco compresses: a loader makes
the same ones, since they are MikkTSpace. Pictures are JPEG of full colour resolution, which glTF
knows without an extension. What each costs is in docs/exports.md.

Source: Khronos KHR_mesh_quantization and KHR_draco_mesh_compression.
"""

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from svim3d.io.draco import compress
from svim3d.io.glb_parts import (
    MAX_SHORT_VERTICES,
    PER_VERTEX,
    UNSIGNED_INT,
    UNSIGNED_SHORT,
    GlbParts,
    accessor,
    glb_material,
)
from svim3d.io.image import encode_smallest
from svim3d.mesh.painted_mesh import PaintedMesh

QUANTISED, DRACO = "KHR_mesh_quantization", "KHR_draco_mesh_compression"
# Largest errors of a quantised file: of positions in shares of the longest side, and of uv.
POSITION_STEP, UV_STEP = 0.26 / 32767, 0.51 / 65535
Json = dict[str, Any]


def small_glb_bytes(
    mesh: PaintedMesh, compression: Literal["quantised", "draco"], *, name: str = "asset"
) -> bytes:
    """A GLB as `svim3d.io.glb.glb_bytes` makes it, smaller; equal input gives equal bytes.

    Raises:
        ValueError: DracoPy is needed and not installed.
    """
    parts = GlbParts()
    frame = _Frame.around(mesh.vertices)
    if compression == "quantised":
        primitive, node = _quantised(parts, mesh, frame), frame.node()
        extension = QUANTISED
    else:
        primitive, node, extension = _compressed(parts, mesh), {}, DRACO
    maps = (mesh.basecolor, mesh.orm, mesh.normal_tangent, mesh.orm_factor)
    material = {"name": name, **glb_material(parts, *maps, encode_smallest)}
    return parts.pack(
        {
            "extensionsUsed": [extension],
            "extensionsRequired": [extension],
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": [{"name": name, "mesh": 0, **node}],
            "meshes": [{"name": name, "primitives": [{**primitive, "material": 0}]}],
            "materials": [material],
        }
    )


@dataclass(frozen=True)
class _Frame:
    """The cube that 16-bit positions fill."""

    centre: NDArray[np.float64]
    half: float

    @classmethod
    def around(cls, vertices: Tensor) -> "_Frame":
        """The smallest one; a scale alike for all axes leaves normals as they are."""
        low, high = vertices.amin(0).double().numpy(), vertices.amax(0).double().numpy()
        return cls((low + high) / 2, float((high - low).max()) / 2)

    def node(self) -> Json:
        """What the node has to undo."""
        return {"translation": self.centre.tolist(), "scale": [self.half / np.iinfo("i2").max] * 3}


def _quantised(parts: GlbParts, mesh: PaintedMesh, frame: _Frame) -> Json:
    """Attributes of 16 bits, tangents of 8: they turn a normal map, no outline."""
    positions = (_floats(mesh.vertices) - frame.centre) / frame.half
    attributes = {
        "POSITION": parts.attribute(_integers(positions, "i2"), bounds=True, normalized=False),
        "NORMAL": parts.attribute(_integers(_floats(mesh.normals), "i2")),
    }
    if mesh.tangents is not None:
        attributes["TANGENT"] = parts.attribute(_integers(_floats(mesh.tangents), "i1"))
    if mesh.basecolor.ndim == PER_VERTEX:
        attributes["COLOR_0"] = parts.attribute(_integers(_floats(mesh.basecolor), "u2"))
    if mesh.uv is not None:
        uv = _floats(mesh.uv)
        fits = uv.min() >= 0.0 and uv.max() <= 1.0  # else a texture repeats
        values = _integers(uv, "u2") if fits else uv.astype("<f4")
        attributes["TEXCOORD_0"] = parts.attribute(values)
    return {"attributes": attributes, "indices": parts.indices(mesh.faces, len(mesh.vertices))}


def _compressed(parts: GlbParts, mesh: PaintedMesh) -> Json:
    """Accessors without bytes of their own: the loader fills them from Draco's."""
    is_painted = mesh.basecolor.ndim == PER_VERTEX
    made = compress(
        _floats(mesh.vertices).astype(np.float32),
        mesh.faces.cpu().numpy().astype(np.uint32),
        _floats(mesh.normals).astype(np.float32),
        None if mesh.uv is None else _floats(mesh.uv).astype(np.float32),
        _integers(_floats(mesh.basecolor), "u2") if is_painted else None,
    )
    kinds = {"POSITION": ("f4", 3), "NORMAL": ("f4", 3), "TEXCOORD_0": ("f4", 2)}
    kinds["COLOR_0"] = ("u2", 3)
    attributes = {}
    for attribute in made.ids:
        kind, width = kinds[attribute]
        values = np.zeros((len(made.vertices), width), kind)
        bounds = attribute == "POSITION"
        entry = accessor(made.vertices if bounds else values, kind, bounds)
        attributes[attribute] = parts.append("accessors", entry)
    short = len(made.vertices) <= MAX_SHORT_VERTICES
    indices = {
        "componentType": UNSIGNED_SHORT if short else UNSIGNED_INT,
        "count": made.faces * 3,
        "type": "SCALAR",
    }
    return {
        "attributes": attributes,
        "indices": parts.append("accessors", indices),
        "extensions": {DRACO: {"bufferView": parts.view(made.content), "attributes": made.ids}},
    }


def _integers(values: NDArray[np.float64], kind: str) -> NDArray[Any]:
    """[-1, 1], or [0, 1] where `kind` knows no sign, as integers of full range."""
    limit = np.iinfo(kind).max
    low = 0.0 if kind.startswith("u") else -1.0
    return (np.clip(values, low, 1.0) * limit).round().astype(f"<{kind}")


def _floats(values: Tensor) -> NDArray[np.float64]:
    return values.detach().cpu().double().numpy()
