"""Objects in a coverage map, and how one is centred in a square without fringes or aliasing."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from scipy import ndimage
from torch import Tensor

from svim3d.color import srgb_from_linear

COVERED = 0.5  # pixels beyond this belong to the object's box
SPECK_SHARE = 0.01  # of the largest object's pixels; what is smaller is dropped
MIN_COVERAGE = 1.0 / 510.0  # rounds to 0 of 255; protects the division by coverage
MAX_8BIT = 255.0


@dataclass(frozen=True)
class Box:
    """Pixel rows and columns of an object; the last are not part of it."""

    top: int
    left: int
    bottom: int
    right: int

    @property
    def longest(self) -> int:
        """Its longer side, pixels."""
        return max(self.bottom - self.top, self.right - self.left)

    def sides_touched(self, height: int, width: int) -> list[str]:
        """Sides of the picture at which it ends."""
        touched = {
            "top": self.top == 0,
            "left": self.left == 0,
            "bottom": self.bottom == height,
            "right": self.right == width,
        }
        return [side for side, touches in touched.items() if touches]


def drop_specks(mask: Float[Tensor, "H W 1"]) -> tuple[Float[Tensor, "H W 1"], list[int], int]:
    """Coverage without what is tiny beside the largest object.

    Returns:
        The coverage, the pixels of each object kept (largest first), and how many were dropped.
        Soft pixels go with the object nearest to them.
    """
    solid = mask[..., 0].numpy() > COVERED
    label, count = ndimage.label(solid, np.ones((3, 3)))
    if count == 0:
        return mask, [], 0
    sizes = np.bincount(label.ravel(), minlength=count + 1)[1:]
    kept = sizes >= SPECK_SHARE * sizes.max()
    if kept.all():
        return mask, sorted(sizes.tolist(), reverse=True), 0
    nearest = ndimage.distance_transform_edt(~solid, return_distances=False, return_indices=True)
    owner = label[tuple(nearest)] - 1
    clean = mask * torch.from_numpy(kept[owner])[..., None]
    return clean, sorted(sizes[kept].tolist(), reverse=True), int((~kept).sum())


def bounding_box(mask: Float[Tensor, "H W 1"]) -> Box:
    """Of the pixels that are covered by more than half.

    Raises:
        ValueError: there are none.
    """
    solid = mask[..., 0] > COVERED
    rows, columns = solid.any(1).nonzero()[:, 0], solid.any(0).nonzero()[:, 0]
    if len(rows) == 0:
        raise ValueError("no pixel of the picture is covered by an object; check its opacity")
    return Box(int(rows[0]), int(columns[0]), int(rows[-1]) + 1, int(columns[-1]) + 1)


def centred_square(
    rgb_linear: Float[Tensor, "H W 3"],
    mask: Float[Tensor, "H W 1"],
    box: Box,
    *,
    size: int,
    fill: float,
) -> tuple[Float[Tensor, "S S 3"], Float[Tensor, "S S 1"]]:
    """The box in the middle of a square, its longer side `fill` of the square's.

    Args:
        rgb_linear: straight colour.
        mask: coverage; what lies beyond the picture is not covered.
        box: of the object.
        size: side of the square, pixels.
        fill: share of it.

    Returns:
        Straight sRGB-encoded colour and coverage, both rounded to 8 bit; colour is zero where
        coverage is.
    """
    scale = fill * size / box.longest
    down = resampling_matrix(len(mask), size, scale, 0.5 * (box.top + box.bottom))
    along = resampling_matrix(mask.shape[1], size, scale, 0.5 * (box.left + box.right))
    planes = torch.cat([rgb_linear * mask, mask], -1).permute(2, 0, 1)
    planes = (down @ planes @ along.T).permute(1, 2, 0)
    coverage = planes[..., 3:]
    straight = srgb_from_linear(planes[..., :3] / coverage.clamp_min(MIN_COVERAGE))
    mask = (coverage.clamp(0.0, 1.0) * MAX_8BIT).round() / MAX_8BIT
    rgb = (straight * MAX_8BIT).round() / MAX_8BIT
    return rgb * (mask > 0.0), mask


def resampling_matrix(
    length: int, size: int, scale: float, middle: float
) -> Float[Tensor, "{size} {length}"]:
    """Weights by which `size` pixels around `middle` are made of a row of `length` pixels.

    A tent as wide as a pixel of the coarser of the two grids: linear interpolation upwards, an
    average downwards; never negative, so that nothing rings. Beyond the row lies nothing, so rows
    near its ends sum to less than 1.
    """
    reach = max(1.0, 1.0 / scale)
    centre = (torch.arange(size, dtype=torch.float64) + 0.5 - 0.5 * size) / scale + middle
    margin = int(np.ceil(2.0 * reach)) + 1
    pixel = torch.arange(-margin, length + margin, dtype=torch.float64) + 0.5
    weight = (1.0 - (centre[:, None] - pixel).abs() / reach).clamp_min(0.0)
    total = weight.sum(1, keepdim=True)
    # A centre far beyond the row meets no pixel at all.
    weight = torch.where(total > 0.0, weight / total.clamp_min(1e-9), 0.0)
    return weight[:, margin : margin + length].float()
