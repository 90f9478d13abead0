"""What every GLB of ours is put together from: accessors, pictures and the material."""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from svim3d.io.gltf import ALIGNMENT, pack_glb

BYTE, UNSIGNED_BYTE, SHORT, UNSIGNED_SHORT, UNSIGNED_INT, FLOAT = 5120, 5121, 5122, 5123, 5125, 5126
COMPONENTS = {"i1": BYTE, "u1": UNSIGNED_BYTE, "i2": SHORT, "u2": UNSIGNED_SHORT, "f4": FLOAT}
VERTEX_BUFFER, INDEX_BUFFER = 34962, 34963
LINEAR, LINEAR_MIPMAP_LINEAR, CLAMP_TO_EDGE = 9729, 9987, 33071
CONSTANT, PER_VERTEX, TEXTURE = 1, 2, 3  # dimensions of a material's values
FACTORS = ("roughnessFactor", "metallicFactor")
MAX_SHORT_VERTICES = 65535  # index 65535 itself restarts a primitive
PNG_MAGIC = b"\x89PNG"

Json = dict[str, Any]
Encode = Callable[..., bytes]  # of a picture in [0, 1], with `srgb`, to PNG or JPEG


def check_layout(
    basecolor: Tensor,
    orm: Tensor,
    uv: Tensor | None,
    tangents: Tensor | None,
    normal_tangent: Tensor | None,
) -> None:
    """Refuse what no glTF material can mean."""
    if (normal_tangent is None) != (tangents is None) or (tangents is not None and uv is None):
        raise ValueError("a normal map, tangents and uv go together: give all or neither")
    is_textured = TEXTURE in (basecolor.ndim, orm.ndim) or normal_tangent is not None
    if is_textured != (uv is not None):
        raise ValueError("textures and uv go together: give both or neither")
    if orm.ndim == CONSTANT and float(orm[0]) != 1.0:
        raise ValueError("occlusion needs a texture: glTF has no factor for it")


def glb_material(
    parts: "GlbParts",
    basecolor: Tensor,
    orm: Tensor,
    normal_tangent: Tensor | None,
    orm_factor: Tensor | None,
    encode: Encode,
) -> Json:
    """Factors and textures of the material."""
    factor = torch.ones(3) if orm_factor is None else orm_factor
    shading: Json = {}
    material: Json = {"pbrMetallicRoughness": shading}
    if basecolor.ndim == CONSTANT:
        shading["baseColorFactor"] = [*basecolor.clamp(0.0, 1.0).tolist(), 1.0]
    elif basecolor.ndim == TEXTURE:
        shading["baseColorTexture"] = parts.texture("basecolor", encode(basecolor, srgb=True))
    if orm.ndim == TEXTURE:
        reflects = orm_factor is None or bool((orm[..., 1:] < 1.0).any())
        occludes = bool((orm[..., 0] < 1.0).any())
        texture = parts.texture("orm", encode(orm)) if reflects or occludes else {}
        if reflects:
            shading["metallicRoughnessTexture"] = texture
        if occludes:
            material["occlusionTexture"] = dict(texture)
    else:
        factor = factor * (orm if orm.ndim == CONSTANT else orm.mean(0))
    for name, value in zip(FACTORS, factor[1:].clamp(0.0, 1.0).tolist(), strict=True):
        if value != 1.0 or orm.ndim != TEXTURE:
            shading[name] = value
    if normal_tangent is not None:
        material["normalTexture"] = parts.texture("normal", encode(normal_tangent * 0.5 + 0.5))
    return material


class GlbParts:
    """Collects what the document refers to by index."""

    def __init__(self) -> None:
        self._content = bytearray()
        self._lists: dict[str, list[Json]] = {
            "accessors": [],
            "bufferViews": [],
            "images": [],
            "textures": [],
            "samplers": [],
        }

    def append(self, kind: str, entry: Json) -> int:
        """Add to a list of the document; returns the index."""
        self._lists[kind].append(entry)
        return len(self._lists[kind]) - 1

    def view(self, content: bytes, target: int | None = None, **layout: int) -> int:
        """Add aligned bytes to the buffer; `layout` may give a stride."""
        self._content += b"\0" * (-len(self._content) % ALIGNMENT)
        entry: Json = {"buffer": 0, "byteOffset": len(self._content), "byteLength": len(content)}
        self._content += content
        return self.append(
            "bufferViews", entry | layout | ({} if target is None else {"target": target})
        )

    def floats(self, values: Tensor, *, bounds: bool = False) -> int:
        """A vertex attribute; `bounds` adds the extent that glTF wants of positions."""
        return self.attribute(values.detach().cpu().float().numpy().astype("<f4"), bounds=bounds)

    def attribute(
        self, values: NDArray[Any], *, bounds: bool = False, normalized: bool = True
    ) -> int:
        """A vertex attribute of any type; `normalized` integers stand for [-1, 1] or [0, 1]."""
        kind = values.dtype.str[1:]
        padding = -values.shape[1] * values.itemsize % ALIGNMENT // values.itemsize
        padded = np.pad(values, ((0, 0), (0, padding)))
        stride = {"byteStride": padded.shape[1] * values.itemsize} if padding else {}
        view = self.view(padded.tobytes(), VERTEX_BUFFER, **stride)
        return self.append(
            "accessors",
            {"bufferView": view} | accessor(values, kind, bounds, normalized=normalized),
        )

    def indices(self, faces: Tensor, vertices: int) -> int:
        """Triangle indices in the smallest type that holds them."""
        short = vertices <= MAX_SHORT_VERTICES
        array = faces.detach().cpu().numpy().reshape(-1).astype("<u2" if short else "<u4")
        return self.append(
            "accessors",
            {
                "bufferView": self.view(array.tobytes(), INDEX_BUFFER),
                "componentType": UNSIGNED_SHORT if short else UNSIGNED_INT,
                "count": len(array),
                "type": "SCALAR",
            },
        )

    def texture(self, name: str, picture: bytes) -> Json:
        """A reference to an embedded PNG or JPEG, trilinear, clamped at the border."""
        if not self._lists["samplers"]:
            sampler: Json = {"magFilter": LINEAR, "minFilter": LINEAR_MIPMAP_LINEAR}
            self.append("samplers", sampler | {"wrapS": CLAMP_TO_EDGE, "wrapT": CLAMP_TO_EDGE})
        mime = "image/png" if picture.startswith(PNG_MAGIC) else "image/jpeg"
        image = self.append(
            "images", {"name": name, "mimeType": mime, "bufferView": self.view(picture)}
        )
        return {"index": self.append("textures", {"sampler": 0, "source": image})}

    def pack(self, document: Json) -> bytes:
        """The finished file."""
        full: Json = {"asset": {"version": "2.0", "generator": "svim3d"}} | document
        full |= {kind: entries for kind, entries in self._lists.items() if entries}
        binary = bytes(self._content) + b"\0" * (-len(self._content) % ALIGNMENT)
        full["buffers"] = [{"byteLength": len(binary)}]
        return pack_glb(full, binary)


def accessor(values: NDArray[Any], kind: str, bounds: bool, *, normalized: bool = True) -> Json:
    """What is said of vertex values: their type, number and, on demand, extent."""
    entry: Json = {
        "componentType": COMPONENTS[kind],
        "count": len(values),
        "type": f"VEC{values.shape[1]}",
    }
    if kind != "f4" and normalized:
        entry["normalized"] = True
    if bounds:
        entry |= {"min": values.min(0).tolist(), "max": values.max(0).tolist()}
    return entry
