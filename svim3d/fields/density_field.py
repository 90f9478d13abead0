"""Volume density as a function of position: hash grid and one small network."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from svim3d.fields.hash_grid import HashGrid, HashGridSpec
from svim3d.fields.networks import Perceptron

START_DENSITY = 25.0  # per world unit: the hull starts opaque behind a skin of some hundredths
MAX_LOG_DENSITY = 9.0  # density 8100 per unit stops light within a ten-thousandth of the object


class DensityField(nn.Module):
    """Log density at world positions of the cube [-half_extent, half_extent]^3.

    Source: Mueller et al. 2022, sec. 5.4 (exponential activation), without view-dependent colour.
    """

    def __init__(self, spec: HashGridSpec, hidden: int, half_extent: float) -> None:
        super().__init__()
        self.half_extent = half_extent
        self.encoding = HashGrid(spec)
        self.network = Perceptron(self.encoding.width, hidden, 1)

    def reset(self, generator: torch.Generator) -> None:
        """Draw the start: nearly constant at `START_DENSITY`."""
        self.encoding.reset(generator)
        self.network.reset(generator)
        nn.init.constant_(self.network.second.bias, float(torch.tensor(START_DENSITY).log()))

    def forward(self, points: Float[Tensor, "N 3"]) -> Float[Tensor, "N 1"]:
        """Natural logarithm of the density per world unit, bounded above."""
        raw: Tensor = self.network(self.encoding(points / (2.0 * self.half_extent) + 0.5))
        return raw.clamp_max(MAX_LOG_DENSITY)
