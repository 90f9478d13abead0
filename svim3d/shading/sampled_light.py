"""An environment map as a density of light directions: bright directions are drawn more often.

The density is constant on every texel of the octahedral square. A texel's share is what it sends
through the bilinear lookup: luminance times solid angle, neighbours included.
"""

from dataclasses import dataclass
from typing import Self

import torch
from jaxtyping import Float
from torch import Tensor

from svim3d.color import luminance
from svim3d.shading.octahedral import (
    DOUBLE,
    direction_from_octahedral,
    octahedral_from_direction,
    texel_solid_angles,
)

# Mean over a texel of the bilinear weight of the texel before, itself, and the one after.
BILINEAR_SHARES = (0.125, 0.75, 0.125)


@dataclass(frozen=True)
class SampledLight:
    """An octahedral map with what it takes to draw directions from it, in double precision.

    Attributes:
        radiance: linear Rec.709, not negative.
        cumulative: probability of all texels up to and including each, flat; the last is one.
        density: probability per area of the square, which is 4; constant on a texel, flat.
    """

    radiance: Float[Tensor, "n n 3"]
    cumulative: Float[Tensor, "texels"]
    density: Float[Tensor, "texels"]

    @classmethod
    def build(cls, radiance: Float[Tensor, "n n 3"]) -> Self:
        """Tabulate a map of even size; a black map is sampled evenly over the sphere."""
        if not bool((torch.isfinite(radiance) & (radiance >= 0.0)).all()):
            raise ValueError(
                "light can be sampled only where radiance is finite and not negative; "
                "mend the map with `environment.physical_radiance` first"
            )
        radiance = radiance.double()
        n = radiance.shape[0]
        omega = texel_solid_angles(n, DOUBLE).to(radiance.device)
        energy = _texel_means(luminance(radiance)) * omega
        if float(energy.sum()) == 0.0:
            energy = omega
        cumulative = energy.reshape(-1).cumsum(0)
        cumulative = cumulative / cumulative[-1]
        share = cumulative.diff(prepend=cumulative.new_zeros(1))
        return cls(radiance, cumulative, share * (n * n / 4.0))

    def sample(self, u: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        """Unit directions from three uniform numbers in [0, 1): texel, column and row in it."""
        n = self.radiance.shape[0]
        # The first texel whose cumulative share exceeds the number, never one without a share.
        texel = torch.searchsorted(self.cumulative, u[..., 0].contiguous(), right=True)
        texel = texel.clamp_max(n * n - 1)
        column, row = texel % n + u[..., 1], texel // n + u[..., 2]
        return direction_from_octahedral(torch.stack([column, row], -1) * (2.0 / n) - 1.0)

    def density_towards(self, wi: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 1"]:
        """Probability per steradian with which `sample` draws unit directions.

        A unit d sees |d|_1^3 steradian per area of the square.
        """
        n = self.radiance.shape[0]
        column, row = ((octahedral_from_direction(wi) + 1.0) * (0.5 * n)).long().unbind(-1)
        texel = row.clamp(0, n - 1) * n + column.clamp(0, n - 1)
        return self.density[texel][..., None] / wi.abs().sum(-1, keepdim=True) ** 3


def padded(map_: Float[Tensor, "n n c"]) -> Float[Tensor, "n+2 n+2 c"]:
    """The map with one more texel on every side, taken from across the square's seams."""
    map_ = torch.cat([map_[:1].flip(1), map_, map_[-1:].flip(1)])
    return torch.cat([map_[:, :1].flip(0), map_, map_[:, -1:].flip(0)], 1)


def _texel_means(values: Float[Tensor, "n n 1"]) -> Float[Tensor, "n n"]:
    """Mean of the bilinear lookup over every texel."""
    wide, (before, own, after) = padded(values)[..., 0], BILINEAR_SHARES
    rows = before * wide[:-2] + own * wide[1:-1] + after * wide[2:]
    return before * rows[:, :-2] + own * rows[:, 1:-1] + after * rows[:, 2:]
