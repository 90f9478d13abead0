"""The visual hull: the largest shape whose silhouettes agree with the masks."""

import math
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from numba import prange
from numpy.typing import NDArray
from torch import Tensor

from svim3d.compiled import kernel
from svim3d.fields.sdf_grid import node_positions

Floats = NDArray[np.float32]

INSIDE_COVERAGE = 0.5  # a box-filtered silhouette passes through half-covered pixels
MAX_REJECTIONS = 7  # length of the kernel's sorted list, less one
NODES_PER_PIXEL = 1.5  # at the middle of the object; leaves room for nearer parts


@kernel()
def _coverage(mask: Floats, column: Any, row: Any) -> Any:
    """Bilinear mask value at continuous pixel coordinates.

    Beyond the image it continues as at its border: empty, or full where the object is cut off.
    """
    height, width = mask.shape
    one = np.float32(1.0)
    x = min(max(column - np.float32(0.5), np.float32(0.0)), np.float32(width - 1))
    y = min(max(row - np.float32(0.5), np.float32(0.0)), np.float32(height - 1))
    left, top = min(int(x), width - 2), min(int(y), height - 2)
    u, v = x - np.float32(left), y - np.float32(top)
    upper = mask[top, left] * (one - u) + mask[top, left + 1] * u
    lower = mask[top + 1, left] * (one - u) + mask[top + 1, left + 1] * u
    return upper * (one - v) + lower * v


@kernel(parallel=True)
def _votes_kernel(
    masks: Floats, matrices: Floats, axis: Floats, rejections: int, out: Floats
) -> None:
    """The (rejections + 1)-th smallest coverage over the views at every node."""
    views, height, width = masks.shape
    half, one = np.float32(0.5), np.float32(1.0)
    for i in prange(len(axis)):
        smallest = np.empty(MAX_REJECTIONS + 1, np.float32)
        for j in range(len(axis)):
            for k in range(len(axis)):
                smallest[: rejections + 1] = one
                for view in range(views):
                    m = matrices[view]
                    w = m[3, 0] * axis[i] + m[3, 1] * axis[j] + m[3, 2] * axis[k] + m[3, 3]
                    if w <= 0.0:
                        continue  # behind this camera: it has no evidence
                    x = m[0, 0] * axis[i] + m[0, 1] * axis[j] + m[0, 2] * axis[k] + m[0, 3]
                    y = m[1, 0] * axis[i] + m[1, 1] * axis[j] + m[1, 2] * axis[k] + m[1, 3]
                    value = _coverage(
                        masks[view],
                        (x / w * half + half) * np.float32(width),
                        (half - y / w * half) * np.float32(height),
                    )
                    for place in range(rejections + 1):
                        if value < smallest[place]:
                            value, smallest[place] = smallest[place], value
                    if smallest[rejections] <= 0.0:
                        break
                out[i, j, k] = smallest[rejections]


def coverage_votes_reference(
    masks: Float[Tensor, "V H W"],
    clip_from_world: Float[Tensor, "V 4 4"],
    nodes: int,
    half_extent: float,
    rejections: int,
) -> Float[Tensor, "n n n"]:
    """`coverage_votes` in plain torch, on any device."""
    points = node_positions(nodes, half_extent, like=masks).reshape(-1, 3)
    kept = masks.new_ones(rejections + 1, len(points))
    for mask, matrix in zip(masks, clip_from_world, strict=True):
        value = _coverage_at(points, mask, matrix)
        kept = torch.cat([kept, value[None]]).sort(0).values[: rejections + 1]
    return kept[rejections].view(nodes, nodes, nodes)


def _coverage_at(
    points: Float[Tensor, "N 3"], mask: Float[Tensor, "H W"], matrix: Float[Tensor, "4 4"]
) -> Float[Tensor, "N"]:
    """Bilinear mask values where a camera sees points; one behind it, where it has no evidence."""
    clip = points @ matrix[:, :3].T + matrix[:, 3]
    ndc = clip[:, :2] / clip[:, 3:]
    grid = torch.stack([ndc[:, 0], -ndc[:, 1]], -1)
    value = torch.nn.functional.grid_sample(
        mask[None, None], grid[None, None], padding_mode="border", align_corners=False
    ).view(-1)
    return value.masked_fill(clip[:, 3] <= 0.0, 1.0)


def lone_carving(
    masks: Float[Tensor, "V H W"],
    clip_from_world: Float[Tensor, "V 4 4"],
    *,
    nodes: int,
    half_extent: float,
) -> Float[Tensor, "V"]:
    """Share of the hull of all others that each mask takes away, on a cubic grid.

    True masks around an object leave each other little to take: what a view does not show as
    background, its neighbours nearly do. A mask that is wrong takes what no other does.
    """
    points = node_positions(nodes, half_extent, like=masks).reshape(-1, 3)
    excluded = torch.stack(
        [
            _coverage_at(points, mask, matrix) < INSIDE_COVERAGE
            for mask, matrix in zip(masks, clip_from_world, strict=True)
        ]
    )
    votes = excluded.sum(0)
    taken = (excluded & (votes == 1)).sum(1).to(masks)
    return taken / ((votes == 0).sum() + taken).clamp_min(1.0)


def coverage_votes(
    masks: Float[Tensor, "V H W"],
    clip_from_world: Float[Tensor, "V 4 4"],
    *,
    nodes: int,
    half_extent: float,
    rejections: int,
) -> Float[Tensor, "n n n"]:
    """How well the masks support each node of a cubic grid.

    Args:
        masks: coverage in [0, 1].
        clip_from_world: the cameras.
        nodes: nodes per side over [-half_extent, half_extent]^3.
        half_extent: half the side of the cube, world units.
        rejections: masks that may exclude a point of the object by mistake. 0 is the strict hull;
            views that disagree by a pixel or two carve it thin, and 1 or 2 restore it.

    Returns:
        The (rejections + 1)-th smallest coverage over the views that see the node.
    """
    if not 0 <= rejections <= MAX_REJECTIONS:
        raise ValueError(f"rejections must lie in [0, {MAX_REJECTIONS}], got {rejections}")
    if masks.device.type != "cpu" or masks.dtype != torch.float32:
        return coverage_votes_reference(masks, clip_from_world, nodes, half_extent, rejections)
    votes = masks.new_empty(nodes, nodes, nodes)
    axis = np.linspace(-half_extent, half_extent, nodes, dtype=np.float32)
    _votes_kernel(
        masks.contiguous().numpy(),
        clip_from_world.float().contiguous().numpy(),
        axis,
        rejections,
        votes.numpy(),
    )
    return votes


def missed_shares(
    inside: Bool[Tensor, "n n n"],
    masks: Float[Tensor, "V H W"],
    clip_from_world: Float[Tensor, "V 4 4"],
    half_extent: float,
) -> Float[Tensor, "V"]:
    """Share of each view's silhouette that no node of a hull is seen at.

    Zero, but for discretisation, where all masks agree: then the hull fills every silhouette.
    Masks are averaged down until a pixel spans `NODES_PER_PIXEL` nodes, so that a solid hull leaves
    no gaps between its nodes.
    """
    points = node_positions(len(inside), half_extent, like=masks)[inside]
    # At the origin a unit of the world spans this many pixels.
    origin = clip_from_world[:, 3, 3]
    per_unit = 0.5 * masks.shape[1] * float((clip_from_world[:, 1, :3].norm(dim=1) / origin).max())
    spacing = 2.0 * half_extent / (len(inside) - 1)
    factor = max(1, math.ceil(NODES_PER_PIXEL * spacing * per_unit))
    height, width = (max(1, side // factor) for side in masks.shape[1:])
    small = torch.nn.functional.adaptive_avg_pool2d(masks[:, None], (height, width))[:, 0]
    shares = []
    for mask, matrix in zip(small, clip_from_world, strict=True):
        clip = points @ matrix[:, :3].T + matrix[:, 3]
        column = ((0.5 + 0.5 * clip[:, 0] / clip[:, 3]) * width).long()
        row = ((0.5 - 0.5 * clip[:, 1] / clip[:, 3]) * height).long()
        shown = (clip[:, 3] > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
        seen = torch.zeros(height, width, dtype=torch.bool, device=masks.device)
        seen[row[shown], column[shown]] = True
        covered = mask >= INSIDE_COVERAGE
        shares.append((covered & ~seen).sum() / covered.sum().clamp_min(1))
    return torch.stack(shares)
