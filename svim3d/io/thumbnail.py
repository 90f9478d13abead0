"""Small pictures, for pages that carry their pictures in themselves."""

import io

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor

BACKGROUND = 0.11  # grey behind what is transparent, as on our sheets
QUALITY = 85
SHRINK = 0.8  # of the sides, until the picture is small enough
LEAST_PX = 16  # of the longer side
WEBP_QUALITY, WEBP_EFFORT = 82, 4  # of 100, and of 6


def encode_thumbnail(image: Float[Tensor, "H W C"], *, longest_px: int, most_bytes: int) -> bytes:
    """A JPEG of a display-encoded picture in [0, 1] with 1 to 4 channels, opacity last.

    Args:
        image: what is shown.
        longest_px: of the longer side.
        most_bytes: of the file; the picture is made as small as that takes.
    """
    values = image.detach().cpu().float().clamp(0.0, 1.0)
    if values.shape[-1] in (2, 4):
        opacity = values[..., -1:]
        values = values[..., :-1] * opacity + BACKGROUND * (1.0 - opacity)
    pixels = (values * 255.0).round().numpy().astype(np.uint8)
    picture = Image.fromarray(pixels[..., 0] if pixels.shape[-1] == 1 else pixels).convert("RGB")
    side = min(longest_px, max(picture.size))
    while True:
        small = picture.copy()
        small.thumbnail((side, side), Image.Resampling.LANCZOS)
        buffer = io.BytesIO()
        small.save(buffer, "JPEG", quality=QUALITY, optimize=True)
        if buffer.tell() <= most_bytes or side <= LEAST_PX:
            return buffer.getvalue()
        side = max(LEAST_PX, int(side * SHRINK))


def encode_webp(image: Float[Tensor, "H W C"]) -> bytes:
    """A lossy WebP of a display-encoded picture in [0, 1] with 1 to 4 channels, opacity last."""
    values = image.detach().cpu().float().clamp(0.0, 1.0)
    if values.shape[-1] in (1, 2):
        colour = values[..., :1].expand(*values.shape[:2], 3)
        values = torch.cat([colour, values[..., 1:]], -1)
    pixels = (values * 255.0).round().numpy().astype(np.uint8)
    buffer = io.BytesIO()
    Image.fromarray(pixels, "RGB" if pixels.shape[-1] == 3 else "RGBA").save(
        buffer, "WEBP", quality=WEBP_QUALITY, method=WEBP_EFFORT
    )
    return buffer.getvalue()
