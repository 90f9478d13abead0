"""All that an orbit holds on one picture: a column for each view, a row for each kind of image."""

import math
from collections.abc import Mapping

import torch
from jaxtyping import Float
from torch import Tensor

from svim3d.cameras import Cameras
from svim3d.color import srgb_from_linear
from svim3d.io.image import PAPER, contact_sheet

COLUMNS = 7
CELL_PX = 128  # longest side of a picture on the sheet


def orbit_sheet(
    cameras: Cameras, images: Mapping[str, Float[Tensor, "V H W C"]]
) -> Float[Tensor, "_ _ 3"]:
    """Views at even steps in order of azimuth; radiance, materials, normals and confidence.

    Args:
        cameras: V poses.
        images: as `svim3d.io.orbit.write_orbit` takes them; normals are shown as the camera's.

    Returns:
        Display-encoded, over grey paper. Radiance is cut off at 1, not tone mapped.
    """
    chosen = _in_order(cameras)
    mask = images["mask"][chosen]
    turned = torch.einsum(
        "vij,vhwi->vhwj", cameras.c2w[chosen, :3, :3], images["normal_world"][chosen]
    )
    radiance = images["radiance"][chosen] / mask.clamp_min(torch.finfo(mask.dtype).eps)
    rows = {
        "rgb": srgb_from_linear(radiance),
        "basecolor": srgb_from_linear(images["basecolor"][chosen]),
        "roughness": images["roughness"][chosen],
        "metallic": images["metallic"][chosen],
        "normal": turned * 0.5 + 0.5,
    }
    pictures = {name: PAPER + mask * (row.clamp(0.0, 1.0) - PAPER) for name, row in rows.items()}
    if "confidence" in images:
        pictures["confidence"] = images["confidence"][chosen]
    cells = [cell for row in pictures.values() for cell in _cells(row)]
    labels = [f"{name} {view}" for name in pictures for view in chosen]
    return contact_sheet(cells, labels, columns=len(chosen))


def _in_order(cameras: Cameras) -> list[int]:
    """Views sorted by azimuth, thinned to as many as the sheet has columns."""
    azimuth = cameras.azimuths.remainder(math.tau)
    # A camera at azimuth 0 may lie a rounding error below a full turn.
    order = (azimuth + 1e-4).remainder(math.tau).argsort(stable=True).tolist()
    columns = min(COLUMNS, len(order))
    return [order[i * len(order) // columns] for i in range(columns)]


def _cells(pictures: Float[Tensor, "V H W C"]) -> list[Float[Tensor, "h w 3"]]:
    """Colour pictures that fill the sheet's cells; the pixels of small ones stay visible."""
    height, width = pictures.shape[1:3]
    scale = CELL_PX / max(height, width)
    size = (max(1, round(height * scale)), max(1, round(width * scale)))
    planes = pictures.expand(*pictures.shape[:-1], 3).permute(0, 3, 1, 2)
    if scale > 1.0:
        scaled = torch.nn.functional.interpolate(planes, size=size, mode="nearest-exact")
    else:
        scaled = torch.nn.functional.interpolate(planes, size=size, mode="bilinear", antialias=True)
    return list(scaled.permute(0, 2, 3, 1))
