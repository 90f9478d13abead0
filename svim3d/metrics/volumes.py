"""The overlap of the volumes that two meshes enclose."""

import math

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray
from torch import Tensor

from svim3d.compiled import kernel

# Sample points stand off the cell centres by this share of a cell, so that columns never run
# along edges and faces of meshes that were cut from the same lattice.
OFF_LATTICE = math.pi * 1e-4


def occupancy(
    vertices: Float[Tensor, "N 3"],
    faces: Int[Tensor, "F 3"],
    *,
    resolution: int,
    half_extent: float,
) -> Bool[Tensor, "n n n"]:
    """Which cells of a grid over [-half_extent, half_extent]^3 have their centre inside a mesh.

    Inside is where the winding number, averaged over the six axis directions, exceeds one half.
    For closed meshes all six agree; parts may overlap; small holes and open rims are voted down.
    """
    corners = vertices.detach().cpu().double()[faces.cpu().long()].numpy()
    cell = 2.0 * half_extent / resolution
    # In units of cells, with the centre of cell 0 at 0.
    scaled = (corners + half_extent) / cell - 0.5 + OFF_LATTICE
    total = np.zeros((resolution,) * 3)
    for axis in range(3):
        # A cyclic shift keeps the handedness, and so the sign of the crossings.
        turned = np.ascontiguousarray(np.roll(scaled, -axis - 1, axis=2))
        crossings = np.zeros((resolution, resolution, resolution + 1), np.int32)
        _count_crossings(turned, crossings)
        before = np.cumsum(crossings, axis=2)[..., :-1]
        # Seen from below minus from above: the two ends of a ray through a closed mesh agree.
        winding = before - 0.5 * crossings.sum(2, keepdims=True)
        total += np.transpose(winding, np.roll((0, 1, 2), axis + 1))
    return torch.from_numpy(total / 3.0 > 0.5)


@kernel(fastmath=False)
def _count_crossings(corners: NDArray[np.float64], crossings: NDArray[np.int32]) -> None:
    """Count signed crossings of every column (x, y) below each cell; +1 enters along +z."""
    size = crossings.shape[0]
    for face in range(corners.shape[0]):
        ax, ay, az = corners[face, 0]
        bx, by, bz = corners[face, 1]
        cx, cy, cz = corners[face, 2]
        area = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
        if area == 0.0:
            continue
        x_first, x_last = (
            max(0, math.ceil(min(ax, bx, cx))),
            min(size - 1, math.floor(max(ax, bx, cx))),
        )
        y_first, y_last = (
            max(0, math.ceil(min(ay, by, cy))),
            min(size - 1, math.floor(max(ay, by, cy))),
        )
        for x in range(x_first, x_last + 1):
            for y in range(y_first, y_last + 1):
                u = ((bx - x) * (cy - y) - (cx - x) * (by - y)) / area
                v = ((cx - x) * (ay - y) - (ax - x) * (cy - y)) / area
                if u >= 0.0 and v >= 0.0 and u + v <= 1.0:
                    z = u * az + v * bz + (1.0 - u - v) * cz
                    cell = min(max(math.ceil(z), 0), size)
                    # A face whose normal points down is where a column enters.
                    crossings[x, y, cell] += 1 if area < 0.0 else -1


def volume_iou(a: Bool[Tensor, "n n n"], b: Bool[Tensor, "n n n"]) -> float:
    """Intersection over union of two occupancy grids; 1 if both are empty."""
    union = int((a | b).sum())
    return int((a & b).sum()) / union if union else 1.0
