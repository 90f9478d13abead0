"""A GLB with smaller textures, where a file of fewer bytes is wanted."""

from collections.abc import Iterator
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import interpolate

from svim3d.color import linear_from_srgb, srgb_from_linear
from svim3d.io.gltf_document import GlbDocument
from svim3d.io.image import encode_png
from svim3d.numerics import normalize

Json = dict[str, Any]

LEAST_SIDE = 32  # texels; smaller textures are a smear
COLOURS = ("baseColorTexture", "emissiveTexture")  # stored with the sRGB curve
NORMALS = "normalTexture"


def shrink_glb(content: bytes, most_bytes: int) -> tuple[bytes, int] | None:
    """The same asset with textures halved until the file is small enough.

    Args:
        content: of a self-contained .glb file.
        most_bytes: that the file may have.

    Returns:
        The file and the longest side of its textures, 0 where nothing had to change; None where
        the geometry alone is too large.

    Raises:
        ValueError: it is no GLB, or not self-contained.
    """
    if len(content) <= most_bytes:
        return content, 0
    document = GlbDocument(content)
    sides = [max(t.shape[:2]) for _, _, t in _textures(document)]
    side = max(sides, default=0) // 2
    while side >= LEAST_SIDE:
        smaller = _with_side(content, side)
        if len(smaller) <= most_bytes:
            return smaller, side
        side //= 2
    return None


def _with_side(content: bytes, side: int) -> bytes:
    """The asset with textures of at most `side` texels."""
    document = GlbDocument(content)
    for holder, name, texture in list(_textures(document)):
        if max(texture.shape[:2]) > side:
            png = encode_png(_averaged(texture, name, side))
            holder[name] = document.replaced(holder[name], png, like=None)
    return document.pack()


def _textures(document: GlbDocument) -> Iterator[tuple[Json, str, Float[Tensor, "H W C"]]]:
    """Who names a texture, under which name, and what it stores; extensions keep theirs."""
    for material in document.json.get("materials", []):
        for holder in (material, material.get("pbrMetallicRoughness", {})):
            for name, reference in list(holder.items()):
                if name.endswith("Texture") and isinstance(reference, dict):
                    texture = document.texture(reference)
                    if texture is not None:
                        yield holder, name, texture


def _averaged(texture: Float[Tensor, "H W C"], name: str, side: int) -> Float[Tensor, "h w C"]:
    """Area means: of colours in linear light, of normals as vectors."""
    factor = side / max(texture.shape[:2])
    size = (max(1, round(texture.shape[0] * factor)), max(1, round(texture.shape[1] * factor)))
    colour, opacity = texture[..., :3], texture[..., 3:]
    if name in COLOURS:
        colour = linear_from_srgb(colour)
    planes = torch.cat([colour, opacity], -1).permute(2, 0, 1)[None]
    means = interpolate(planes, size=size, mode="area")[0].permute(1, 2, 0)
    colour, opacity = means[..., :3], means[..., 3:]
    if name in COLOURS:
        colour = srgb_from_linear(colour)
    elif name == NORMALS:
        colour = normalize(colour * 2.0 - 1.0) * 0.5 + 0.5
    return torch.cat([colour, opacity], -1)
