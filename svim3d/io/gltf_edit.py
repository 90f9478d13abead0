"""Changing the materials of a GLB and nothing else.

Geometry, nodes, animations and extensions stay as they are: only factors, textures and the images
behind them are touched. What a texture holds besides (opacity, occlusion) is kept. An image is
painted anew only where no factor can say the same.
"""

import struct
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import interpolate

from svim3d.color import linear_from_srgb
from svim3d.io.gltf_document import GlbDocument
from svim3d.io.image import encode_png
from svim3d.shading.material_edits import (
    CHANNELS,
    Edit,
    edit_channel,
    implausible,
    scale_of,
    sets,
)

Json = dict[str, Any]

BASECOLOR, ORM = "baseColorTexture", "metallicRoughnessTexture"
SLOTS = {"basecolor": BASECOLOR, "roughness": ORM, "metallic": ORM}
PLACES = {"basecolor": slice(0, 3), "roughness": slice(1, 2), "metallic": slice(2, 3)}
FACTORS = {"basecolor": "baseColorFactor", "roughness": "roughnessFactor"}
FACTORS["metallic"] = "metallicFactor"
SPECULAR = "KHR_materials_pbrSpecularGlossiness"
PAINTED_SIZE = 1024  # of the textures that a material without any gets for a region
TRIANGLES = 4  # the first mode of a primitive that has a surface
# Share of each edit per texel of one material's textures, and at which size it is wanted.
MaskOf = Callable[[int, int, int], Float[Tensor, "H W 1"] | None]


def edit_glb(
    content: bytes, edits: Sequence[Edit], mask_of: MaskOf | None = None
) -> tuple[bytes, list[str]]:
    """A GLB with all materials edited.

    An edit acts on the product of a texture and its factor. Where it is for everything, a constant
    becomes the factor and its texture goes, and a scale that stays within [0, 1] changes the factor
    alone. All else is painted into the texture, 8 bit. What has no material gets glTF's default.

    Args:
        content: of a .glb file.
        edits: in order.
        mask_of: region in texture space, asked for as (material, height, width); None for a
            material that is not touched. Without it everything is edited.

    Returns:
        The new file and messages; see `apply_edits`.

    Raises:
        ValueError: it is no GLB with materials, it is not self-contained, or a region is wanted
            that meets nothing or lacks texture coordinates.
    """
    try:
        document = GlbDocument(content)
        notices = _edit_document(document, edits, mask_of)
        return document.pack(), notices
    except (KeyError, IndexError, TypeError, AttributeError, struct.error) as error:
        raise ValueError(f"the .glb is no valid glTF 2.0: {error!r}") from error


def _edit_document(
    document: GlbDocument, edits: Sequence[Edit], mask_of: MaskOf | None
) -> list[str]:
    """Edit all materials in place."""
    primitives = document.primitives()
    materials: list[Json] = document.json.get("materials", [])
    bare = [p for p in primitives if "material" not in p and p.get("mode", TRIANGLES) >= TRIANGLES]
    if bare:
        materials = [*materials, {"name": "default"}]
        document.json["materials"] = materials
        for primitive in bare:
            primitive["material"] = len(materials) - 1
    if not materials:
        raise ValueError("the file has no materials to edit")
    if mask_of is not None and not any("TEXCOORD_0" in p["attributes"] for p in primitives):
        raise ValueError("a region needs texture coordinates, and the asset has none; unwrap it")
    notices, touched = [], False
    for index, material in enumerate(materials):
        users = [p["attributes"] for p in primitives if p.get("material") == index]
        name = material.get("name", f"material {index}")
        if SPECULAR in material.get("extensions", {}):
            told = ["has specular-glossiness, not metallic-roughness; left as it was"]
        elif mask_of is not None and not all("TEXCOORD_0" in attributes for attributes in users):
            told = ["has no texture coordinates for a region; left as it was"]
        else:
            editor = _MaterialEditor(document, material, index)
            told = editor.edit(edits, mask_of)
            touched = touched or editor.touched
        notices += [f"{name}: {notice}" for notice in told]
    if mask_of is not None and not touched:
        raise ValueError("the region is empty: it meets no texel of the asset")
    if any("COLOR_0" in p["attributes"] for p in primitives) and _touches(edits, "basecolor"):
        notices.append("vertex colours go on tinting the edited basecolor")
    return notices


def _touches(edits: Sequence[Edit], *channels: str) -> bool:
    return any(edit.channel in channels for edit in edits)


class _MaterialEditor:
    """Edits one material in place."""

    def __init__(self, document: GlbDocument, material: Json, index: int) -> None:
        self._document = document
        self._material = material
        self._index = index
        self.touched = False
        self._shading: Json = material.get("pbrMetallicRoughness", {})
        self._textures = {
            slot: document.texture(self._shading.get(slot)) for slot in (BASECOLOR, ORM)
        }

    def edit(self, edits: Sequence[Edit], mask_of: MaskOf | None) -> list[str]:
        """Apply all edits; returns the messages."""
        slots = {SLOTS[edit.channel] for edit in edits}
        masks: dict[str, Tensor] = {}
        if mask_of is not None:
            asked = {slot: mask_of(self._index, *self._size(slot, True)) for slot in slots}
            masks = {slot: mask for slot, mask in asked.items() if mask is not None}
            slots = set(masks)
        before = {name: self._product(name, SLOTS[name] in masks) for name in CHANNELS}
        after, notices = dict(before), []
        names = [n for n in CHANNELS if _touches(edits, n) and SLOTS[n] in slots]
        for name in names:
            mask = masks.get(SLOTS[name])
            after[name], told = edit_channel(name, before[name], edits, mask)
            notices += told
        for slot in slots:
            stored = {
                name: self._stored(name, edits, after[name], whole=mask_of is None)
                for name in names
                if SLOTS[name] == slot
            }
            self._write(slot, {name: plane for name, plane in stored.items() if plane is not None})
        if names:
            self.touched = True
            self._material["pbrMetallicRoughness"] = self._shading
        return notices + _implausible(before, after, list(masks.values()))

    def _size(self, slot: str, has_region: bool) -> tuple[int, int]:
        """Rows and columns of a slot's texture, or of the one that a region would need."""
        other = self._textures[ORM if slot == BASECOLOR else BASECOLOR]
        texture = self._textures[slot]
        if texture is None and has_region:
            texture = other
        side = PAINTED_SIZE if has_region else 1
        return (side, side) if texture is None else (texture.shape[0], texture.shape[1])

    def _factor(self, name: str) -> Tensor:
        """Of a channel, one number per component."""
        given = self._shading.get(FACTORS[name], [1.0] * 4 if name == "basecolor" else 1.0)
        return torch.tensor(given[:3] if name == "basecolor" else [given], dtype=torch.float32)

    def _set_factor(self, name: str, factor: Tensor) -> None:
        values = factor.tolist()
        if name == "basecolor":
            opacity = self._shading.get(FACTORS[name], [1.0] * 4)[3]
            self._shading[FACTORS[name]] = [*values, opacity]
        else:
            self._shading[FACTORS[name]] = values[0]

    def _plane(self, name: str, size: tuple[int, int]) -> Float[Tensor, "H W C"]:
        """A channel as its texture stores it, linear; ones where there is none."""
        texture = self._textures[SLOTS[name]]
        if texture is None:
            return torch.ones(*size, CHANNELS[name])
        plane = texture[..., PLACES[name]]
        return linear_from_srgb(plane) if name == "basecolor" else plane

    def _product(self, name: str, has_region: bool) -> Float[Tensor, "H W C"]:
        """A channel as glTF means it: texture times factor."""
        return self._plane(name, self._size(SLOTS[name], has_region)) * self._factor(name)

    def _stored(
        self, name: str, edits: Sequence[Edit], wanted: Float[Tensor, "H W C"], *, whole: bool
    ) -> Float[Tensor, "H W C"] | None:
        """Set a channel's factor; returns what its texture is to store, None to leave it."""
        factor, scale = self._factor(name), scale_of(edits, name)
        if whole and scale is not None:
            scaled = factor * factor.new_tensor(scale)
            if bool((scaled <= 1.0).all()):
                self._set_factor(name, scaled)
                return None
        if whole and (sets(edits, name) or self._textures[SLOTS[name]] is None):
            self._set_factor(name, wanted[0, 0])
            return torch.ones_like(wanted)
        # A factor that can stay spares the texels that are not edited another rounding.
        stays = (factor > 0.0) & (wanted <= factor).flatten(0, 1).all(0)
        factor = torch.where(stays, factor, 1.0)
        self._set_factor(name, factor)
        return wanted / factor

    def _write(self, slot: str, planes: Mapping[str, Float[Tensor, "H W C"]]) -> None:
        """Paint a slot's texture, or leave it out where all it would say is one."""
        if not planes:
            return
        old: Json | None = self._shading.get(slot)
        texture = self._textures[slot]
        size = next((plane.shape[0], plane.shape[1]) for plane in planes.values())
        names = [name for name in CHANNELS if SLOTS[name] == slot]
        full = {name: planes.get(name, self._plane(name, size)) for name in names}
        opacity = None
        if slot == BASECOLOR and texture is not None and texture.shape[-1] == 4:
            opacity = texture[..., 3:]
        shows_opacity = (
            opacity is not None and self._material.get("alphaMode", "OPAQUE") != "OPAQUE"
        )
        if all(bool((plane == 1.0).all()) for plane in full.values()) and not shows_opacity:
            self._shading.pop(slot, None)
            return
        if slot == ORM:
            occlusion = torch.ones(*size, 1) if texture is None else texture[..., :1]
            png = encode_png(torch.cat([occlusion, *full.values()], -1))
        else:
            parts = [*full.values(), *([] if opacity is None else [opacity])]
            png = encode_png(torch.cat(parts, -1), srgb=True)
        new = self._document.replaced(old, png, like=self._any_reference())
        occluding = self._material.get("occlusionTexture", {})
        if slot == ORM and old is not None and occluding.get("index") == old["index"]:
            occluding["index"] = new["index"]  # the same occlusion, without keeping two images
        self._shading[slot] = new

    def _any_reference(self) -> Json | None:
        """A texture of this material: all of them share their coordinates."""
        slots = (self._shading.get(BASECOLOR), self._shading.get(ORM))
        references = (*slots, self._material.get("normalTexture"))
        return next((reference for reference in references if reference is not None), None)


def _implausible(
    before: Mapping[str, Tensor], after: Mapping[str, Tensor], masks: Sequence[Tensor]
) -> list[str]:
    """Messages about what the edit made, at the size of the largest texture."""
    images = [*before.values(), *masks]
    size = max(i.shape[0] for i in images), max(i.shape[1] for i in images)
    compared = [{n: _resized(i, size) for n, i in state.items()} for state in (before, after)]
    region = None
    if masks:
        region = torch.stack([_resized(mask, size) for mask in masks]).amax(0)
    return implausible(compared[0], compared[1], region)


def _resized(image: Float[Tensor, "H W C"], size: tuple[int, int]) -> Float[Tensor, "h w C"]:
    """The nearest texel's value: to mix two would make materials that are not there."""
    if tuple(image.shape[:2]) == size:
        return image
    return interpolate(image.permute(2, 0, 1)[None], size=size, mode="nearest")[0].permute(1, 2, 0)
