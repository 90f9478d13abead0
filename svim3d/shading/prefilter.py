"""The prefiltered environment pyramid: radiance blurred by the GGX lobe of each roughness.

Prefiltering is linear in the radiance, so it is stored as two sparse operators: the map to its mip
stack, and the mip stack to all levels and the irradiance map. Two ways to fill the second:

- `sampled`: the paper's scheme, a few importance samples per texel, each read from a mip that
  matches its share of the lobe (filtered importance sampling).
- `exact`: the integral of the lobe itself, as a quadrature that is fine near the lobe's axis and
  coarse in its tail (see `lobe_quadrature`).

Level 0 is the map itself. The lobe assumes view, normal and reflection to coincide, as every
split-sum approximation does.
"""

import functools
from dataclasses import dataclass
from typing import Literal, Self

import numpy as np
import scipy.sparse
import torch
from jaxtyping import Float, Int
from torch import Tensor

from svim3d.shading.linear_operator import SparseOperator
from svim3d.shading.lobe_quadrature import exact_rows
from svim3d.shading.lobe_sampling import sampled_rows
from svim3d.shading.octahedral import (
    DOUBLE,
    bilinear_taps,
    sample_octahedral,
    texel_solid_angles,
)

PrefilterMode = Literal["sampled", "exact"]
SMALLEST_MIP = 4  # a 4 x 4 map still tells up from down
SAMPLED_ROUGHNESS = (0.0, 0.25, 0.5, 0.75, 1.0)  # Source: SViM3D, section 4
SAMPLED_COUNTS = (4, 16, 24, 24)  # Source: SViM3D, section 4; level 0 is not filtered
SAMPLED_IRRADIANCE_COUNT = 16  # Source: SViM3D, section 4
SAMPLED_SHIFT = (0, 1, 2, 3, 4)  # each level has half the side of the one before
# Steps of about two in lobe width keep the blend of two levels within 2 % under a broad light.
EXACT_ROUGHNESS = (0.0, 0.1, 0.18, 0.25, 0.35, 0.5, 0.7, 1.0)
EXACT_SHIFT = (0, 0, 1, 1, 2, 2, 2, 2)  # a texel is at most half as wide as the level's lobe
EXACT_ACCURACY = (0.7, 0.7, 0.7, 0.35, 0.35, 0.35, 0.35)  # coarse levels are cheap to do well
SMALLEST_LEVEL = 8  # keeps the widest lobe's gradient
IRRADIANCE_SIZE = 32  # at the map's creases bilinear lookup is off by half a texel's slope


@dataclass(frozen=True)
class PyramidLayout:
    """Where each level lies in the flat list of a pyramid's texels.

    Attributes:
        roughness: perceptual roughness that each level holds, from 0 to 1, increasing.
        sizes: side of each level's octahedral map.
        irradiance_size: side of the irradiance map, which comes last.
    """

    roughness: tuple[float, ...]
    sizes: tuple[int, ...]
    irradiance_size: int = IRRADIANCE_SIZE

    @property
    def offsets(self) -> tuple[int, ...]:
        """First texel of each level and of the irradiance map, and the total."""
        counts = [n * n for n in (*self.sizes, self.irradiance_size)]
        return tuple(int(total) for total in np.cumsum([0, *counts]))

    def locate(
        self, roughness: Float[Tensor, "P 1"]
    ) -> tuple[Int[Tensor, "P"], Float[Tensor, "P 1"]]:
        """Level below each roughness and the fraction towards the next, which has a gradient."""
        knots = roughness.new_tensor(self.roughness)
        level = torch.bucketize(roughness.detach()[:, 0].contiguous(), knots[1:-1], right=True)
        lower, upper = knots[level][:, None], knots[level + 1][:, None]
        return level, ((roughness - lower) / (upper - lower)).clamp(0.0, 1.0)


@dataclass(frozen=True)
class EnvironmentPyramid:
    """A prefiltered environment, ready for lookups.

    Attributes:
        texels: all levels and the irradiance map, flattened one after the other; linear radiance.
        layout: where each lies.
    """

    texels: Float[Tensor, "T 3"]
    layout: PyramidLayout

    def level(self, index: int) -> Float[Tensor, "n n 3"]:
        """One level as an octahedral map; the last index is the irradiance map."""
        sizes = (*self.layout.sizes, self.layout.irradiance_size)
        start, size = self.layout.offsets[index], sizes[index]
        return self.texels[start : start + size * size].view(size, size, 3)

    def specular(
        self, direction: Float[Tensor, "P 3"], roughness: Float[Tensor, "P 1"]
    ) -> Float[Tensor, "P 3"]:
        """Radiance from around `direction` under the lobe of `roughness`.

        Bilinear in the map, linear between levels; differentiable in everything.
        """
        level, fraction = self.layout.locate(roughness)
        sharp = self._level_lookup(direction, level)
        return sharp + fraction * (self._level_lookup(direction, level + 1) - sharp)

    def irradiance(self, normal: Float[Tensor, "P 3"]) -> Float[Tensor, "P 3"]:
        """Cosine-weighted mean radiance over the hemisphere: irradiance / pi."""
        return sample_octahedral(self.level(len(self.layout.sizes)), normal)

    def _level_lookup(self, direction: Tensor, level: Tensor) -> Tensor:
        sizes = torch.tensor(self.layout.sizes, device=level.device)[level]
        offsets = torch.tensor(self.layout.offsets, device=level.device)[level]
        indices, weights = bilinear_taps(direction, sizes)
        flat = (indices + offsets[:, None]).reshape(-1)
        taps = self.texels.index_select(0, flat).view(-1, 4, 3)
        return (taps * weights[..., None]).sum(1)


@dataclass(frozen=True)
class PyramidOperator:
    """The linear map from an octahedral environment to its pyramid.

    Attributes:
        size: side of the environment map.
        layout: levels of the pyramid.
        pool: map texels to the stack of all mips.
        prefilter: mip stack to levels 1.. and the irradiance map.
    """

    size: int
    layout: PyramidLayout
    pool: SparseOperator
    prefilter: SparseOperator

    @classmethod
    @functools.lru_cache(maxsize=4)
    def build(cls, size: int = 128, mode: PrefilterMode = "exact") -> Self:
        """Build the operator for size x size maps, size a power of two; about 0.5 s at 128."""
        if size < 2 * SMALLEST_MIP or size & (size - 1):
            raise ValueError(f"the environment's size must be a power of two >= 8, got {size}")
        mips = mip_sizes(size)
        if mode == "sampled":
            layout = _layout(size, SAMPLED_ROUGHNESS, SAMPLED_SHIFT)
            levels = list(zip(layout.sizes, layout.roughness, strict=True))[1:]
            blocks = [
                sampled_rows(n, mips, r, count)
                for (n, r), count in zip(levels, SAMPLED_COUNTS, strict=True)
            ]
            blocks.append(sampled_rows(IRRADIANCE_SIZE, mips, None, SAMPLED_IRRADIANCE_COUNT))
        else:
            layout = _layout(size, EXACT_ROUGHNESS, EXACT_SHIFT)
            levels = list(zip(layout.sizes, layout.roughness, strict=True))[1:]
            blocks = [
                exact_rows(n, mips, r, accuracy)
                for (n, r), accuracy in zip(levels, EXACT_ACCURACY, strict=True)
            ]
            blocks.append(exact_rows(IRRADIANCE_SIZE, mips, None, EXACT_ACCURACY[-1]))
        prefilter = SparseOperator(scipy.sparse.vstack(blocks).tocsr())
        return cls(size, layout, SparseOperator(pooling_matrix(size)), prefilter)

    def __call__(self, radiance: Float[Tensor, "n n 3"]) -> EnvironmentPyramid:
        """Prefilter a map; differentiable."""
        if radiance.shape[0] != self.size:
            raise ValueError(
                f"this operator prefilters {self.size}^2 maps, got {radiance.shape[0]}^2"
            )
        base = radiance.reshape(-1, 3)
        filtered = self.prefilter(self.pool(base))
        return EnvironmentPyramid(torch.cat([base, filtered]), self.layout)


def mip_sizes(size: int) -> tuple[int, ...]:
    """Sides of a map and its mips, finest first."""
    sizes = [size]
    while sizes[-1] > SMALLEST_MIP:
        sizes.append(sizes[-1] // 2)
    return tuple(sizes)


def pooling_matrix(size: int) -> scipy.sparse.csr_matrix:
    """Map texels to all mips, one below the other, the map itself first.

    A mip texel is the solid-angle weighted mean of the texels below it, which are its exact
    subdivision, so every mip holds the same energy.
    """
    omega = texel_solid_angles(size, DOUBLE).numpy().ravel()
    row, column = np.divmod(np.arange(size * size), size)
    blocks = []
    for n in mip_sizes(size):
        parent = (row * n // size) * n + column * n // size
        weights = omega / np.bincount(parent, omega)[parent]
        shape = (n * n, size * size)
        blocks.append(scipy.sparse.csr_matrix((weights, (parent, np.arange(size * size))), shape))
    return scipy.sparse.vstack(blocks).tocsr()


def _layout(size: int, roughness: tuple[float, ...], shifts: tuple[int, ...]) -> PyramidLayout:
    """Levels whose sides are `size` halved `shifts` times."""
    return PyramidLayout(roughness, tuple(max(size >> shift, SMALLEST_LEVEL) for shift in shifts))
