"""What an artifact shows of itself, as small pictures."""

from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from svim3d.io.exr import read_rgb
from svim3d.io.image import read_png
from svim3d.io.thumbnail import encode_thumbnail
from svim3d.shading.tonemap import agx

LIGHT = "environment.exr"  # a lat-long map, the one picture that is not kept as PNG
MOST_PICTURES = 4
LONGEST_PX = 1200
LIGHT_PX = 256  # a light of fewer columns is shown with larger texels


def thumbnails(payload: Path, *, most_bytes: int) -> dict[str, bytes]:
    """JPEG files by the name of what they show: pictures that lie in a payload, and its light.

    Args:
        payload: folder of the artifact's files.
        most_bytes: of all of them together.
    """
    files = [*sorted(payload.glob("*.png")), *payload.glob(LIGHT)][:MOST_PICTURES]
    return {
        file.name: encode_thumbnail(
            _displayed_light(file) if file.name == LIGHT else read_png(file),
            longest_px=LONGEST_PX,
            most_bytes=most_bytes // len(files),
        )
        for file in files
    }


def _displayed_light(file: Path) -> Float[Tensor, "H W 3"]:
    light = agx(torch.from_numpy(read_rgb(file)))
    times = max(1, LIGHT_PX // light.shape[1])
    return light.repeat_interleave(times, 0).repeat_interleave(times, 1)
