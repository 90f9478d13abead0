"""Multiresolution hash encoding of positions.

Level l is a lattice of r_l cells per side whose nodes carry two features. A level with no more
nodes than the table has entries is stored densely (no collisions); a finer one hashes its nodes.
A position's features are interpolated trilinearly on every level and concatenated.
Source: Mueller et al. 2022, "Instant Neural Graphics Primitives", sec. 3.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from numba import prange
from numpy.typing import NDArray
from torch import Tensor, nn

from svim3d.compiled import kernel

FEATURES = 2  # per level: the best trade-off in Mueller et al. 2022, fig. 5
PRIME_Y, PRIME_Z = 2654435761, 805459861  # Source: Mueller et al. 2022, eq. 4
TABLE_INIT = 1e-4  # half width of the uniform start; Source: Mueller et al. 2022, sec. 4
Floats = NDArray[np.float32]
Ints = NDArray[np.int64]

POINTS_PER_TASK = 1024  # enough work to hide a thread's start, little enough to balance


@dataclass(frozen=True)
class HashGridSpec:
    """Shape of a hash grid.

    Attributes:
        levels: number of lattices.
        log2_entries: a level stores at most 2^log2_entries nodes.
        coarsest: cells per side of the first level.
        finest: cells per side of the last level; those between grow geometrically.
    """

    levels: int
    log2_entries: int
    coarsest: int
    finest: int

    @property
    def resolutions(self) -> list[int]:
        """Cells per side of each level."""
        growth = (self.finest / self.coarsest) ** (1.0 / max(self.levels - 1, 1))
        return [round(self.coarsest * growth**level) for level in range(self.levels)]

    @property
    def sizes(self) -> list[int]:
        """Stored nodes of each level."""
        return [min((r + 1) ** 3, 2**self.log2_entries) for r in self.resolutions]

    @property
    def hash_masks(self) -> list[int]:
        """Mask that maps a hash to a stored node; 0 marks a dense level."""
        dense = [(r + 1) ** 3 <= 2**self.log2_entries for r in self.resolutions]
        return [0 if is_dense else 2**self.log2_entries - 1 for is_dense in dense]

    @property
    def offsets(self) -> list[int]:
        """First row of each level in the table; one more entry for its end."""
        return [sum(self.sizes[:level]) for level in range(self.levels + 1)]


@dataclass(frozen=True)
class _Layout:
    """A spec's numbers as arrays for the kernels."""

    resolution: Ints
    offset: Ints
    mask: Ints
    order: Ints


def _layout(spec: HashGridSpec) -> _Layout:
    """Levels in `order` alternate, so that two threads get coarse and fine ones alike."""
    levels = range(spec.levels)
    return _Layout(
        np.array(spec.resolutions, np.int64),
        np.array(spec.offsets[:-1], np.int64),
        np.array(spec.hash_masks, np.int64),
        np.array([*levels[0::2], *levels[1::2]], np.int64),
    )


@kernel()
def _node(ix: int, iy: int, iz: int, resolution: int, mask: int) -> int:
    """Row of a lattice node within its level."""
    if mask == 0:
        return ix + (resolution + 1) * (iy + (resolution + 1) * iz)
    return (ix ^ (iy * PRIME_Y) ^ (iz * PRIME_Z)) & mask


@kernel()
def _cell(x: Any, resolution: int) -> tuple[int, Any]:
    """Cell index and position within the cell of a coordinate in [0, 1]; others are clamped."""
    scaled = min(max(x, np.float32(0.0)), np.float32(1.0)) * np.float32(resolution)
    index = min(int(scaled), resolution - 1)
    return index, scaled - np.float32(index)


@kernel(parallel=True)
def _encode_kernel(
    points: Floats,
    table: Floats,
    resolution: Ints,
    offset: Ints,
    mask: Ints,
    order: Ints,
    out: Floats,
) -> None:
    """Features of each point. A task is one level of one block of points.

    Neighbouring tasks share a level, so that its part of the table stays in a core's cache.
    """
    count = points.shape[0]
    blocks = (count + POINTS_PER_TASK - 1) // POINTS_PER_TASK
    one = np.float32(1.0)
    for task in prange(order.shape[0] * blocks):
        level, block = order[task // blocks], task % blocks
        r, base, hash_mask = resolution[level], offset[level], mask[level]
        for i in range(block * POINTS_PER_TASK, min(count, (block + 1) * POINTS_PER_TASK)):
            ix, x = _cell(points[i, 0], r)
            iy, y = _cell(points[i, 1], r)
            iz, z = _cell(points[i, 2], r)
            first = np.float32(0.0)
            second = np.float32(0.0)
            for corner in range(8):
                dx, dy, dz = corner & 1, (corner >> 1) & 1, corner >> 2
                weight = (x if dx else one - x) * (y if dy else one - y)
                weight *= z if dz else one - z
                row = base + _node(ix + dx, iy + dy, iz + dz, r, hash_mask)
                first += weight * table[row, 0]
                second += weight * table[row, 1]
            out[i, 2 * level] = first
            out[i, 2 * level + 1] = second


@kernel(parallel=True)
def _encode_backward_kernel(
    points: Floats,
    table: Floats,
    resolution: Ints,
    offset: Ints,
    mask: Ints,
    order: Ints,
    grad_out: Floats,
    grad_table: Floats,
    grad_points: Floats,
) -> None:
    """Gradients of table and points. Parallel over levels, each of which owns its rows.

    `grad_points` is [levels, N, 3], or of length 0 where points need no gradient.
    """
    one = np.float32(1.0)
    needs_points = grad_points.shape[0] > 0
    for task in prange(order.shape[0]):
        level = order[task]
        r, base, hash_mask = resolution[level], offset[level], mask[level]
        for i in range(points.shape[0]):
            ix, x = _cell(points[i, 0], r)
            iy, y = _cell(points[i, 1], r)
            iz, z = _cell(points[i, 2], r)
            first, second = grad_out[i, 2 * level], grad_out[i, 2 * level + 1]
            slope_x = np.float32(0.0)
            slope_y = np.float32(0.0)
            slope_z = np.float32(0.0)
            for corner in range(8):
                dx, dy, dz = corner & 1, (corner >> 1) & 1, corner >> 2
                weight_x = x if dx else one - x
                weight_y = y if dy else one - y
                weight_z = z if dz else one - z
                row = base + _node(ix + dx, iy + dy, iz + dz, r, hash_mask)
                weight = weight_x * weight_y * weight_z
                grad_table[row, 0] += weight * first
                grad_table[row, 1] += weight * second
                if needs_points:
                    pull = first * table[row, 0] + second * table[row, 1]
                    slope_x += (pull if dx else -pull) * weight_y * weight_z
                    slope_y += (pull if dy else -pull) * weight_x * weight_z
                    slope_z += (pull if dz else -pull) * weight_x * weight_y
            if needs_points:
                grad_points[level, i, 0] = slope_x * r
                grad_points[level, i, 1] = slope_y * r
                grad_points[level, i, 2] = slope_z * r


class _Encode(torch.autograd.Function):
    """The kernels as one differentiable operator."""

    @staticmethod
    def forward(ctx: Any, points: Tensor, table: Tensor, layout: _Layout) -> Tensor:
        points, table = points.detach().contiguous(), table.detach().contiguous()
        out = points.new_empty(len(points), FEATURES * len(layout.resolution))
        _encode_kernel(
            points.numpy(),
            table.numpy(),
            layout.resolution,
            layout.offset,
            layout.mask,
            layout.order,
            out.numpy(),
        )
        ctx.save_for_backward(points, table)
        ctx.layout = layout
        return out

    @staticmethod
    def backward(ctx: Any, grad_out: Tensor) -> tuple[Tensor | None, Tensor, None]:
        points, table = ctx.saved_tensors
        layout: _Layout = ctx.layout
        levels = len(layout.resolution) if ctx.needs_input_grad[0] else 0
        grad_table = torch.zeros_like(table)
        grad_points = points.new_empty(levels, len(points), 3)
        _encode_backward_kernel(
            points.numpy(),
            table.numpy(),
            layout.resolution,
            layout.offset,
            layout.mask,
            layout.order,
            grad_out.contiguous().numpy(),
            grad_table.numpy(),
            grad_points.numpy(),
        )
        if not levels:
            return None, grad_table, None
        inside = (points >= 0.0) & (points <= 1.0)
        return grad_points.sum(0) * inside, grad_table, None


def encode_reference(
    points: Float[Tensor, "N 3"], table: Float[Tensor, "rows 2"], spec: HashGridSpec
) -> Float[Tensor, "N features"]:
    """The encoding in plain torch: any device, any dtype, twice the definition of the kernels."""
    features = []
    for resolution, offset, mask in zip(
        spec.resolutions, spec.offsets[:-1], spec.hash_masks, strict=True
    ):
        scaled = points.clamp(0.0, 1.0) * resolution
        cell = scaled.detach().floor().clamp_max(resolution - 1)
        fraction, cell = scaled - cell, cell.long()
        level: Tensor | float = 0.0
        for corner in range(8):
            step = torch.tensor([corner & 1, (corner >> 1) & 1, corner >> 2], device=points.device)
            weight = torch.where(step.bool(), fraction, 1.0 - fraction).prod(-1, keepdim=True)
            level = level + weight * table[offset + _node_rows(cell + step, resolution, mask)]
        features.append(level)
    return torch.cat([f for f in features if isinstance(f, Tensor)], -1)


def _node_rows(node: Int[Tensor, "N 3"], resolution: int, mask: int) -> Int[Tensor, "N"]:
    """Rows of lattice nodes within their level."""
    x, y, z = node.unbind(-1)
    if mask == 0:
        return x + (resolution + 1) * (y + (resolution + 1) * z)
    return (x ^ (y * PRIME_Y) ^ (z * PRIME_Z)) & mask


class HashGrid(nn.Module):
    """Trainable encoding of positions in the unit cube; others are clamped to it.

    Differentiable in the table and in the positions (once).
    """

    def __init__(self, spec: HashGridSpec) -> None:
        super().__init__()
        self.spec = spec
        self._layout = _layout(spec)
        self.table = nn.Parameter(torch.zeros(spec.offsets[-1], FEATURES))

    @property
    def width(self) -> int:
        """Features per position."""
        return FEATURES * self.spec.levels

    def reset(self, generator: torch.Generator) -> None:
        """Draw the small random start of the table."""
        nn.init.uniform_(self.table, -TABLE_INIT, TABLE_INIT, generator=generator)

    def forward(self, points: Float[Tensor, "N 3"]) -> Float[Tensor, "N features"]:
        """Features at `points` in [0, 1]^3."""
        if points.device.type == "cpu" and points.dtype == torch.float32:
            encoded: Tensor = _Encode.apply(points, self.table, self._layout)  # type: ignore[no-untyped-call]
            return encoded
        return encode_reference(points, self.table, self.spec)
