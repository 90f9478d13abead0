"""A GLB taken apart for changes to its textures and put together again.

Buffer views keep their bytes. As long as no picture comes or goes the whole buffer stays as it is;
otherwise it is laid out anew, without pictures that nothing shows any more.
"""

import base64
import json
import struct
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from svim3d.io.gltf import ALIGNMENT, BINARY_CHUNK, GLB_MAGIC, JSON_CHUNK, pack_glb
from svim3d.io.image import decode_image

Json = dict[str, Any]

# Extensions of the whole file that name no textures; beside others, old images are kept.
HARMLESS = {"KHR_materials_variants", "KHR_lights_punctual"}
WEBP = "EXT_texture_webp"


class GlbDocument:
    """The JSON of a GLB and the content of each of its buffer views."""

    def __init__(self, content: bytes) -> None:
        self.json, self._binary = _chunks(content)
        if any("uri" in buffer for buffer in self.json.get("buffers", [])):
            raise ValueError(
                "wanted a .glb that holds all of its content, got one that names another file; "
                "export it self-contained"
            )
        self._views = [self._content(view) for view in self.json.get("bufferViews", [])]
        self._untouched = list(self._views)
        self._painted: dict[bytes, int] = {}

    def _content(self, view: Json) -> bytes:
        """Bytes of a buffer view."""
        start = view.get("byteOffset", 0)
        return self._binary[start : start + view["byteLength"]]

    def primitives(self) -> list[Json]:
        """Of all meshes."""
        return [p for mesh in self.json.get("meshes", []) for p in mesh["primitives"]]

    def texture(self, reference: Json | None) -> Float[Tensor, "H W C"] | None:
        """Stored values of a texture, grey widened to three channels."""
        if reference is None:
            return None
        source = self._source(reference)
        if source < 0:
            raise ValueError("a texture has no image in a supported format (PNG, JPEG, WebP)")
        image = self.json["images"][source]
        if image.get("uri", "data:").startswith("data:"):
            encoded = image.get("uri", "").partition(",")[2]
            view = image.get("bufferView")
            decoded = decode_image(base64.b64decode(encoded) if view is None else self._views[view])
        else:
            raise ValueError("an image lies in another file; export one self-contained .glb")
        if decoded.shape[-1] >= 3:
            return decoded
        grey = decoded[..., :1].expand(*decoded.shape[:2], 3)
        return torch.cat([grey, decoded[..., 1:]], -1)

    def _source(self, reference: Json) -> int:
        """Index of the image behind a texture reference."""
        texture = self.json["textures"][reference["index"]]
        webp = texture.get("extensions", {}).get(WEBP, {})
        return int(webp.get("source", texture.get("source", -1)))

    def replaced(self, reference: Json | None, png: bytes, *, like: Json | None) -> Json:
        """A reference to another image, with the sampler and coordinates of the one it replaces.

        Args:
            reference: what is replaced, if there is anything.
            png: the image.
            like: a reference whose coordinates a new one takes over.
        """
        if png not in self._painted:
            views = self.json.setdefault("bufferViews", [])
            views.append({"buffer": 0, "byteOffset": 0, "byteLength": len(png)})
            self._views.append(png)
            images = self.json.setdefault("images", [])
            images.append({"mimeType": "image/png", "bufferView": len(views) - 1})
            self._painted[png] = len(images) - 1
        texture = {"source": self._painted[png]}
        model = reference or like or {}
        if "index" in model and "sampler" in self.json["textures"][model["index"]]:
            texture["sampler"] = self.json["textures"][model["index"]]["sampler"]
        textures = self.json.setdefault("textures", [])
        if texture not in textures:
            textures.append(texture)
        kept = {k: v for k, v in model.items() if k in ("texCoord", "extensions", "extras")}
        return {**kept, "index": textures.index(texture)}

    def pack(self) -> bytes:
        """The finished file."""
        self._drop_unused_images()
        binary = self._binary
        if self._views != self._untouched:
            binary = self._laid_out()
            self.json.setdefault("buffers", [{}])[0]["byteLength"] = len(binary)
        return pack_glb(self.json, binary)

    def _laid_out(self) -> bytes:
        """All buffer views one after the other."""
        binary = bytearray()
        for view, content in zip(self.json["bufferViews"], self._views, strict=True):
            if "extensions" in view:
                raise ValueError(
                    "the file compresses its buffers "
                    f"({', '.join(view['extensions'])}); export it without compression"
                )
            binary += b"\0" * (-len(binary) % ALIGNMENT)
            view |= {"byteOffset": len(binary), "byteLength": len(content)}
            binary += content
        return bytes(binary + b"\0" * (-len(binary) % ALIGNMENT))

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
        self._forget_webp()
        self._put("images", [images[index] for index in used_images])
        self._drop_views(gone - {None} - {i.get("bufferView") for i in self.json.get("images", [])})

    def _forget_webp(self) -> None:
        """Take back the claim to hold WebP when the last such texture has gone."""
        if not any(
            WEBP in texture.get("extensions", {}) for texture in self.json.get("textures", [])
        ):
            for name in ("extensionsUsed", "extensionsRequired"):
                self._put(name, [e for e in self.json.get(name, []) if e != WEBP])

    def _put(self, name: str, entries: list[Json]) -> None:
        """Replace a list; glTF knows no empty ones."""
        if entries:
            self.json[name] = entries
        else:
            self.json.pop(name, None)

    def _drop_views(self, gone: set[int]) -> None:
        """Leave out views; every reference to the others is renumbered."""
        kept = [index for index in range(len(self._views)) if index not in gone]
        if len(kept) == len(self._views):
            return
        renumbered = {old: new for new, old in enumerate(kept)}
        _renumber_views({k: v for k, v in self.json.items() if k != "bufferViews"}, renumbered)
        self._views = [self._views[index] for index in kept]
        self._put("bufferViews", [self.json["bufferViews"][index] for index in kept])


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
            if name == "extras":  # whoever wrote them gave their names a meaning of their own
                continue
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
        for name, value in node.items():
            if name != "extras":
                _renumber_views(value, new_index)
    elif isinstance(node, list):
        for value in node:
            _renumber_views(value, new_index)
