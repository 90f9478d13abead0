"""Materials as a function of position: hash grid, one small network, ranges."""

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from svim3d.color import linear_from_srgb
from svim3d.fields.hash_grid import HashGrid, HashGridSpec
from svim3d.fields.networks import Perceptron

OUTPUTS = 8  # basecolor 3, roughness, metallic, bump 3
FIRST_BUMP_OUTPUT = 5
START_VALUE = 0.5  # all ranged outputs begin near the middle of their range


@dataclass(frozen=True)
class MaterialFieldSpec:
    """Shape of a material field: plain numbers, so that it is stored as JSON.

    Attributes:
        levels: lattices of the hash grid.
        log2_entries: a level stores at most 2^log2_entries nodes.
        coarsest: cells per side of the first level.
        finest: cells per side of the last level.
        hidden: width of the network's hidden layer.
        half_extent: the field covers [-half_extent, half_extent]^3, world units.
    """

    levels: int = 8
    log2_entries: int = 15
    coarsest: int = 16
    finest: int = 256
    hidden: int = 32
    half_extent: float = 0.55

    @property
    def grid(self) -> HashGridSpec:
        """Shape of the hash grid."""
        return HashGridSpec(self.levels, self.log2_entries, self.coarsest, self.finest)


@dataclass(frozen=True)
class Materials:
    """Material at N points.

    Attributes:
        basecolor: linear, in [0, 1].
        roughness: perceptual, in [0, 1].
        metallic: in [0, 1].
        bump: world-space offset of the normal; shading normal = normalize(geometric + bump).
    """

    basecolor: Float[Tensor, "N 3"]
    roughness: Float[Tensor, "N 1"]
    metallic: Float[Tensor, "N 1"]
    bump: Float[Tensor, "N 3"]


class _ClampInward(torch.autograd.Function):
    """Clamp to [0, 1] whose gradient vanishes only where it would lead further out."""

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        ctx.save_for_backward(x)
        return x.clamp(0.0, 1.0)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> Tensor:
        (x,) = ctx.saved_tensors
        # A step goes against the gradient.
        outward = ((x < 0.0) & (grad > 0.0)) | ((x > 1.0) & (grad < 0.0))
        return grad.masked_fill(outward, 0.0)


class MaterialField(nn.Module):
    """Position in the world to material.

    The network speaks sRGB for the basecolor: equal steps of its output are about equally visible,
    so dark materials are fitted as well as bright ones. Ranges are imposed by a clamp, not by a
    sigmoid: most metallic values are exactly 0 or 1, where a sigmoid has no gradient left to learn
    that a small part differs.
    """

    def __init__(self, spec: MaterialFieldSpec) -> None:
        super().__init__()
        self.spec = spec
        self.encoding = HashGrid(spec.grid)
        self.network = Perceptron(self.encoding.width, spec.hidden, OUTPUTS)

    def reset(self, generator: torch.Generator) -> None:
        """Draw the start; bump begins at exactly zero everywhere."""
        self.encoding.reset(generator)
        self.network.reset(generator)
        with torch.no_grad():
            self.network.second.weight[FIRST_BUMP_OUTPUT:] = 0.0

    def forward(self, points: Float[Tensor, "N 3"]) -> Materials:
        """Materials at world positions; positions outside the cube take its border's material."""
        unit = points / (2.0 * self.spec.half_extent) + 0.5
        raw = self.network(self.encoding(unit))
        ranged: Tensor = _ClampInward.apply(START_VALUE + raw[:, :FIRST_BUMP_OUTPUT])  # type: ignore[no-untyped-call]
        return Materials(
            basecolor=linear_from_srgb(ranged[:, :3]),
            roughness=ranged[:, 3:4],
            metallic=ranged[:, 4:5],
            bump=raw[:, FIRST_BUMP_OUTPUT:],
        )
