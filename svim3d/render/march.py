"""Samples along rays, only where a surface may be."""

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numba import prange
from numpy.typing import NDArray
from torch import Tensor

from svim3d.compiled import kernel

Floats = NDArray[np.float32]
Ints = NDArray[np.int64]
Bytes = NDArray[np.uint8]

EMPTY, SURFACE, SOLID = 0, 1, 2  # a cell: pass through, sample, end the ray
MIN_DIRECTION = 1e-9  # keeps 1/d finite for rays along an axis


@dataclass(frozen=True)
class Rays:
    """R rays with unit directions, world space."""

    origins: Float[Tensor, "R 3"]
    directions: Float[Tensor, "R 3"]

    def __len__(self) -> int:
        return len(self.origins)


@dataclass(frozen=True)
class Samples:
    """N samples on R rays, packed: a ray's samples are neighbours, near to far.

    Attributes:
        points: world positions.
        distance: from the ray's origin.
        ray: index of the ray of each sample.
        starts: the samples of ray r are `starts[r]:starts[r + 1]`.
    """

    points: Float[Tensor, "N 3"]
    distance: Float[Tensor, "N 1"]
    ray: Int[Tensor, "N"]
    starts: Int[Tensor, "R1"]

    def __len__(self) -> int:
        return len(self.points)

    def select(self, chosen: Int[Tensor, "M"]) -> "Samples":
        """The samples at increasing indices `chosen`, still grouped by ray."""
        return replace(
            self,
            points=self.points.index_select(0, chosen),
            distance=self.distance.index_select(0, chosen),
            ray=self.ray.index_select(0, chosen),
            starts=torch.searchsorted(chosen, self.starts),
        )


# Both passes must agree to the last bit on every sample's place, so none may be reassociated.
@kernel(fastmath=False)
def _cube_span(origin: Floats, direction: Floats, half_extent: Any) -> tuple[Any, Any]:
    """Distances at which a ray enters and leaves the cube; empty when the first is greater."""
    near, far = np.float32(0.0), np.float32(np.inf)
    for axis in range(3):
        d = direction[axis]
        if abs(d) < MIN_DIRECTION:
            d = np.float32(MIN_DIRECTION)
        a = (-half_extent - origin[axis]) / d
        b = (half_extent - origin[axis]) / d
        near, far = max(near, min(a, b)), min(far, max(a, b))
    return near, far


@kernel(fastmath=False)
def _state_at(
    origin: Floats, direction: Floats, t: Any, cells: Bytes, half_extent: Any, scale: Any
) -> int:
    """State of the cell at distance t."""
    last = cells.shape[0] - 1
    x = min(max(int((origin[0] + t * direction[0] + half_extent) * scale), 0), last)
    y = min(max(int((origin[1] + t * direction[1] + half_extent) * scale), 0), last)
    z = min(max(int((origin[2] + t * direction[2] + half_extent) * scale), 0), last)
    return int(cells[x, y, z])


@kernel(parallel=True, fastmath=False)
def _count_kernel(
    origins: Floats,
    directions: Floats,
    jitter: Floats,
    cells: Bytes,
    half_extent: Any,
    step: Any,
    counts: Ints,
) -> None:
    """Samples per ray."""
    scale = np.float32(cells.shape[0] / (np.float32(2.0) * half_extent))
    for i in prange(len(origins)):
        near, far = _cube_span(origins[i], directions[i], half_extent)
        count, k = 0, 0
        t = near + step * jitter[i]
        while t < far:
            state = _state_at(origins[i], directions[i], t, cells, half_extent, scale)
            if state == SOLID:
                break
            count += state
            k += 1
            t = near + step * (np.float32(k) + jitter[i])
        counts[i] = count


@kernel(parallel=True, fastmath=False)
def _fill_kernel(
    origins: Floats,
    directions: Floats,
    jitter: Floats,
    cells: Bytes,
    half_extent: Any,
    step: Any,
    starts: Ints,
    points: Floats,
    distance: Floats,
    ray: Ints,
) -> None:
    """Second pass: write what the first has counted."""
    scale = np.float32(cells.shape[0] / (np.float32(2.0) * half_extent))
    for i in prange(len(origins)):
        near, _ = _cube_span(origins[i], directions[i], half_extent)
        slot, k = starts[i], 0
        while slot < starts[i + 1]:
            t = near + step * (np.float32(k) + jitter[i])
            if _state_at(origins[i], directions[i], t, cells, half_extent, scale) == SURFACE:
                for axis in range(3):
                    points[slot, axis] = origins[i, axis] + t * directions[i, axis]
                distance[slot, 0] = t
                ray[slot] = i
                slot += 1
            k += 1


def march_reference(
    rays: Rays,
    cells: Tensor,
    *,
    half_extent: float,
    step: float,
    jitter: Float[Tensor, "R"],
) -> Samples:
    """`march` in plain torch, on any device: all lattice points of all rays, then a mask."""
    d = rays.directions
    d = torch.where(d.abs() < MIN_DIRECTION, torch.full_like(d, MIN_DIRECTION), d)
    a, b = (-half_extent - rays.origins) / d, (half_extent - rays.origins) / d
    near = torch.minimum(a, b).amax(-1).clamp_min(0.0)
    far = torch.maximum(a, b).amin(-1)
    lattice = torch.arange(
        math.ceil(2.0 * math.sqrt(3.0) * half_extent / step) + 1, device=d.device
    ).to(d.dtype)
    t = near[:, None] + step * (lattice + jitter[:, None])
    points = rays.origins[:, None] + t[..., None] * rays.directions[:, None]
    scale = len(cells) / (2.0 * half_extent)
    x, y, z = ((points + half_extent) * scale).long().clamp(0, len(cells) - 1).unbind(-1)
    state = cells[x, y, z]
    alive = (t < far[:, None]) & (((state == SOLID) & (t < far[:, None])).cumsum(1) == 0)
    ray, column = torch.nonzero(alive & (state == SURFACE), as_tuple=True)
    edges = torch.arange(len(rays) + 1, device=d.device)
    return Samples(
        points[ray, column], t[ray, column][:, None], ray, torch.searchsorted(ray, edges)
    )


def march(
    rays: Rays,
    cells: Tensor,
    *,
    half_extent: float,
    step: float,
    jitter: Float[Tensor, "R"],
) -> Samples:
    """Equidistant samples of each ray within cells that may hold surface.

    Args:
        rays: where to look.
        cells: uint8 [c, c, c] states over [-half_extent, half_extent]^3: EMPTY is skipped, SURFACE
            sampled, and the first SOLID cell ends the ray.
        half_extent: half the side of the cube, world units.
        step: distance between samples, world units.
        jitter: offset of each ray's first sample in [0, 1) steps behind its entry to the cube.

    Returns:
        Packed samples; no gradients flow through them.
    """
    if cells.device.type != "cpu" or rays.origins.dtype != torch.float32:
        return march_reference(rays, cells, half_extent=half_extent, step=step, jitter=jitter)
    arguments = (
        rays.origins.contiguous().numpy(),
        rays.directions.contiguous().numpy(),
        jitter.contiguous().numpy(),
        cells.numpy(),
        np.float32(half_extent),
        np.float32(step),
    )
    starts = torch.zeros(len(rays) + 1, dtype=torch.int64)
    _count_kernel(*arguments, starts.numpy()[1:])
    starts = starts.cumsum(0)
    total = int(starts[-1])
    points, distance = torch.empty(total, 3), torch.empty(total, 1)
    ray = torch.empty(total, dtype=torch.int64)
    _fill_kernel(*arguments, starts.numpy(), points.numpy(), distance.numpy(), ray.numpy())
    return Samples(points, distance, ray, starts)


@kernel(parallel=True)
def _classify_kernel(sdf: Floats, band: Any, cells: Bytes) -> None:
    """State of each cell from its eight nodes."""
    for i in prange(cells.shape[0]):
        for j in range(cells.shape[1]):
            for k in range(cells.shape[2]):
                low = min(sdf[i, j, k], sdf[i, j, k + 1])
                high = max(sdf[i, j, k], sdf[i, j, k + 1])
                for corner in range(1, 4):
                    a, b = i + (corner & 1), j + (corner >> 1)
                    low = min(low, sdf[a, b, k], sdf[a, b, k + 1])
                    high = max(high, sdf[a, b, k], sdf[a, b, k + 1])
                cells[i, j, k] = EMPTY if high <= -band else SOLID if low >= band else SURFACE


def classify_cells(sdf: Float[Tensor, "n n n"], band: float) -> Tensor:
    """Cell states (uint8, n - 1 per side) for a signed distance, positive inside.

    SURFACE where |sdf| < band somewhere in the cell, SOLID deeper inside, EMPTY further outside.
    Both are exact for a trilinear function, which takes its extremes at the nodes.
    """
    if sdf.device.type == "cpu" and sdf.dtype == torch.float32:
        cells = torch.empty([n - 1 for n in sdf.shape], dtype=torch.uint8)
        _classify_kernel(sdf.detach().contiguous().numpy(), np.float32(band), cells.numpy())
        return cells
    pool = torch.nn.functional.max_pool3d
    high = pool(sdf.detach()[None, None], 2, stride=1)[0, 0]
    low = -pool(-sdf.detach()[None, None], 2, stride=1)[0, 0]
    surface = torch.full_like(high, SURFACE, dtype=torch.uint8)
    surface[high <= -band] = EMPTY
    surface[low >= band] = SOLID
    return surface


def hits_surface(
    rays: Rays, cells: Tensor, *, half_extent: float, step: float
) -> Bool[Tensor, "R"]:
    """Whether each ray meets a cell that may hold surface."""
    jitter = rays.origins.new_full((len(rays),), 0.5)
    starts = march(rays, cells, half_extent=half_extent, step=step, jitter=jitter).starts
    return starts[1:] > starts[:-1]
