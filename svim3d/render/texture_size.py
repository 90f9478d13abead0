"""How large a texture must be: halved for as long as nobody would see it.

A texture may be halved when the halves, read back bilinearly where the larger one had its texels,
are it to 45 dB. And it need not have more texels than there are pixels that saw the surface, each
part in the view that shows it largest, unless `texture_detail` finds that more are worth it.

Differs from what is also in use, to stop where less than 1 % of the energy lies above the smaller
size's Nyquist frequency: of a pattern with a standard deviation of 0.3 that is an error of 30 dB.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from svim3d.mesh.texels import Texels, average_down, to_image
from svim3d.raster.texture import sample_texture

ENOUGH_DB = 45.0  # of a peak of 1: 1.4 steps of 8 bits
SMALLEST = 4  # texels per side


@dataclass(frozen=True)
class SufficientTexels:
    """Texel values at the size that suffices.

    Attributes:
        values: as given, averaged.
        texels: those that show the surface at that size.
        error_db: PSNR of what the averaging lost; infinite at the size given.
    """

    values: Float[Tensor, "Q C"]
    texels: Texels
    error_db: float


def sufficient_texels(
    values: Float[Tensor, "P C"], texels: Texels, *, most: int, wanted_db: float = ENOUGH_DB
) -> SufficientTexels:
    """The smallest power-of-two share of a texture that still says the same.

    Args:
        values: of the texels, encoded as they are stored, peak 1.
        texels: those that show the surface.
        most: size that may not be exceeded, whatever it costs.
        wanted_db: what a smaller one must reach.
    """
    best = SufficientTexels(values, texels, math.inf)
    factor = 2
    while texels.size // factor >= SMALLEST and texels.size % factor == 0:
        coarse, fewer = average_down(values, texels, factor)
        error_db = _read_back_db(values, texels, to_image(coarse, fewer))
        if error_db < wanted_db and best.texels.size <= most:
            break
        best = SufficientTexels(coarse, fewer, error_db)
        factor *= 2
    return best


def _read_back_db(
    values: Float[Tensor, "P C"], texels: Texels, image: Float[Tensor, "S S C"]
) -> float:
    """PSNR of a smaller texture, sampled at the texels of the larger one."""
    row, column = texels.pixel // texels.size, texels.pixel % texels.size
    uv = (torch.stack([column, row], 1).to(values) + 0.5) / texels.size
    mean = float((sample_texture(image, uv) - values).double().square().mean())
    return -10.0 * math.log10(mean) if mean > 0.0 else math.inf


def size_for_pixels(pixels: float, seen: int, size: int) -> int:
    """The power of two at which as many texels show the surface as pixels saw it, or the next.

    Args:
        pixels: that saw the surface, see `ViewPixels.distinct`.
        seen: texels that they see at the size given.
        size: texels per side.
    """
    if seen == 0:
        return size
    wanted = size * math.sqrt(pixels / seen)
    return halved(size, wanted)


def halved(size: int, least: float) -> int:
    """A side halved for as long as texels stay whole and no fewer than `least` and `SMALLEST`.

    Args:
        size: texels per side.
        least: texels per side that are wanted.
    """
    while size % 2 == 0 and size // 2 >= max(least, SMALLEST):
        size //= 2
    return size
