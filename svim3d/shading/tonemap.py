"""From scene-linear radiance to display: exposure and the AgX view transform.

Source: T. Sobotka, AgX (2022); the polynomial and the outset of the "minimal AgX" port by
B. Wrensch (2023).
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

INSET = (
    (0.842479062253094, 0.0784335999999992, 0.0792237451477643),
    (0.0423282422610123, 0.878468636469772, 0.0791661274605434),
    (0.0423756549057051, 0.0784336, 0.879142973793104),
)
OUTSET = (
    (1.19687900512017, -0.0980208811401368, -0.0990297440797205),
    (-0.0528968517574562, 1.15190312990417, -0.0989611768448433),
    (-0.0529716355144438, -0.0980434501171241, 1.15107367264116),
)
MIN_STOPS, MAX_STOPS = -12.47393, 4.026069  # exposure range of the curve, log2 of linear light
# Contrast curve over the normalised range, highest power first; within 0.006 of the original table.
CONTRAST = (15.5, -40.14, 31.96, -6.868, 0.4298, 0.1191, -0.00232)
DISPLAY_POWER = 2.2  # the encoded result is decoded by this power, not by the sRGB curve


def expose(radiance: Float[Tensor, "*batch 3"], stops: float) -> Float[Tensor, "*batch 3"]:
    """Radiance scaled by 2^stops."""
    return radiance * math.exp2(stops)


def agx(radiance: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """Scene-linear Rec.709 radiance to display-encoded values in [0, 1].

    Middle grey 0.18 comes out at 0.5. Differentiable wherever the result is not clipped.
    """
    inset, outset = radiance.new_tensor(INSET), radiance.new_tensor(OUTSET)
    mixed = radiance.clamp_min(0.0) @ inset.T
    # The floor is the curve's own black; it keeps the logarithm finite.
    stops = mixed.clamp_min(2.0**MIN_STOPS).log2().clamp_max(MAX_STOPS)
    x = (stops - MIN_STOPS) / (MAX_STOPS - MIN_STOPS)
    curve = torch.zeros_like(x)
    for coefficient in CONTRAST:
        curve = curve * x + coefficient
    return (curve @ outset.T).clamp(0.0, 1.0)


def linear_from_agx(encoded: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """Display-linear light of display-encoded values."""
    return encoded.clamp_min(0.0).pow(DISPLAY_POWER)
