"""Classifier-free guidance whose strength grows with the distance from the reference view.

The reference view needs none: it is given. The back has to be imagined.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True)
class GuidanceInterval:
    """Noise levels at which guidance acts; outside them the conditional answer is taken as it is.

    Source: Kynkaanniemi et al. 2024, "Applying Guidance in a Limited Interval".
    """

    low: float = 0.0
    high: float = float("inf")

    def holds(self, sigma: float) -> bool:
        """Whether guidance acts at this level."""
        return self.low < sigma <= self.high


def weights_by_index(frames: int, *, weakest: float, strongest: float) -> Float[Tensor, "frames"]:
    """Triangle over the frame index: weakest at both ends, strongest in the middle.

    Source: SV3D's sampler, tri(v) = 2 |v - floor(v + 1/2)| at v = k / (frames - 1).
    """
    phase = torch.arange(frames, dtype=torch.float64) / max(frames - 1, 1)
    return (weakest + (strongest - weakest) * _triangle(phase)).float()


def weights_by_azimuth(
    azimuth_deg: Float[Tensor, "frames"], *, weakest: float, strongest: float
) -> Float[Tensor, "frames"]:
    """Triangle over the azimuth: weakest at the reference view (0), strongest behind (180).

    What SViM3D calls "based on the distance to the reference view"; unlike the index it holds for
    any list of cameras.
    """
    phase = azimuth_deg.double() / 360.0
    return (weakest + (strongest - weakest) * _triangle(phase)).float()


def _triangle(phase: Float[Tensor, "frames"]) -> Float[Tensor, "frames"]:
    return 2.0 * (phase - (phase + 0.5).floor()).abs()


def guide(
    unconditional: Float[Tensor, "b k *rest"],
    conditional: Float[Tensor, "b k *rest"],
    weights: Float[Tensor, "k"],
) -> Float[Tensor, "b k *rest"]:
    """Extrapolate from the unconditional to the conditional answer, frame by frame."""
    strength = weights.to(conditional).view(1, -1, *[1] * (conditional.dim() - 2))
    return unconditional + strength * (conditional - unconditional)
