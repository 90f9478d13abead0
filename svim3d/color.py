"""Colour spaces: Rec.709 primaries throughout, linear or with the sRGB transfer curve."""

import torch
from jaxtyping import Float
from torch import Tensor

LUMINANCE_REC709 = (0.2126, 0.7152, 0.0722)  # Source: ITU-R BT.709
SRGB_KNEE_LINEAR = 0.0031308  # Source: IEC 61966-2-1
SRGB_KNEE_ENCODED = 0.04045


def srgb_from_linear(linear: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """Encode linear light in [0, 1] with the sRGB curve; values outside are clamped."""
    x = linear.clamp(0.0, 1.0)
    # The floor keeps the power's gradient finite at black; the other branch is taken there.
    power = 1.055 * x.clamp_min(SRGB_KNEE_LINEAR).pow(1.0 / 2.4) - 0.055
    return torch.where(x <= SRGB_KNEE_LINEAR, 12.92 * x, power)


def linear_from_srgb(encoded: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """Decode sRGB values in [0, 1] to linear light; values outside are clamped."""
    x = encoded.clamp(0.0, 1.0)
    power = ((x.clamp_min(SRGB_KNEE_ENCODED) + 0.055) / 1.055).pow(2.4)
    return torch.where(x <= SRGB_KNEE_ENCODED, x / 12.92, power)


def luminance(rgb_linear: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 1"]:
    """Relative luminance of linear Rec.709 colour."""
    weights = rgb_linear.new_tensor(LUMINANCE_REC709)
    return (rgb_linear * weights).sum(-1, keepdim=True)
