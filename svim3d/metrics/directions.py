"""Angles between two fields of directions."""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from svim3d.numerics import dot, normalize


def mean_angle_deg(
    a: Float[Tensor, "*batch 3"], b: Float[Tensor, "*batch 3"], mask: Bool[Tensor, "*batch 1"]
) -> float:
    """Mean angle between two direction fields inside a mask; need not be unit.

    A zero vector (a pixel that one side does not cover) counts as 90 degrees.
    """
    a, b = normalize(a.double()), normalize(b.double())
    # atan2 keeps small angles exact where acos loses half of the digits.
    angle = torch.atan2(
        torch.linalg.vector_norm(torch.linalg.cross(a, b), dim=-1), dot(a, b)[..., 0]
    )
    blank = (a.square().sum(-1) < 0.5) | (b.square().sum(-1) < 0.5)
    angle = torch.where(blank, math.pi / 2, angle)
    return math.degrees(float(angle[mask[..., 0]].mean()))
