"""Several orbits drawn of one photo: which to keep, and where they agree.

What the photo settles comes out alike every time; what has to be imagined, the back above all, does
not. The spread over a few draws tells the two apart, pixel by pixel.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from svim3d.color import srgb_from_linear
from svim3d.diffusion.groups import GeneratedViews

# Root mean square spread, over samples, at which a pixel's confidence has fallen to 1/e.
BASECOLOR_SCALE = 0.15  # of each channel, sRGB-encoded
NORMAL_SCALE = 0.35  # length of the difference of unit vectors: 20 degrees
MASK_SCALE = 0.25


def choose(samples: Sequence[GeneratedViews]) -> tuple[int, Float[Tensor, "K H W 1"]]:
    """The sample nearest to the mean of all, and how far each pixel is to be trusted.

    Confidence is exp(-d), where d is the samples' mean squared distance from their mean in units of
    the scales above: 1 where all are the same.
    """
    distance = squared_distances(samples)
    best = int(distance.mean((1, 2, 3, 4)).argmin())
    return best, torch.exp(-distance.mean(0))


def squared_distances(samples: Sequence[GeneratedViews]) -> Float[Tensor, "S K H W 1"]:
    """Of each sample's pixels from the mean of all; basecolor, normal and mask, by their scales."""
    colour = torch.stack([srgb_from_linear(s.basecolor) * s.mask for s in samples])
    normal = torch.stack([s.normal_camera * s.mask for s in samples])
    mask = torch.stack([s.mask for s in samples])
    return (
        _from_mean(colour).mean(-1, keepdim=True) / BASECOLOR_SCALE**2
        + _from_mean(normal).sum(-1, keepdim=True) / NORMAL_SCALE**2
        + _from_mean(mask) / MASK_SCALE**2
    )


def _from_mean(values: Float[Tensor, "S *rest"]) -> Float[Tensor, "S *rest"]:
    return (values - values.mean(0)).square()
