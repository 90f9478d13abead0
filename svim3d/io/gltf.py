"""Reading glTF 2.0 (.glb, .gltf): geometry in world space, metallic-roughness materials.

Source: Khronos glTF 2.0 specification. Understood beyond the core: EXT_texture_webp,
KHR_mesh_quantization, KHR_texture_transform. Ignored: emission, occlusion, opacity, skins, morphs.
"""

import base64
import json
import struct
import urllib.parse
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from svim3d.color import linear_from_srgb
from svim3d.io.image import decode_image
from svim3d.mesh.source_mesh import SourceMaterial, SourceMesh, complete, merge
from svim3d.numerics import normalize

Json = dict[str, Any]

GLB_MAGIC = b"glTF"
JSON_CHUNK, BINARY_CHUNK = b"JSON", b"BIN\0"
GLTF_VERSION = 2
ALIGNMENT = 4  # chunks and accessors start on multiples of their component size
COMPONENTS: dict[int, type[np.generic]] = {
    5120: np.int8,
    5121: np.uint8,
    5122: np.int16,
    5123: np.uint16,
    5125: np.uint32,
    5126: np.float32,
}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
TRIANGLES, TRIANGLE_STRIP, TRIANGLE_FAN = 4, 5, 6
UNDERSTOOD = {
    "EXT_texture_webp",
    "KHR_mesh_quantization",
    "KHR_texture_transform",
    # These change the look but not what is read here.
    "KHR_materials_emissive_strength",
    "KHR_materials_ior",
    "KHR_materials_specular",
    "KHR_materials_clearcoat",
    "KHR_materials_variants",
}


def read_gltf(file: Path) -> SourceMesh:
    """Read every triangle of a file's scene.

    Raises:
        ValueError: the file is damaged, holds no triangles, or needs an unknown extension.
    """
    return _mesh(file.read_bytes(), file.name, file.parent)


def parse_glb(content: bytes) -> SourceMesh:
    """Read a file that is in memory and refers to no other; see `read_gltf`."""
    return _mesh(content, "the .glb", Path())


def _mesh(content: bytes, name: str, folder: Path) -> SourceMesh:
    document, binary = _container(content, name)
    unknown = set(document.get("extensionsRequired", [])) - UNDERSTOOD
    if unknown:
        raise ValueError(
            f"{name} needs the glTF extension {', '.join(sorted(unknown))}, which is not "
            "supported; export it without compression"
        )
    try:
        return _Reader(document, binary, folder).mesh()
    except (KeyError, IndexError, struct.error, TypeError, AttributeError) as error:
        raise ValueError(f"{name} is no valid glTF 2.0 file: {error!r}") from error


def _container(content: bytes, name: str) -> tuple[Json, bytes]:
    """The JSON document and, for a GLB, its binary chunk."""
    if content[:4] != GLB_MAGIC:
        try:
            document: Json = json.loads(content)
        except ValueError as error:
            raise ValueError(f"{name} is neither a GLB nor glTF JSON: {error}") from error
        return document, b""
    chunks: dict[bytes, bytes] = {}
    offset = 12
    while offset + 8 <= len(content):
        length = struct.unpack_from("<I", content, offset)[0]
        if offset + 8 + length > len(content):
            raise ValueError(f"{name} is cut short: a chunk ends beyond the file")
        chunks[content[offset + 4 : offset + 8]] = content[offset + 8 : offset + 8 + length]
        offset += 8 + length
    if JSON_CHUNK not in chunks:
        raise ValueError(f"{name} is a GLB without a JSON chunk")
    return json.loads(chunks[JSON_CHUNK]), chunks.get(BINARY_CHUNK, b"")


def pack_glb(document: Json, binary: bytes) -> bytes:
    """A GLB of a JSON document and, unless it is empty, the file's own buffer."""
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % ALIGNMENT)
    body = struct.pack("<I", len(text)) + JSON_CHUNK + text
    if binary:
        binary += b"\0" * (-len(binary) % ALIGNMENT)
        body += struct.pack("<I", len(binary)) + BINARY_CHUNK + binary
    return GLB_MAGIC + struct.pack("<II", GLTF_VERSION, 12 + len(body)) + body


class _Reader:
    """Resolves the indices of one document."""

    def __init__(self, document: Json, binary: bytes, folder: Path) -> None:
        self._document = document
        self._folder = folder
        self._buffers = [
            self._uri(entry["uri"]) if "uri" in entry else binary
            for entry in document.get("buffers", [])
        ]
        self._images: dict[int, Tensor] = {}

    def mesh(self) -> SourceMesh:
        """All triangles of the default scene (or of every root, when there is none)."""
        materials = tuple(self._material(m) for m in self._document.get("materials", []))
        materials += (SourceMaterial(),)  # what a primitive without a material gets
        nodes = self._document.get("nodes", [])
        scenes = self._document.get("scenes", [])
        children = {child for node in nodes for child in node.get("children", [])}
        roots = (
            scenes[self._document.get("scene", 0)].get("nodes", [])
            if scenes
            else [index for index in range(len(nodes)) if index not in children]
        )
        parts: list[SourceMesh] = []
        pending = [(root, np.eye(4)) for root in reversed(roots)]
        while pending:
            index, above = pending.pop()
            world = above @ _local_transform(nodes[index])
            pending += [(child, world) for child in reversed(nodes[index].get("children", []))]
            # A scale of zero is how some tools hide a part.
            if "mesh" in nodes[index] and np.linalg.det(world[:3, :3]) != 0:
                for primitive in self._document["meshes"][nodes[index]["mesh"]]["primitives"]:
                    if primitive.get("mode", TRIANGLES) >= TRIANGLES:
                        parts.append(self._primitive(primitive, world, materials))
        if not parts or not sum(len(part.faces) for part in parts):
            raise ValueError("the file holds no triangles")
        return merge(parts)

    def _primitive(
        self, primitive: Json, world: NDArray[np.float64], materials: tuple[SourceMaterial, ...]
    ) -> SourceMesh:
        """One primitive in world space."""
        attributes = {
            name: self._accessor(index) for name, index in primitive["attributes"].items()
        }
        index = primitive.get("material", len(materials) - 1)
        position = attributes["POSITION"]
        order = (
            self._accessor(primitive["indices"]).reshape(-1).astype(np.int64)
            if "indices" in primitive
            else np.arange(len(position))
        )
        faces = _triangles(order, primitive.get("mode", TRIANGLES))
        if len(faces) and faces.max() >= len(position):
            raise ValueError("an index points beyond the vertices")
        linear = world[:3, :3]
        if np.linalg.det(linear) < 0:  # a mirroring node turns the winding
            faces = faces[:, [0, 2, 1]]
        normal, tangent = attributes.get("NORMAL"), attributes.get("TANGENT")
        texture_set, transform = self._uv_choice(primitive.get("material"))
        uv = attributes.get(f"TEXCOORD_{texture_set}")
        color = attributes.get("COLOR_0")
        if tangent is not None:
            turned = _unit(_tensor(tangent[:, :3] @ linear.T))
            sign = np.sign(np.linalg.det(linear)) * tangent[:, 3:]
            tangent = np.concatenate([turned.numpy(), sign.astype(np.float32)], 1)
        return complete(
            _tensor(position @ linear.T + world[:3, 3]),
            torch.from_numpy(faces.astype(np.int32)),
            material=index,
            materials=materials,
            # Normals go with the inverse transpose, which keeps them outward under mirroring.
            normals=None if normal is None else _unit(_tensor(normal @ np.linalg.inv(linear))),
            uv=None if uv is None else _tensor(uv @ transform[:2, :2].T + transform[:2, 2]),
            tangents=None if tangent is None else _tensor(tangent),
            colors=None if color is None else _tensor(color[:, :3]),
        )

    def _uv_choice(self, material: int | None) -> tuple[int, NDArray[np.float64]]:
        """Texture coordinate set and transform that all textures of a material share."""
        if material is None:
            return 0, np.eye(3)
        entry = self._document["materials"][material]
        shading = entry.get("pbrMetallicRoughness", {})
        used = [
            texture
            for texture in (
                shading.get("baseColorTexture"),
                shading.get("metallicRoughnessTexture"),
                entry.get("normalTexture"),
            )
            if texture is not None
        ]
        choices = []
        for texture in used:
            extension = texture.get("extensions", {}).get("KHR_texture_transform", {})
            chosen = extension.get("texCoord", texture.get("texCoord", 0))
            choices.append((chosen, _uv_transform(extension)))
        if any(c[0] != choices[0][0] or not np.allclose(c[1], choices[0][1]) for c in choices):
            raise ValueError(
                f"material {entry.get('name', material)!r} maps its textures differently; "
                "bake them to one set of texture coordinates"
            )
        return choices[0] if choices else (0, np.eye(3))

    def _material(self, entry: Json) -> SourceMaterial:
        """Factors and decoded textures of one material."""
        shading = entry.get("pbrMetallicRoughness", {})
        basecolor = self._texture(shading.get("baseColorTexture"))
        orm = self._texture(shading.get("metallicRoughnessTexture"))
        normal = self._texture(entry.get("normalTexture"))
        if normal is not None:
            scale = float(entry["normalTexture"].get("scale", 1.0))
            normal = normalize((normal * 2.0 - 1.0) * torch.tensor([scale, scale, 1.0]))
        red, green, blue = shading.get("baseColorFactor", [1.0] * 4)[:3]
        return SourceMaterial(
            basecolor_factor=(float(red), float(green), float(blue)),
            roughness_factor=float(shading.get("roughnessFactor", 1.0)),
            metallic_factor=float(shading.get("metallicFactor", 1.0)),
            basecolor=None if basecolor is None else linear_from_srgb(basecolor),
            roughness_metallic=None if orm is None else orm[..., 1:].contiguous(),
            normal_tangent=normal,
        )

    def _texture(self, reference: Json | None) -> Float[Tensor, "H W 3"] | None:
        """Stored values in [0, 1] of a texture."""
        if reference is None:
            return None
        texture = self._document["textures"][reference["index"]]
        webp = texture.get("extensions", {}).get("EXT_texture_webp", {})
        image = int(webp.get("source", texture.get("source", -1)))
        if image < 0:
            raise ValueError("a texture has no image in a supported format (PNG, JPEG, WebP)")
        if image not in self._images:
            self._images[image] = self._image(self._document["images"][image])
        return self._images[image]

    def _image(self, entry: Json) -> Float[Tensor, "H W 3"]:
        """Decode one image."""
        content = self._uri(entry["uri"]) if "uri" in entry else self._view(entry["bufferView"])[0]
        decoded = decode_image(content)
        if decoded.shape[-1] < 3:  # grey, perhaps with opacity
            return decoded[..., :1].expand(*decoded.shape[:2], 3)
        return decoded[..., :3]

    def _uri(self, uri: str) -> bytes:
        """Content of a data URI or of a file beside the document."""
        if uri.startswith("data:"):
            return base64.b64decode(uri.partition(",")[2])
        return (self._folder / urllib.parse.unquote(uri)).read_bytes()

    def _view(self, index: int) -> tuple[bytes, int]:
        """Bytes of a buffer view and its stride (0 when tightly packed)."""
        view = self._document["bufferViews"][index]
        start = view.get("byteOffset", 0)
        content = self._buffers[view["buffer"]][start : start + view["byteLength"]]
        return content, view.get("byteStride", 0)

    def _accessor(self, index: int) -> NDArray[Any]:
        """Values [count, width]; normalised integers become floats."""
        entry = self._document["accessors"][index]
        kind = np.dtype(COMPONENTS[entry["componentType"]]).newbyteorder("<")
        width, count = WIDTHS[entry["type"]], entry["count"]
        values = np.zeros((count, width), kind)
        if "bufferView" in entry:
            content, stride = self._view(entry["bufferView"])
            values = _strided(content, entry.get("byteOffset", 0), stride, kind, (count, width))
        if "sparse" in entry:
            values = values.copy()
            where, what, total = (entry["sparse"][k] for k in ("indices", "values", "count"))
            row_kind = np.dtype(COMPONENTS[where["componentType"]]).newbyteorder("<")
            content, _ = self._view(where["bufferView"])
            rows = _strided(content, where.get("byteOffset", 0), 0, row_kind, (total, 1))[:, 0]
            content, _ = self._view(what["bufferView"])
            values[rows] = _strided(content, what.get("byteOffset", 0), 0, kind, (total, width))
        if entry.get("normalized", False):
            limit = np.iinfo(kind).max
            return np.maximum(values.astype(np.float64) / limit, -1.0)
        return values


def _strided(
    content: bytes, offset: int, stride: int, kind: np.dtype[Any], shape: tuple[int, int]
) -> NDArray[Any]:
    """A two-dimensional view of interleaved bytes."""
    step = stride or kind.itemsize * shape[1]
    if shape[0] and offset + step * (shape[0] - 1) + kind.itemsize * shape[1] > len(content):
        raise ValueError("an accessor reads beyond its buffer")
    return np.ndarray(shape, kind, content, offset, (step, kind.itemsize))


def _triangles(order: NDArray[np.int64], mode: int) -> NDArray[np.int64]:
    """Faces of a triangle list, strip or fan."""
    if mode == TRIANGLES:
        return order[: len(order) // 3 * 3].reshape(-1, 3)
    if len(order) < 3:
        return np.zeros((0, 3), np.int64)
    if mode == TRIANGLE_FAN:
        first = np.full(len(order) - 2, order[0])
        return np.stack([order[1:-1], order[2:], first], 1)
    faces = np.stack([order[:-2], order[1:-1], order[2:]], 1)
    faces[1::2] = faces[1::2][:, [0, 2, 1]]  # every other triangle of a strip winds backwards
    return faces


def _local_transform(node: Json) -> NDArray[np.float64]:
    """A node's 4 x 4 transform: its matrix, or translation * rotation * scale."""
    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T
    x, y, z, w = node.get("rotation", [0.0, 0.0, 0.0, 1.0])
    transform = np.eye(4)
    transform[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    transform[:3, :3] *= np.array(node.get("scale", [1.0, 1.0, 1.0]))
    transform[:3, 3] = node.get("translation", [0.0, 0.0, 0.0])
    return transform


def _uv_transform(extension: Json) -> NDArray[np.float64]:
    """KHR_texture_transform as a 3 x 3 matrix: translation * rotation * scale."""
    angle = float(extension.get("rotation", 0.0))
    scale_u, scale_v = extension.get("scale", [1.0, 1.0])
    offset_u, offset_v = extension.get("offset", [0.0, 0.0])
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.array(
        [
            [cosine * scale_u, sine * scale_v, offset_u],
            [-sine * scale_u, cosine * scale_v, offset_v],
            [0.0, 0.0, 1.0],
        ]
    )


def _tensor(values: NDArray[Any]) -> Tensor:
    # A copy: packed float attributes are views into the file's bytes, which cannot be written.
    return torch.from_numpy(np.array(values, np.float32, order="C"))


def _unit(vectors: Tensor) -> Tensor:
    """Unit vectors of any magnitude: a model in micrometres has tiny cofactors."""
    largest = vectors.abs().amax(-1, keepdim=True)
    return normalize(vectors / torch.where(largest > 0, largest, 1.0))
