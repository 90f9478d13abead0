"""Angles between two fields of directions."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from svim3d.numerics import dot, normalize

# Degrees; Source: Eigen and Fergus 2015, "Predicting depth, surface normals and semantic labels".
WITHIN_DEG = (11.25, 22.5, 30.0)


@dataclass(frozen=True)
class AngularError:
    """Angles between two direction fields inside a mask.

    Attributes:
        mean_deg: a few flipped directions move it far.
        median_deg: half of the pixels are better.
        within: share of pixels that are off by less than so many degrees.
    """

    mean_deg: float
    median_deg: float
    within: Mapping[float, float]


def angular_error(
    a: Float[Tensor, "*batch 3"], b: Float[Tensor, "*batch 3"], mask: Bool[Tensor, "*batch 1"]
) -> AngularError:
    """Mean, median and shares of the angles inside a mask, as `angles_deg` has them.

    Raises:
        ValueError: the mask is empty.
    """
    if not bool(mask.any()):
        raise ValueError("wanted a mask with at least one pixel to compare directions in, got none")
    angles = angles_deg(a, b)[mask].cpu().numpy()
    shares = {limit: float((angles < limit).mean()) for limit in WITHIN_DEG}
    return AngularError(float(angles.mean()), float(np.median(angles)), shares)


def mean_angle_deg(
    a: Float[Tensor, "*batch 3"], b: Float[Tensor, "*batch 3"], mask: Bool[Tensor, "*batch 1"]
) -> float:
    """Mean of `angles_deg` inside a mask."""
    return float(angles_deg(a, b)[mask].mean())


def angles_deg(
    a: Float[Tensor, "*batch 3"], b: Float[Tensor, "*batch 3"]
) -> Float[Tensor, "*batch 1"]:
    """Angle between two direction fields at every pixel; need not be unit.

    A zero vector (a pixel that one side does not cover) counts as 90 degrees.
    """
    a, b = normalize(a.double()), normalize(b.double())
    # atan2 keeps small angles exact where acos loses half of the digits.
    angle = torch.atan2(
        torch.linalg.vector_norm(torch.linalg.cross(a, b), dim=-1, keepdim=True), dot(a, b)
    )
    blank = (dot(a, a) < 0.5) | (dot(b, b) < 0.5)
    return torch.rad2deg(torch.where(blank, math.pi / 2, angle))
