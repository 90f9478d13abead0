"""Along an object's edge: coverage moved onto the picture's edges, colours freed of the background.

Colours are linear light, where a sensor mixes them.
"""

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from scipy import ndimage
from torch import Tensor
from torch.nn.functional import interpolate

FUSION_RADII_PX = (90, 6)  # Source: Forte 2021, "Approximate fast foreground colour estimation"
GUIDE_SIDE_PX = 512  # the guided filter's coefficients are smooth: found on a small picture
TAIL = 0.1  # faint mist that the filter leaves on both sides of an edge
GUIDE_NOISE = 1e-4  # variance of the guide that is smoothed over; Source: He et al. 2013
MIN_SHARE = 1e-5  # protects means over windows without object or background


def foreground_colour(
    rgb_linear: Float[Tensor, "H W 3"], coverage: Float[Tensor, "H W 1"]
) -> Float[Tensor, "H W 3"]:
    """Straight linear colour of the object alone: the background's share is taken out.

    Source: Forte 2021, "Approximate fast foreground colour estimation" (blur fusion, two rounds).
    """
    colour, mask = rgb_linear.numpy(), coverage.numpy()
    front = back = colour
    for radius in FUSION_RADII_PX:
        front_mean = _weighted_mean(front, mask, radius)
        back = _weighted_mean(back, np.float32(1.0) - mask, radius)
        left_over = colour - mask * front_mean - (1.0 - mask) * back
        front = np.clip(front_mean + mask * left_over, 0.0, 1.0)
    return torch.from_numpy(front)


def _weighted_mean(
    values: NDArray[np.float32], weight: NDArray[np.float32], radius: int
) -> NDArray[np.float32]:
    """Box mean of `values` weighted by `weight`, which may vanish."""
    size = (2 * radius + 1, 2 * radius + 1, 1)
    total = ndimage.uniform_filter(values * weight, size, mode="nearest")
    share = ndimage.uniform_filter(weight, size, mode="nearest")
    return total / np.maximum(share, MIN_SHARE)


def sharpen_coverage(
    rgb_srgb: Float[Tensor, "H W 3"], coverage: Float[Tensor, "H W 1"], *, radius_px: int
) -> Float[Tensor, "H W 1"]:
    """Move a blurred coverage onto the picture's own edges.

    Args:
        rgb_srgb: the guide.
        coverage: blurred over about `radius_px` pixels.
        radius_px: of the windows in which coverage is a linear function of colour.

    Source: He, Sun, Tang 2013, "Guided image filtering", eq. 14 to 16, with the coefficients found
    on a smaller picture as in He, Sun 2015, "Fast guided filter".
    """
    height, width = rgb_srgb.shape[:2]
    factor = max(1.0, max(height, width) / GUIDE_SIDE_PX)
    size = (max(1, round(height / factor)), max(1, round(width / factor)))
    both = torch.cat([rgb_srgb, coverage], -1).permute(2, 0, 1)[None]
    small = interpolate(both, size=size, mode="bilinear", antialias=True)[0].permute(1, 2, 0)
    radius = max(1, round(radius_px / factor))
    guide, target = small[..., :3].double(), small[..., 3:].double()
    mean_guide, mean_target = _box(guide, radius), _box(target, radius)
    products = (guide[..., :, None] * guide[..., None, :]).flatten(-2)
    variance = _box(products, radius).unflatten(-1, (3, 3))
    variance = variance - mean_guide[..., :, None] * mean_guide[..., None, :]
    covariance = _box(guide * target, radius) - mean_guide * mean_target
    regular = variance + GUIDE_NOISE * torch.eye(3, dtype=variance.dtype)
    slope = torch.linalg.solve(regular, covariance[..., None])[..., 0]
    offset = mean_target - (slope * mean_guide).sum(-1, keepdim=True)
    smooth = _box(torch.cat([slope, offset], -1), radius).float().permute(2, 0, 1)[None]
    full = interpolate(smooth, size=(height, width), mode="bilinear")[0].permute(1, 2, 0)
    sharp = (full[..., :3] * rgb_srgb).sum(-1, keepdim=True) + full[..., 3:]
    return ((sharp - TAIL) / (1.0 - 2.0 * TAIL)).clamp(0.0, 1.0)


def _box(values: Float[Tensor, "H W C"], radius: int) -> Float[Tensor, "H W C"]:
    """Mean over a square window, mirrored at the border."""
    size = (2 * radius + 1, 2 * radius + 1, 1)
    return torch.from_numpy(ndimage.uniform_filter(values.numpy(), size))
