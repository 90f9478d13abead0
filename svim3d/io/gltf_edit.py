"""Changing the materials of a GLB and nothing else.

Geometry, nodes, animations and extensions stay as they are: only factors, textures and the images
behind them are touched. What a texture holds besides (opacity, occlusion) is kept.
"""

import json
import struct
from collections.abc import Callable, Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import interpolate

from svim3d.color import linear_from_srgb
from svim3d.io.gltf import BINARY_CHUNK, GLB_MAGIC, JSON_CHUNK
from svim3d.io.image import decode_image, encode_png
from svim3d.shading.material_edits import Edit, apply_edits

Json = dict[str, Any]

ALIGNMENT = 4  # of chunks, and of buffer views with any component type
# Extensions of the whole file that name no textures; beside others, old images are kept.
HARMLESS = {"KHR_materials_variants", "KHR_lights_punctual"}
PAINTED_SIZE = 1024  # of the textures that a material without any gets for a region
ROUGHNESS, METALLIC = 1, 2  # channels of a metallic-roughness texture
# Share of each edit per texel of one material's textures, and at which size it is wanted.
MaskOf = Callable[[int, int, int], Float[Tensor, "H W 1"] | None]


def edit_glb(
    content: bytes, edits: Sequence[Edit], mask_of: MaskOf | None = None
) -> tuple[bytes, list[str]]:
    """A GLB with all materials edited.

    An edit acts on the product of a texture and its factor. Materials without textures keep their
    factors where the edit is for everything; else they get textures.

    Args:
        content: of a .glb file.
        edits: in order.
        mask_of: region in texture space, asked for as (material, height, width); None for a
            material that is not touched. Without it everything is edited.

    Returns:
        The new file and messages; see `apply_edits`.

    Raises:
        ValueError: it is no GLB with materials, or a region is wanted without texture coordinates.
    """
    document = _Document(content)
    materials = document.json.get("materials", [])
    if not materials:
        raise ValueError("the file has no materials to edit")
    primitives = [p for mesh in document.json.get("meshes", []) for p in mesh["primitives"]]
    if mask_of is not None and not any("TEXCOORD_0" in p["attributes"] for p in primitives):
        raise ValueError("a region needs texture coordinates, and the asset has none; unwrap it")
    notices = []
    for index, material in enumerate(materials):
        editor = _MaterialEditor(document, material, index)
        for notice in editor.edit(edits, mask_of):
            notices.append(f"{material.get('name', f'material {index}')}: {notice}")
    if any("COLOR_0" in p["attributes"] for p in primitives) and _touches(edits, "basecolor"):
        notices.append("vertex colours go on tinting the edited basecolor")
    return document.pack(), notices


def _touches(edits: Sequence[Edit], *channels: str) -> bool:
    return any(edit.channel in channels for edit in edits)


class _MaterialEditor:
    """Edits one material in place."""

    def __init__(self, document: "_Document", material: Json, index: int) -> None:
        self._document = document
        self._index = index
        self._shading: Json = material.setdefault("pbrMetallicRoughness", {})
        self._basecolor = document.texture(self._shading.get("baseColorTexture"))
        self._orm = document.texture(self._shading.get("metallicRoughnessTexture"))

    def edit(self, edits: Sequence[Edit], mask_of: MaskOf | None) -> list[str]:
        """Apply all edits; returns the messages."""
        size = self._size(has_region=mask_of is not None)
        mask = None if mask_of is None else mask_of(self._index, *size)
        if mask_of is not None and mask is None:
            return []
        before = self._images(size)
        after, notices = apply_edits(before, edits, mask)
        flat = mask is None
        if _touches(edits, "basecolor") and not (flat and self._scale("basecolor", edits)):
            self._write_basecolor(after["basecolor"], flat=flat and self._basecolor is None)
        changed = [
            name
            for name in ("roughness", "metallic")
            if _touches(edits, name) and not (flat and self._scale(name, edits))
        ]
        if changed:
            self._write_roughness_metallic(after, flat=flat and self._orm is None)
        return notices

    def _scale(self, channel: str, edits: Sequence[Edit]) -> bool:
        """Change a channel's factor alone, where edits only scale it and it stays below one."""
        mine = [edit for edit in edits if edit.channel == channel]
        name = "baseColorFactor" if channel == "basecolor" else f"{channel}Factor"
        given = self._shading.get(name, [1.0] * 4 if channel == "basecolor" else 1.0)
        factor = torch.tensor(given[:3] if channel == "basecolor" else [given])
        for edit in mine:
            factor = edit.apply(factor)
        within = bool(((factor >= 0.0) & (factor <= 1.0)).all())
        if not within or any(edit.operator not in "*/" for edit in mine):
            return False
        scaled = factor.tolist()
        self._shading[name] = [*scaled, given[3]] if channel == "basecolor" else scaled[0]
        return True

    def _size(self, *, has_region: bool) -> tuple[int, int]:
        """Rows and columns at which the material is edited: those of its largest texture."""
        sizes = [tuple(t.shape[:2]) for t in (self._basecolor, self._orm) if t is not None]
        side = PAINTED_SIZE if has_region else 1
        height, width = max(sizes, default=(side, side))
        return int(height), int(width)

    def _images(self, size: tuple[int, int]) -> dict[str, Tensor]:
        """Basecolor, roughness and metallic as glTF means them, at one size."""
        factor = torch.tensor(self._shading.get("baseColorFactor", [1.0] * 4)[:3])
        colour = torch.ones(*size, 3)
        if self._basecolor is not None:
            colour = _resized(linear_from_srgb(self._basecolor[..., :3]), size)
        planes = {"roughness": ROUGHNESS, "metallic": METALLIC}
        images = {"basecolor": colour * factor}
        for name, channel in planes.items():
            plane = torch.ones(*size, 1)
            if self._orm is not None:
                plane = _resized(self._orm[..., channel : channel + 1], size)
            images[name] = plane * float(self._shading.get(f"{name}Factor", 1.0))
        return images

    def _write_basecolor(self, colour: Float[Tensor, "H W 3"], *, flat: bool) -> None:
        opacity = self._shading.get("baseColorFactor", [1.0] * 4)[3]
        if flat:
            self._shading["baseColorFactor"] = [*colour[0, 0].tolist(), opacity]
            return
        self._shading["baseColorFactor"] = [1.0, 1.0, 1.0, opacity]
        if self._basecolor is not None and self._basecolor.shape[-1] == 4:
            colour = torch.cat([colour, _resized(self._basecolor[..., 3:], colour.shape[:2])], -1)
        png = encode_png(colour, srgb=True)
        self._shading["baseColorTexture"] = self._document.replaced(
            self._shading.get("baseColorTexture"), png
        )

    def _write_roughness_metallic(self, images: dict[str, Tensor], *, flat: bool) -> None:
        roughness, metallic = images["roughness"], images["metallic"]
        if flat:
            self._shading["roughnessFactor"] = float(roughness[0, 0])
            self._shading["metallicFactor"] = float(metallic[0, 0])
            return
        self._shading |= {"roughnessFactor": 1.0, "metallicFactor": 1.0}
        occlusion = torch.ones_like(roughness)
        if self._orm is not None:
            occlusion = _resized(self._orm[..., :1], roughness.shape[:2])
        png = encode_png(torch.cat([occlusion, roughness, metallic], -1))
        self._shading["metallicRoughnessTexture"] = self._document.replaced(
            self._shading.get("metallicRoughnessTexture"), png
        )


def _resized(image: Float[Tensor, "H W C"], size: Sequence[int]) -> Float[Tensor, "h w C"]:
    """Bilinear, unchanged where the size is right."""
    if tuple(image.shape[:2]) == tuple(size):
        return image
    moved = interpolate(image.permute(2, 0, 1)[None], size=tuple(size), mode="bilinear")
    return moved[0].permute(1, 2, 0)


class _Document:
    """The JSON of a GLB and the content of each of its buffer views."""

    def __init__(self, content: bytes) -> None:
        self.json, binary = _chunks(content)
        self._views = [
            self._content(view, binary) for view in self.json.setdefault("bufferViews", [])
        ]

    def _content(self, view: Json, binary: bytes) -> bytes | None:
        """Bytes of a view of the file's own buffer; None for one of another file."""
        if view.get("buffer", 0) != 0 or "uri" in self.json["buffers"][0]:
            return None
        start = view.get("byteOffset", 0)
        return binary[start : start + view["byteLength"]]

    def texture(self, reference: Json | None) -> Float[Tensor, "H W C"] | None:
        """Stored values of a texture, grey widened to three channels."""
        if reference is None:
            return None
        image = self.json["images"][self._source(reference)]
        if "bufferView" not in image:
            raise ValueError("an image lies in another file; export one self-contained .glb")
        decoded = decode_image(self._views[image["bufferView"]] or b"")
        if decoded.shape[-1] >= 3:
            return decoded
        grey = decoded[..., :1].expand(*decoded.shape[:2], 3)
        return torch.cat([grey, decoded[..., 1:]], -1)

    def _source(self, reference: Json) -> int:
        """Index of the image behind a texture reference."""
        texture = self.json["textures"][reference["index"]]
        webp = texture.get("extensions", {}).get("EXT_texture_webp", {})
        return int(webp.get("source", texture.get("source", -1)))

    def replaced(self, reference: Json | None, png: bytes) -> Json:
        """The reference with another image behind it; sampler and coordinates stay."""
        view = len(self._views)
        self.json["bufferViews"].append({"buffer": 0, "byteOffset": 0, "byteLength": len(png)})
        self._views.append(png)
        images = self.json.setdefault("images", [])
        images.append({"mimeType": "image/png", "bufferView": view})
        old = {} if reference is None else self.json["textures"][reference["index"]]
        texture = {"source": len(images) - 1}
        if "sampler" in old:
            texture["sampler"] = old["sampler"]
        textures = self.json.setdefault("textures", [])
        textures.append(texture)
        return {**(reference or {}), "index": len(textures) - 1}

    def pack(self) -> bytes:
        """The finished file."""
        self._drop_unused_images()
        binary = bytearray()
        for view, content in zip(self.json["bufferViews"], self._views, strict=True):
            if content is not None:
                binary += b"\0" * (-len(binary) % ALIGNMENT)
                view |= {"byteOffset": len(binary), "byteLength": len(content)}
                binary += content
        binary += b"\0" * (-len(binary) % ALIGNMENT)
        buffers = self.json.setdefault("buffers", [{}])
        if "uri" not in buffers[0]:
            buffers[0]["byteLength"] = len(binary)
        text = json.dumps(self.json, separators=(",", ":")).encode()
        text += b" " * (-len(text) % ALIGNMENT)
        body = struct.pack("<I", len(text)) + JSON_CHUNK + text
        body += struct.pack("<I", len(binary)) + BINARY_CHUNK + bytes(binary)
        return GLB_MAGIC + struct.pack("<II", 2, 12 + len(body)) + body

    def _drop_unused_images(self) -> None:
        """Forget textures and images that nothing shows any more, and the bytes of these images."""
        if set(self.json.get("extensions", {})) - HARMLESS:
            return
        used_textures = sorted(_texture_indices(self.json.get("materials", [])))
        textures = self.json.get("textures", [])
        if any(not 0 <= index < len(textures) for index in used_textures):
            raise ValueError("a material names a texture that is not there")
        new_index = {old: new for new, old in enumerate(used_textures)}
        _renumber_textures(self.json.get("materials", []), new_index)
        kept = [textures[index] for index in used_textures]
        used_images = sorted({index for texture in kept for index in _image_indices(texture)})
        renumbered = {old: new for new, old in enumerate(used_images)}
        for texture in kept:
            _renumber_images(texture, renumbered)
        images = self.json.get("images", [])
        gone = {image.get("bufferView") for i, image in enumerate(images) if i not in renumbered}
        self._put("textures", kept)
        self._put("images", [images[index] for index in used_images])
        self._drop_views(gone - {None} - {i.get("bufferView") for i in self.json.get("images", [])})

    def _put(self, name: str, entries: list[Json]) -> None:
        """Replace a list; glTF knows no empty ones."""
        if entries:
            self.json[name] = entries
        else:
            self.json.pop(name, None)

    def _drop_views(self, gone: set[int]) -> None:
        """Leave out views; every reference to the others is renumbered."""
        kept = [index for index in range(len(self._views)) if index not in gone]
        renumbered = {old: new for new, old in enumerate(kept)}
        _renumber_views({k: v for k, v in self.json.items() if k != "bufferViews"}, renumbered)
        self._views = [self._views[index] for index in kept]
        self._put("bufferViews", [self.json["bufferViews"][index] for index in kept])
        self.json.setdefault("bufferViews", [])


def _chunks(content: bytes) -> tuple[Json, bytes]:
    """JSON and binary chunk of a GLB."""
    if content[:4] != GLB_MAGIC:
        raise ValueError("wanted a .glb file; export the asset as one self-contained binary")
    chunks: dict[bytes, bytes] = {}
    offset = 12
    while offset + 8 <= len(content):
        length = struct.unpack_from("<I", content, offset)[0]
        chunks.setdefault(content[offset + 4 : offset + 8], content[offset + 8 :][:length])
        offset += 8 + length
    if JSON_CHUNK not in chunks or offset > len(content):
        raise ValueError("the .glb is cut short or holds no JSON chunk")
    return json.loads(chunks[JSON_CHUNK]), chunks.get(BINARY_CHUNK, b"")


def _texture_references(node: Any) -> list[Json]:
    """Every texture reference of materials, those of extensions too."""
    found = []
    if isinstance(node, dict):
        for name, value in node.items():
            if name.endswith("Texture") and isinstance(value, dict) and "index" in value:
                found.append(value)
            found += _texture_references(value)
    elif isinstance(node, list):
        for value in node:
            found += _texture_references(value)
    return found


def _texture_indices(materials: list[Json]) -> set[int]:
    return {int(reference["index"]) for reference in _texture_references(materials)}


def _renumber_textures(materials: list[Json], new_index: dict[int, int]) -> None:
    for reference in _texture_references(materials):
        reference["index"] = new_index[reference["index"]]


def _image_sources(texture: Json) -> list[Json]:
    """The texture itself and its extensions, where they name an image."""
    return [e for e in (texture, *texture.get("extensions", {}).values()) if "source" in e]


def _image_indices(texture: Json) -> set[int]:
    return {int(entry["source"]) for entry in _image_sources(texture)}


def _renumber_images(texture: Json, new_index: dict[int, int]) -> None:
    for entry in _image_sources(texture):
        entry["source"] = new_index[entry["source"]]


def _renumber_views(node: Any, new_index: dict[int, int]) -> None:
    """Follow `bufferView` wherever it stands, in extensions too."""
    if isinstance(node, dict):
        if isinstance(node.get("bufferView"), int):
            node["bufferView"] = new_index[node["bufferView"]]
        for value in node.values():
            _renumber_views(value, new_index)
    elif isinstance(node, list):
        for value in node:
            _renumber_views(value, new_index)
