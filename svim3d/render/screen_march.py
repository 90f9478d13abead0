"""Rays marched through one depth image: which pixel's surface each of them meets, if any.

A ray is followed along its line on the picture. Every pixel on the way stands for a slab: what is
seen there, and whatever hides behind it to a fixed depth. Steps grow with distance, because a
pixel far away fills less of the ray's own solid angle.

Source: the marching of McGuire and Mara 2014, "Efficient GPU screen-space ray tracing"; the horizon
test of Bavoil et al. 2008, "Image-space horizon-based ambient occlusion".
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from numba import prange
from numpy.typing import NDArray
from torch import Tensor

from svim3d.cameras import NEAR, Cameras
from svim3d.compiled import kernel
from svim3d.numerics import dot

# The figures in brackets are mean PSNR against path-traced pictures, ten lit assets, two views.
THICKNESS = 0.2  # world units; longest side is 1 (0.03: 26.3 dB, 0.1: 26.7, 0.2: 26.8, 3: 25.7)
# Sine above the tangent plane below which depth is too coarse to block (without the margin that
# follows, 0.08 costs 0.06 dB and 0.25 nothing).
MIN_ELEVATION = 0.15
MARGIN_PX = 0.25  # and this far above it, as wide as pixels are there (0: 26.7 dB, 0.25: 26.8)
FIRST_STEP_PX = 1.5  # the next pixel but not the own one
STEP_GROWTH = 1.15  # about 25 steps cross a picture of 256 pixels
REACH = 2.0  # world units; no two points of an object with longest side 1 are farther apart
FREE = -1  # a ray that meets nothing


@dataclass(frozen=True)
class Relief:
    """The surface that one view sees, in the camera's frame.

    Attributes:
        focal_px: focal length.
        owner: which of the P pixels lies there, -1 where there is no surface.
        point: where the surface is.
        normal: unit geometric normals, towards the camera.
    """

    focal_px: float
    owner: Int[Tensor, "H W"]
    point: Float[Tensor, "P 3"]
    normal: Float[Tensor, "P 3"]

    @classmethod
    def of(
        cls, cameras: Cameras, view: int, pixels: Int[Tensor, "P"], world: Float[Tensor, "H W 3"]
    ) -> "Relief":
        """From the world-space points of chosen pixels (flat indices) of one view."""
        rotation, centre = cameras.c2w[view, :3, :3], cameras.positions[view]
        point = (world - centre) @ rotation
        owner = torch.full(world.shape[:2], -1, dtype=torch.int32)
        owner.view(-1)[pixels] = torch.arange(len(pixels), dtype=torch.int32)
        normal = surface_normals(point, owner >= 0)
        return cls(
            cameras.focal_px, owner, point.view(-1, 3)[pixels], normal.reshape(-1, 3)[pixels]
        )


def surface_normals(point: Float[Tensor, "H W 3"], covered: Tensor) -> Float[Tensor, "H W 3"]:
    """Unit normals of the surface through camera-space points, towards the camera.

    Of both neighbours along an axis the nearer in depth counts: the other may lie beyond an edge.
    """
    along_x, along_y = (_shorter_difference(point, covered, axis) for axis in (1, 0))
    normal = torch.linalg.cross(along_x, along_y)
    normal = torch.where(dot(normal, point) > 0.0, -normal, normal)
    return torch.nn.functional.normalize(normal, dim=-1)


def _shorter_difference(point: Tensor, covered: Tensor, axis: int) -> Tensor:
    forward = torch.roll(point, -1, axis) - point
    backward = point - torch.roll(point, 1, axis)
    step = [d[..., 2].abs() for d in (forward, backward)]
    for jump, shift in zip(step, (-1, 1), strict=True):
        jump[~torch.roll(covered, shift, axis)] = math.inf
    return torch.where((step[0] <= step[1])[..., None], forward, backward)


def march(relief: Relief, direction: Float[Tensor, "P K 3"]) -> Int[Tensor, "P K"]:
    """Which pixel each of K rays of each pixel meets, FREE where none; camera-frame directions."""
    hit = np.empty(direction.shape[:2], np.int32)
    _march(
        relief.focal_px,
        relief.owner.numpy(),
        relief.point.contiguous().numpy(),
        relief.normal.contiguous().numpy(),
        direction.contiguous().numpy(),
        step_offsets(*relief.owner.shape),
        hit,
    )
    return torch.from_numpy(hit)


def step_offsets(height: int, width: int) -> NDArray[np.float64]:
    """Distances from the start at which a ray is looked at, pixels."""
    offsets, step = [FIRST_STEP_PX], 1.0
    while offsets[-1] < math.hypot(height, width):
        step *= STEP_GROWTH
        offsets.append(offsets[-1] + step)
    return np.array(offsets)


@kernel(parallel=True, fastmath=False)
def _march(
    focal: float,
    owner: NDArray[np.int32],
    point: NDArray[Any],
    normal: NDArray[Any],
    direction: NDArray[Any],
    offsets: NDArray[np.float64],
    hit: NDArray[np.int32],
) -> None:
    height, width = owner.shape
    for p in prange(direction.shape[0]):
        px, py, pz = point[p, 0], point[p, 1], point[p, 2]
        column, row = 0.5 * width - focal * px / pz, 0.5 * height + focal * py / pz
        for k in range(direction.shape[1]):
            hit[p, k] = FREE
            dx, dy, dz = direction[p, k, 0], direction[p, k, 1], direction[p, k, 2]
            # The far end of the ray, before the camera's near plane.
            t = min(REACH, (-NEAR - pz) / dz) if dz > 0.0 else REACH
            ex, ey, ez = px + t * dx, py + t * dy, pz + t * dz
            across = 0.5 * width - focal * ex / ez - column
            down = 0.5 * height + focal * ey / ez - row
            span = math.sqrt(across * across + down * down)
            before = -pz
            for offset in offsets:
                # Written so that a ray along the line of sight, whose span is zero, ends as well.
                if not offset < span:
                    break
                share = offset / span
                i, j = math.floor(row + share * down), math.floor(column + share * across)
                if i < 0 or j < 0 or i >= height or j >= width:
                    break
                # Of all things along the ray, 1/z is what grows evenly on the picture.
                depth = -1.0 / (1.0 / pz + share * (1.0 / ez - 1.0 / pz))
                other = owner[i, j]
                if other >= 0:
                    front = -point[other, 2]
                    if max(depth, before) > front and min(depth, before) < front + THICKNESS:
                        qx, qy, qz = (
                            point[other, 0] - px,
                            point[other, 1] - py,
                            point[other, 2] - pz,
                        )
                        rise = qx * normal[p, 0] + qy * normal[p, 1] + qz * normal[p, 2]
                        reach = math.sqrt(qx * qx + qy * qy + qz * qz)
                        if rise > MIN_ELEVATION * reach - MARGIN_PX * pz / focal:
                            hit[p, k] = other
                            break
                before = depth


def march_plainly(relief: Relief, direction: Float[Tensor, "P K 3"]) -> Int[Tensor, "P K"]:
    """`march` in plain tensor operations: the twin of the compiled kernel."""
    height, width = relief.owner.shape
    size = torch.tensor([width, height]).to(direction)
    flip = torch.tensor([-relief.focal_px, relief.focal_px]).to(direction)
    point, normal = relief.point[:, None], relief.normal[:, None]
    start = 0.5 * size + flip * point[..., :2] / point[..., 2:]
    to_near = (-NEAR - point[..., 2:]) / direction[..., 2:]
    t = torch.where(direction[..., 2:] > 0.0, to_near.clamp_max(REACH), REACH)
    end = point + t * direction
    line = 0.5 * size + flip * end[..., :2] / end[..., 2:] - start
    span = line.square().sum(-1, keepdim=True).sqrt()
    hit = torch.full(direction.shape[:2], FREE, dtype=torch.int32)
    before = -point[..., 2].expand_as(hit)
    marching = torch.ones_like(hit, dtype=torch.bool)
    for offset in step_offsets(height, width):
        marching &= (offset < span)[..., 0]
        share = offset / span
        cell = (start + share * line).floor().nan_to_num(-1.0).long()
        marching &= ((cell >= 0) & (cell < size.long())).all(-1)
        j, i = torch.where(marching[..., None], cell, 0).unbind(-1)
        slope = 1.0 / end[..., 2] - 1.0 / point[..., 2]
        depth = -1.0 / (1.0 / point[..., 2] + share[..., 0] * slope)
        other = relief.owner[i, j]
        met = relief.point[other.clamp_min(0).long()]
        front, offset_to = -met[..., 2], met - point
        blocks = (torch.maximum(depth, before) > front) & (
            torch.minimum(depth, before) < front + THICKNESS
        )
        rise = dot(offset_to, normal.expand_as(offset_to))[..., 0]
        margin = MARGIN_PX * point[..., 2] / relief.focal_px
        blocks &= rise > MIN_ELEVATION * offset_to.square().sum(-1).sqrt() - margin
        blocks &= marching & (other >= 0)
        hit = torch.where(blocks, other, hit)
        marching &= ~blocks
        before = depth
    return hit
