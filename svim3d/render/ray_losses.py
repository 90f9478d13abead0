"""Losses on blocks of 2 x 2 composited rays against premultiplied target pixels.

All are means over the batch and of order one when the prediction is useless. A confidence weighs
the pixels of what compares with a target: where it is low the mean falls too, and the regularisers,
which take none, have their way.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from svim3d.color import srgb_from_linear
from svim3d.numerics import length

TONE_CURVE = 10.0  # T(x) = log(1 + 10 x) / log 11: equal weight to shadows and highlights
MASK_MARGIN = 1e-4  # keeps the logarithms of the cross-entropy finite
MAX_DEPTH_STEP = 5.0  # a plane seen at 79 degrees from its normal
COLOR_EDGE = 3.0  # a colour step of 1/3 switches smoothing off; Source: SViM3D, bilateral term


def _mean(values: Float[Tensor, "*batch C"], weight: Float[Tensor, "*batch 1"] | None) -> Tensor:
    """Mean of values, each times the weight of its pixel; a weight of one changes no bit."""
    return values.mean() if weight is None else (weight * values).mean()


def combined_weight(
    first: Float[Tensor, "*batch 1"] | None, second: Float[Tensor, "*batch 1"] | None
) -> Float[Tensor, "*batch 1"] | None:
    """Product of two weights, of which either may be missing."""
    if first is None or second is None:
        return second if first is None else first
    return first * second


def tonemap(radiance: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """Logarithmic curve with T(0) = 0 and T(1) = 1, unbounded above."""
    return torch.log1p(TONE_CURVE * radiance.clamp_min(0.0)) / math.log1p(TONE_CURVE)


def smoothing_guide(
    radiance: Float[Tensor, "*batch 3"], confidence: Float[Tensor, "*batch 1"] | None
) -> Float[Tensor, "*batch 3"]:
    """Picture at whose edges `bilateral_loss` lets go; what is not to be trusted shows none."""
    picture = tonemap(radiance)
    return picture if confidence is None else picture * confidence


def color_loss(
    rendered_linear: Float[Tensor, "*batch 3"],
    target_linear: Float[Tensor, "*batch 3"],
    weight: Float[Tensor, "*batch 1"] | None = None,
) -> Float[Tensor, ""]:
    """Mean squared difference of sRGB-encoded colours."""
    difference = srgb_from_linear(rendered_linear) - srgb_from_linear(target_linear)
    return _mean(difference.square(), weight)


def radiance_loss(
    rendered: Float[Tensor, "*batch 3"],
    target: Float[Tensor, "*batch 3"],
    weight: Float[Tensor, "*batch 1"] | None = None,
) -> Float[Tensor, ""]:
    """Mean squared difference of tone-mapped radiance."""
    return _mean((tonemap(rendered) - tonemap(target)).square(), weight)


def mask_loss(
    rendered: Float[Tensor, "*batch 1"],
    target: Float[Tensor, "*batch 1"],
    weight: Float[Tensor, "*batch 1"] | None = None,
) -> Float[Tensor, ""]:
    """Binary cross-entropy of coverage."""
    return torch.nn.functional.binary_cross_entropy(
        rendered.clamp(MASK_MARGIN, 1.0 - MASK_MARGIN), target.clamp(0.0, 1.0), weight
    )


def absolute_loss(
    rendered: Float[Tensor, "*batch C"],
    target: Float[Tensor, "*batch C"],
    weight: Float[Tensor, "*batch 1"] | None = None,
) -> Float[Tensor, ""]:
    """Mean absolute difference, for normals and for values in [0, 1]."""
    return _mean((rendered - target).abs(), weight)


def squared_loss(
    rendered: Float[Tensor, "*batch C"],
    target: Float[Tensor, "*batch C"],
    weight: Float[Tensor, "*batch 1"] | None = None,
) -> Float[Tensor, ""]:
    """Mean squared difference, for values in [0, 1]."""
    return _mean((rendered - target).square(), weight)


def unit_gradient_loss(gradient: Float[Tensor, "N 3"]) -> Float[Tensor, ""]:
    """Eikonal term: a signed distance has |gradient| = 1. Source: Gropp et al. 2020, eq. 2."""
    return _mean_or_zero((length(gradient) - 1.0).square())


def size_loss(vectors: Float[Tensor, "N C"]) -> Float[Tensor, ""]:
    """Mean square of all components."""
    return _mean_or_zero(vectors.square())


def _mean_or_zero(values: Float[Tensor, "N C"]) -> Float[Tensor, ""]:
    """The mean over samples, of which a batch may have none."""
    return values.mean() if len(values) else values.sum()


def _neighbours(values: Float[Tensor, "B 4 C"]) -> tuple[Tensor, Tensor]:
    """The two horizontal and two vertical pairs of each block."""
    first = values[:, [0, 2, 0, 1]]
    second = values[:, [1, 3, 2, 3]]
    return first, second


def bilateral_loss(
    values: Float[Tensor, "B 4 C"],
    guide: Float[Tensor, "B 4 3"],
    mask: Float[Tensor, "B 4 1"],
) -> Float[Tensor, ""]:
    """|values_i - values_j| exp(-3 |guide_i - guide_j|) over neighbours inside the mask.

    Smooth where the guide (a display-encoded picture) is, free at its edges.
    """
    a, b = _neighbours(values)
    guide_a, guide_b = _neighbours(guide)
    mask_a, mask_b = _neighbours(mask)
    same = torch.exp(-COLOR_EDGE * length(guide_a - guide_b)) * torch.minimum(mask_a, mask_b)
    return (length(a - b) * same).mean()


def depth_smoothness_loss(
    depth: Float[Tensor, "B 4 1"], mask: Float[Tensor, "B 4 1"], pixel: float
) -> Float[Tensor, ""]:
    """Squared depth steps between neighbours, in units of the pixel's footprint.

    Steps beyond `MAX_DEPTH_STEP` pixels are edges of the object and left alone.
    Source: Niemeyer et al. 2022, "RegNeRF", eq. 5, on blocks of 2 x 2.
    """
    a, b = _neighbours(depth)
    mask_a, mask_b = _neighbours(mask)
    step = (a - b).abs() / pixel
    inside = (step.detach() < MAX_DEPTH_STEP) * torch.minimum(mask_a, mask_b)
    return ((step / MAX_DEPTH_STEP).square() * inside).mean()
