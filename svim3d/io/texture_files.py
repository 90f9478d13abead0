"""The maps of an asset as pictures by themselves, for engines that take them one by one."""

import torch
from torch import Tensor

from svim3d.io.image import encode_png
from svim3d.mesh.painted_mesh import PaintedMesh

FOLDER = "textures"
CONSTANT, PER_VERTEX = 1, 2  # dimensions of a material's values
ORM_CHANNELS = ("occlusion", "roughness", "metallic")


def texture_files(mesh: PaintedMesh) -> dict[str, bytes]:
    """8-bit PNG files in `textures/` by path; equal input gives equal bytes.

    `basecolor.png` has the sRGB curve, all others are linear: `orm.png` holds occlusion, roughness
    and metallic as glTF packs them, three grey pictures hold the same one by one, and `normal.png`,
    where there is one, is in tangent space with green up. A map of one value is a picture of one
    pixel. What is coloured per vertex has none.
    """
    if mesh.basecolor.ndim == PER_VERTEX:
        return {}
    orm = full_orm(mesh)
    pictures = {
        "basecolor": encode_png(_picture(mesh.basecolor), srgb=True),
        "orm": encode_png(_picture(orm)),
        **{name: encode_png(_grey(orm[..., i])) for i, name in enumerate(ORM_CHANNELS)},
    }
    if mesh.normal_tangent is not None:
        pictures["normal"] = encode_png(mesh.normal_tangent * 0.5 + 0.5)
    return {f"{FOLDER}/{name}.png": picture for name, picture in pictures.items()}


def full_orm(mesh: PaintedMesh) -> Tensor:
    """Occlusion, roughness and metallic with their factor."""
    return mesh.orm if mesh.orm_factor is None else mesh.orm * mesh.orm_factor


def _picture(values: Tensor) -> Tensor:
    return values.view(1, 1, 3) if values.ndim == CONSTANT else values


def _grey(plane: Tensor) -> Tensor:
    """One channel, of one pixel where it has one value."""
    low, high = torch.aminmax(plane)
    return low.view(1, 1, 1) if bool(low == high) else plane[..., None]
