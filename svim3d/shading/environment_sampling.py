"""Light directions drawn in proportion to an environment's radiance.

The density is constant on each texel of the octahedral square: the mean luminance of the bilinear
lookup there, times solid angle, chosen by inverting the cumulative sum. Per solid angle it follows
from the map's exact Jacobian. Every direction that the lookup finds lit can be drawn.

Source: Pharr, Jakob and Humphreys 2023, "Physically based rendering", section 12.5.
"""

from dataclasses import dataclass
from typing import Self

import torch
from jaxtyping import Float, Int
from torch import Tensor

from svim3d.color import luminance
from svim3d.shading.octahedral import (
    direction_from_octahedral,
    octahedral_from_direction,
    sample_octahedral,
    texel_directions,
    texel_solid_angles,
)


@dataclass(frozen=True)
class SampledLight:
    """An environment that directions can be drawn from.

    Attributes:
        radiance: octahedral map, linear, not negative.
        cumulative: probability of all texels up to and including each, row by row; ends at one.
        probability: of each texel, per area of the square [-1, 1]^2.
    """

    radiance: Float[Tensor, "n n 3"]
    cumulative: Float[Tensor, "N"]
    probability: Float[Tensor, "N"]

    @classmethod
    def build(cls, radiance: Float[Tensor, "n n 3"]) -> Self:
        """Prepare an octahedral map of even size; a black one is drawn from evenly."""
        n = radiance.shape[0]
        # Quarter-texel points give the exact mean of a bilinear lookup over a texel.
        fine = luminance(sample_octahedral(radiance, texel_directions(2 * n, radiance).view(-1, 3)))
        mean = fine.double().view(n, 2, n, 2).mean((1, 3))
        energy = (mean * texel_solid_angles(n, mean)).view(-1)
        if float(energy.sum()) <= 0.0:
            energy = torch.ones_like(energy)
        cumulative = energy.cumsum(0)
        share = energy / cumulative[-1]
        return cls(radiance, cumulative / cumulative[-1], (share * (0.25 * n * n)).to(radiance))

    def sample(self, u: Float[Tensor, "P 2"]) -> Float[Tensor, "P 3"]:
        """Unit directions of points u in [0, 1)^2."""
        n = self.radiance.shape[0]
        target = u[:, 0].contiguous().double()
        texel = torch.searchsorted(self.cumulative, target, right=True).clamp_max(n * n - 1)
        above = self.cumulative[texel]
        below = torch.where(texel > 0, self.cumulative[texel - 1], 0.0)
        # Where the first coordinate fell within its texel's share is as good as a fresh number.
        column = texel % n + ((target - below) / (above - below)).clamp(0.0, 1.0)
        row = texel // n + u[:, 1].double()
        return direction_from_octahedral(torch.stack([column, row], -1) * (2.0 / n) - 1.0).to(u)

    def density(self, direction: Float[Tensor, "P 3"]) -> Float[Tensor, "P 1"]:
        """Probability density of unit directions, per steradian."""
        jacobian = direction.abs().sum(-1, keepdim=True) ** 3  # steradian per area of the square
        return self.probability[self._texel(direction)][:, None] / jacobian

    def _texel(self, direction: Tensor) -> Int[Tensor, "P"]:
        """Flat index of the texel that a direction falls in."""
        n = self.radiance.shape[0]
        square = octahedral_from_direction(direction) * 0.5 + 0.5
        column, row = (square * n).long().clamp(0, n - 1).unbind(-1)
        return row * n + column
