"""Least-squares scale, and scale and shift, of a picture to the truth inside a mask.

What a single photo cannot tell is taken out before two pictures are compared: albedo is known up
to a factor per channel (the light's colour), roughness and metallic up to a line. Each function
sees one picture with its mask, so that the fit is one per picture and channel.
Source: Grosse et al. 2009, "Ground truth dataset and baseline evaluations for intrinsic image
algorithms", section 4 (scale); Ranftl et al. 2020, "Towards robust monocular depth estimation",
eq. 4 (scale and shift).
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

# Below this, sums of squares of a picture in [0, 1] are rounding: there is nothing to scale.
MIN_ENERGY = 1e-12


def least_squares_scale(
    image: Float[Tensor, "*batch C"],
    truth: Float[Tensor, "*batch C"],
    mask: Bool[Tensor, "*batch 1"],
) -> Float[Tensor, "C"]:
    """The s per channel that makes s * image nearest to the truth inside the mask.

    s = sum(image truth) / sum(image^2). A channel that is black in the mask keeps s = 1.
    """
    x, y = _inside(image, mask), _inside(truth, mask)
    energy = x.square().sum(0)
    scale = (x * y).sum(0) / energy.clamp_min(MIN_ENERGY)
    return torch.where(energy > MIN_ENERGY, scale, 1.0).to(image.dtype)


def least_squares_scale_and_shift(
    image: Float[Tensor, "*batch C"],
    truth: Float[Tensor, "*batch C"],
    mask: Bool[Tensor, "*batch 1"],
) -> tuple[Float[Tensor, "C"], Float[Tensor, "C"]]:
    """The s and t per channel that make s * image + t nearest to the truth inside the mask.

    s is covariance over variance and may be negative, t the difference of means that is left. A
    channel that is flat in the mask keeps s = 1: one number tells no slope.
    """
    x, y = _inside(image, mask), _inside(truth, mask)
    mean_x, mean_y = x.mean(0), y.mean(0)
    spread = (x - mean_x).square().sum(0)
    slope = ((x - mean_x) * (y - mean_y)).sum(0) / spread.clamp_min(MIN_ENERGY)
    scale = torch.where(spread > MIN_ENERGY, slope, 1.0)
    return scale.to(image.dtype), (mean_y - scale * mean_x).to(image.dtype)


def align_scale(
    image: Float[Tensor, "*batch C"],
    truth: Float[Tensor, "*batch C"],
    mask: Bool[Tensor, "*batch 1"],
) -> Float[Tensor, "*batch C"]:
    """The picture times its least-squares scale; not clamped."""
    return image * least_squares_scale(image, truth, mask)


def align_scale_and_shift(
    image: Float[Tensor, "*batch C"],
    truth: Float[Tensor, "*batch C"],
    mask: Bool[Tensor, "*batch 1"],
) -> Float[Tensor, "*batch C"]:
    """The picture on its least-squares line; not clamped."""
    scale, shift = least_squares_scale_and_shift(image, truth, mask)
    return image * scale + shift


def _inside(image: Float[Tensor, "*batch C"], mask: Bool[Tensor, "*batch 1"]) -> Tensor:
    """Masked pixels [P, C] in double precision.

    Raises:
        ValueError: the mask is empty.
    """
    if not bool(mask.any()):
        raise ValueError("wanted a mask with at least one pixel to fit a scale in, got none")
    return image[mask[..., 0]].double()
