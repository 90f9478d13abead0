"""Ambient occlusion of surface points by the object itself, marched through its distance grid."""

import math
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numba import prange
from numpy.typing import NDArray
from torch import Tensor

from svim3d.compiled import kernel

START_CELLS = 2.0  # rays start this far off the surface, which the grid knows to within a cell
# And from this far above it, for a decimated mesh lies partly below: without it the flanks of a
# ball of 720 faces hide 1.1 % of the sky from each other (RMS), with it 0.2 %.
LIFT_CELLS = 0.5
MIN_STEP_CELLS = 0.5  # keeps rays that graze the surface from creeping
CONTACT_CELLS = 0.1  # nearer than this a ray has met the surface
GOLDEN_ANGLE = math.pi * (3.0 - math.sqrt(5.0))


def cosine_directions(count: int) -> Float[Tensor, "count 3"]:
    """Directions about +z spread evenly by cosine: each stands for an equal share of irradiance.

    Source: Vogel's spiral on the disc, lifted to the hemisphere (Malley's method).
    """
    index = torch.arange(count, dtype=torch.float64) + 0.5
    radius = (index / count).sqrt()
    angle = index * GOLDEN_ANGLE
    height = (1.0 - index / count).sqrt()
    spiral = torch.stack([radius * angle.cos(), radius * angle.sin(), height], 1)
    return spiral.float()


def ambient_occlusion(
    points: Float[Tensor, "N 3"],
    normals: Float[Tensor, "N 3"],
    sdf: Float[Tensor, "n n n"],
    *,
    half_extent: float,
    rays: int,
) -> Float[Tensor, "N 1"]:
    """Cosine-weighted share of the hemisphere that sees the sky, in [0, 1].

    Args:
        points: on the surface.
        normals: unit, outward.
        sdf: over [-half_extent, half_extent]^3, positive inside; at most about unit gradient.
        half_extent: half the side of the cube.
        rays: per point.
    """
    out = np.empty(len(points), np.float32)
    _occlusion(
        points.detach().cpu().float().contiguous().numpy(),
        normals.detach().cpu().float().contiguous().numpy(),
        sdf.detach().cpu().float().contiguous().numpy(),
        half_extent,
        cosine_directions(rays).numpy(),
        out,
    )
    return torch.from_numpy(out)[:, None].to(points.device)


@kernel()
def _value(sdf: NDArray[np.float32], x: Any, y: Any, z: Any) -> Any:
    """Trilinear value at a position in cells, inside the grid."""
    ix, iy, iz = int(x), int(y), int(z)
    u, v, w = x - ix, y - iy, z - iz
    near = (sdf[ix, iy, iz] * (1 - w) + sdf[ix, iy, iz + 1] * w) * (1 - v)
    near += (sdf[ix, iy + 1, iz] * (1 - w) + sdf[ix, iy + 1, iz + 1] * w) * v
    far = (sdf[ix + 1, iy, iz] * (1 - w) + sdf[ix + 1, iy, iz + 1] * w) * (1 - v)
    far += (sdf[ix + 1, iy + 1, iz] * (1 - w) + sdf[ix + 1, iy + 1, iz + 1] * w) * v
    return near * (1 - u) + far * u


@kernel()
def _escapes(
    sdf: NDArray[np.float32], origin: NDArray[Any], direction: NDArray[Any], scale: Any
) -> bool:
    """Whether a ray, in cells, leaves the grid without meeting the surface (sphere tracing)."""
    last = sdf.shape[0] - 1.001
    t = START_CELLS
    while True:
        x = origin[0] + t * direction[0]
        y = origin[1] + t * direction[1]
        z = origin[2] + t * direction[2]
        if min(x, y, z) < 0.0 or max(x, y, z) > last:
            return True
        outside = -_value(sdf, x, y, z) * scale
        if outside < CONTACT_CELLS:
            return False
        t += max(outside, MIN_STEP_CELLS)


@kernel(parallel=True, fastmath=False)
def _occlusion(
    points: NDArray[np.float32],
    normals: NDArray[np.float32],
    sdf: NDArray[np.float32],
    half_extent: float,
    directions: NDArray[np.float32],
    out: NDArray[np.float32],
) -> None:
    scale = (sdf.shape[0] - 1) / (2.0 * half_extent)
    for i in prange(points.shape[0]):
        n = normals[i]
        origin = (points[i] + half_extent) * scale + LIFT_CELLS * n
        # Orthonormal frame about the normal, without a branch. Source: Duff et al. 2017.
        sign = 1.0 if n[2] >= 0.0 else -1.0
        a = -1.0 / (sign + n[2])
        b = n[0] * n[1] * a
        tangent = np.array([1.0 + sign * n[0] * n[0] * a, sign * b, -sign * n[0]])
        bitangent = np.array([b, sign + n[1] * n[1] * a, -n[1]])
        free = 0
        for k in range(directions.shape[0]):
            d = directions[k]
            free += _escapes(sdf, origin, tangent * d[0] + bitangent * d[1] + n * d[2], scale)
        out[i] = free / directions.shape[0]
