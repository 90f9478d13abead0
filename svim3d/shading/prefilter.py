"""The prefiltered environment pyramid: radiance blurred by the GGX lobe of each roughness.

Prefiltering is linear in the radiance, so it is stored as two sparse operators: the map to its mip
stack, and the mip stack to all levels and the irradiance map. `prefilter_spec` says which levels
there are and how each row of the second is filled:

- by `lobe_sampling`, as the paper does: a few importance samples per texel, each read from a mip
  that matches its share of the lobe (filtered importance sampling);
- by `lobe_quadrature`: the integral of the lobe itself, fine near its axis and coarse in its tail.

Level 0 is the map itself. The lobe assumes view, normal and reflection to coincide, as every
split-sum approximation does.
"""

import functools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Self

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
from svim3d.shading.prefilter_spec import (
    IRRADIANCE_SIZE,
    SMALLEST_MIP,
    Integral,
    PrefilterMode,
    PrefilterProfile,
    PrefilterSpec,
)

TENSOR_NAMES = tuple(
    f"{operator}.{part}"
    for operator in ("pool", "prefilter")
    for part in ("pointers", "columns", "values", "shape")
)


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

    @classmethod
    def of(cls, spec: PrefilterSpec) -> Self:
        """The layout of a spec's pyramid: the map itself, then its levels."""
        *levels, irradiance = spec.levels()
        roughness = (0.0, *(level.roughness or 0.0 for level in levels))
        return cls(roughness, (spec.size, *(level.size for level in levels)), irradiance.size)

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
        spec: what it was built from.
        pool: map texels to the stack of all mips.
        prefilter: mip stack to levels 1.. and the irradiance map.
    """

    spec: PrefilterSpec
    pool: SparseOperator
    prefilter: SparseOperator

    @property
    def size(self) -> int:
        """Side of the environment map."""
        return self.spec.size

    @functools.cached_property
    def layout(self) -> PyramidLayout:
        """Levels of the pyramid."""
        return PyramidLayout.of(self.spec)

    @classmethod
    @functools.lru_cache(maxsize=4)
    def build(
        cls,
        size: int = 128,
        mode: PrefilterMode = "exact",
        profile: PrefilterProfile = "optimisation",
    ) -> Self:
        """Compute the operator, or hand out the one that was computed before.

        Raises:
            ValueError: see `PrefilterSpec`.
        """
        spec = PrefilterSpec(size, mode, profile)
        mips = mip_sizes(size)
        blocks = [
            exact_rows(level.size, mips, level.roughness, level.filter.accuracy)
            if isinstance(level.filter, Integral)
            else sampled_rows(
                level.size, mips, level.roughness, level.filter.count, level.filter.lod_bias
            )
            for level in spec.levels()
        ]
        prefilter = SparseOperator(scipy.sparse.vstack(blocks, format="csr"))
        return cls(spec, SparseOperator(pooling_matrix(size)), prefilter)

    def to_tensors(self) -> dict[str, Tensor]:
        """Both matrices as named tensors, which share memory with the operator."""
        tensors = {}
        for name, operator in (("pool", self.pool), ("prefilter", self.prefilter)):
            matrix = operator.forward_matrix
            tensors[f"{name}.pointers"] = torch.from_numpy(matrix.pointers)
            tensors[f"{name}.columns"] = torch.from_numpy(matrix.columns)
            tensors[f"{name}.values"] = torch.from_numpy(matrix.values)
            tensors[f"{name}.shape"] = torch.tensor(matrix.shape)
        return tensors

    @classmethod
    def from_tensors(cls, spec: PrefilterSpec, tensors: Mapping[str, Tensor]) -> Self:
        """The operator of `spec` from what `to_tensors` gave, bit for bit.

        Raises:
            ValueError: the tensors are not those of this spec, or are damaged.
        """
        stack = sum(n * n for n in mip_sizes(spec.size))
        texels = PyramidLayout.of(spec).offsets[-1] - spec.size**2
        shapes = {"pool": (stack, spec.size**2), "prefilter": (texels, stack)}
        if set(tensors) != set(TENSOR_NAMES):
            raise ValueError(f"a stored prefilter has the tensors {TENSOR_NAMES}, got {[*tensors]}")
        operators = [_restored(name, tensors, shape) for name, shape in shapes.items()]
        return cls(spec, *operators)

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
    return scipy.sparse.vstack(blocks, format="csr").astype(np.float32)


def _restored(name: str, tensors: Mapping[str, Tensor], shape: tuple[int, int]) -> SparseOperator:
    """One operator from its tensors, checked so that a product cannot leave its memory."""
    pointers, columns, values, stored = (
        tensors[f"{name}.{part}"] for part in ("pointers", "columns", "values", "shape")
    )
    whole = (
        stored.tolist() == list(shape)
        and (pointers.dtype, columns.dtype, values.dtype)
        == (torch.int64, torch.int32, torch.float32)
        and len(pointers) == shape[0] + 1
        and int(pointers[0]) == 0
        and int(pointers[-1]) == len(columns) == len(values)
        and bool((pointers[1:] >= pointers[:-1]).all())
        and 0 <= int(columns.min()) <= int(columns.max()) < shape[1]
        and bool(torch.isfinite(values).all())
    )
    if not whole:
        raise ValueError(
            f"the stored matrix {name} is damaged or not the {shape[0]} x {shape[1]} one that this "
            "spec needs; build it anew"
        )
    matrix = scipy.sparse.csr_matrix((values.numpy(), columns.numpy(), pointers.numpy()), shape)
    return SparseOperator(matrix)
