"""Silhouettes that move: coverage as a differentiable function of vertex positions.

Where two neighbouring pixel centres see different surfaces, an edge of the nearer one passes
between them. The edge is found by walking over front-facing triangles from the near centre towards
the far one until the surface turns away; the colours of the pair are then blended by where the edge
crosses the segment. Unlike a test of the pixel's own triangle, the walk finds the edge also when
triangles are smaller than pixels.
"""

from dataclasses import dataclass

import numba
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray
from torch import Tensor

from svim3d.compiled import kernel
from svim3d.raster.zbuffer import BACKGROUND, Fragments

MAX_WALK_STEPS = 32  # triangles crossed within one pixel; a mesh that needs more is not resolved
MIN_EDGE_SQUARED_PX = 1e-12  # an edge seen end on has no direction; keeps its weight finite
NOWHERE = -1e30  # crossing of an edge that the walking line does not meet
HORIZONTAL, VERTICAL = 0, 1

FloatArray = NDArray[np.float32]
DoubleArray = NDArray[np.float64]
IntArray = NDArray[np.int32]
BoolArray = NDArray[np.bool_]


@dataclass(frozen=True)
class EdgePairs:
    """Neighbouring pixels with a silhouette edge between their centres.

    Attributes:
        near: flat index of the pixel that sees the edge's surface.
        far: flat index of its neighbour to the right, left, below or above.
        edge: the two vertices of the edge.
        axis: `HORIZONTAL` or `VERTICAL` neighbours.
    """

    near: Int[Tensor, "S"]
    far: Int[Tensor, "S"]
    edge: Int[Tensor, "S 2"]
    axis: Int[Tensor, "S"]

    @classmethod
    def from_rows(cls, rows: Int[Tensor, "S 5"]) -> "EdgePairs":
        """Unpack rows of near, far, vertex, vertex, axis."""
        wide = rows.long()
        return cls(near=wide[:, 0], far=wide[:, 1], edge=wide[:, 2:4], axis=wide[:, 4])


def antialias(
    image: Float[Tensor, "H W C"],
    clip: Float[Tensor, "N 4"],
    faces: Int[Tensor, "F 3"],
    fragments: Fragments,
    adjacency: Int[Tensor, "F 3"],
) -> Float[Tensor, "H W C"]:
    """Blend the pixels on either side of each silhouette by the area the edge leaves them.

    Differentiable in `image` and, through the edges' positions, in `clip`.

    Args:
        image: one value per pixel centre, premultiplied where it has coverage.
        clip: the vertices that were rasterised.
        faces: the faces that were rasterised.
        fragments: result of `rasterize`.
        adjacency: face across the edge opposite each corner, -1 at a boundary.
    """
    pairs = find_edge_pairs(clip, faces, fragments, adjacency)
    return blend_pairs(image, clip, pairs)


def blend_pairs(
    image: Float[Tensor, "H W C"], clip: Float[Tensor, "N 4"], pairs: EdgePairs
) -> Float[Tensor, "H W C"]:
    """Move colour across each edge that is not half way between its two pixel centres.

    The edge lies d in [0, 1] of the way from the near to the far centre. Beyond one half the near
    colour covers d - 1/2 of the far pixel, before it the far colour covers 1/2 - d of the near one.
    A pair along axis a counts by the square of the edge normal's component n_a: an edge of unit
    length crosses |n_a| such pairs, each crossing moves by 1/n_a per unit of normal motion, and
    n_x^2 + n_y^2 = 1, so horizontal and vertical pairs together give the exact area.
    """
    height, width, channels = image.shape
    if not len(pairs.near):
        return image
    ends = clip.index_select(0, pairs.edge.reshape(-1)).view(-1, 2, 4)
    scale = ends.new_tensor([0.5 * width, -0.5 * height])
    offset = ends.new_tensor([0.5 * width, 0.5 * height])
    screen = ends[..., :2] / ends[..., 3:] * scale + offset
    centre = torch.stack([pairs.near % width, pairs.near // width], 1).to(clip.dtype) + 0.5
    along, across = pairs.axis[:, None], 1 - pairs.axis[:, None]
    p = (screen - centre[:, None]).gather(2, along[:, None].expand(-1, 2, 1))[..., 0]
    q = (screen - centre[:, None]).gather(2, across[:, None].expand(-1, 2, 1))[..., 0]
    # Edges parallel to the pair's axis are never found, so the denominator is not zero.
    crossing = p[:, 0] + q[:, 0] / (q[:, 0] - q[:, 1]) * (p[:, 1] - p[:, 0])
    distance = crossing * torch.where(pairs.far > pairs.near, 1.0, -1.0)
    direction = (screen[:, 1] - screen[:, 0]).detach()
    squared = (direction * direction).sum(1).clamp_min(MIN_EDGE_SQUARED_PX)
    weight = direction.gather(1, across)[:, 0] ** 2 / squared
    moved = (weight * (distance - 0.5))[:, None]
    pixels = image.reshape(-1, channels)
    step = pixels.index_select(0, pairs.near) - pixels.index_select(0, pairs.far)
    pixels = pixels.index_add(0, pairs.far, moved.clamp_min(0.0) * step)
    pixels = pixels.index_add(0, pairs.near, moved.clamp_max(0.0) * step)
    return pixels.view(height, width, channels)


def find_edge_pairs(
    clip: Float[Tensor, "N 4"],
    faces: Int[Tensor, "F 3"],
    fragments: Fragments,
    adjacency: Int[Tensor, "F 3"],
) -> EdgePairs:
    """All pixel pairs with a silhouette edge between them, in the order of their pixels."""
    clip = clip.detach().contiguous()
    if clip.device.type != "cpu":
        return walk_edges(clip, faces, fragments, adjacency)
    rows = _find_pairs(
        fragments.triangle.numpy(),
        fragments.depth.numpy(),
        clip.numpy(),
        faces.int().contiguous().numpy(),
        adjacency.int().contiguous().numpy(),
    )
    return EdgePairs.from_rows(torch.from_numpy(rows))


@kernel(fastmath=False)
def _project(
    clip: FloatArray, faces: IntArray, height: int, width: int
) -> tuple[DoubleArray, BoolArray]:
    """Pixel positions of all vertices, NaN behind the camera; whether each face shows its front."""
    screen = np.empty((clip.shape[0], 2))
    for v in range(clip.shape[0]):
        w = np.float64(clip[v, 3])
        if w > 0.0:
            screen[v, 0] = (0.5 + 0.5 * clip[v, 0] / w) * width
            screen[v, 1] = (0.5 - 0.5 * clip[v, 1] / w) * height
        else:
            screen[v, 0] = screen[v, 1] = np.nan
    front = np.empty(faces.shape[0], np.bool_)
    for f in range(faces.shape[0]):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        ax, ay, aw = np.float64(clip[a, 0]), np.float64(clip[a, 1]), np.float64(clip[a, 3])
        bx, by, bw = np.float64(clip[b, 0]), np.float64(clip[b, 1]), np.float64(clip[b, 3])
        cx, cy, cw = np.float64(clip[c, 0]), np.float64(clip[c, 1]), np.float64(clip[c, 3])
        front[f] = (
            ax * (by * cw - bw * cy) + ay * (bw * cx - bx * cw) + aw * (bx * cy - by * cx)
        ) > 0.0
    return screen, front


@kernel(fastmath=False)
def _walk(
    start: int,
    x: float,
    y: float,
    axis: int,
    sign: float,
    screen: DoubleArray,
    front: BoolArray,
    faces: IntArray,
    adjacency: IntArray,
) -> tuple[int, int, int]:
    """Walk at most one pixel from (x, y) along an axis, over faces that face as the first does.

    Returns the last face and the two vertices of the edge where the surface turned away, or -1.
    """
    face = start
    origin_along, origin_across = (x, y) if axis == 0 else (y, x)
    for _ in range(MAX_WALK_STEPS):
        best, side = NOWHERE, -1
        for k in range(3):
            a, b = faces[face, (k + 1) % 3], faces[face, (k + 2) % 3]
            qa = screen[a, 1 - axis] - origin_across
            qb = screen[b, 1 - axis] - origin_across
            if (qa > 0.0) != (qb > 0.0):
                pa = (screen[a, axis] - origin_along) * sign
                pb = (screen[b, axis] - origin_along) * sign
                crossing = pa + qa / (qa - qb) * (pb - pa)
                if crossing > best:
                    best, side = crossing, k
        if side < 0 or best > 1.0:
            return face, -1, -1
        beyond = adjacency[face, side]
        if beyond < 0 or front[beyond] != front[start]:
            if best < 0.0:
                return face, -1, -1
            return face, faces[face, (side + 1) % 3], faces[face, (side + 2) % 3]
        face = beyond
    return face, -1, -1


@kernel(parallel=True, fastmath=False)
def _find_pairs(
    triangle: IntArray, depth: FloatArray, clip: FloatArray, faces: IntArray, adjacency: IntArray
) -> IntArray:
    """Rows of near, far, vertex, vertex, axis."""
    height, width = triangle.shape
    screen, front = _project(clip, faces, height, width)
    found = np.empty((height, 2 * width, 5), np.int32)
    counts = np.zeros(height, np.int64)
    for row in numba.prange(height):
        for column in range(width):
            here = triangle[row, column]
            for axis in range(2):
                r, c = row + axis, column + 1 - axis
                if r >= height or c >= width or triangle[r, c] == here:
                    continue
                there = triangle[r, c]
                both = here >= 0 and there >= 0
                if both and (
                    adjacency[here, 0] == there
                    or adjacency[here, 1] == there
                    or adjacency[here, 2] == there
                ):
                    continue
                near_first = depth[row, column] < depth[r, c] if both else here >= 0
                # The nearer centre may lie on the farther surface: then the other one walks.
                for _ in range(2 if both else 1):
                    if near_first:
                        start, goal, x, y, sign = here, there, column + 0.5, row + 0.5, 1.0
                    else:
                        start, goal, x, y, sign = there, here, c + 0.5, r + 0.5, -1.0
                    last, a, b = _walk(start, x, y, axis, sign, screen, front, faces, adjacency)
                    if last == goal:
                        break
                    if a >= 0:
                        n = counts[row]
                        first, second = row * width + column, r * width + c
                        found[row, n, 0] = first if near_first else second
                        found[row, n, 1] = second if near_first else first
                        found[row, n, 2] = a
                        found[row, n, 3] = b
                        found[row, n, 4] = axis
                        counts[row] = n + 1
                        break
                    near_first = not near_first
    rows = np.empty((counts.sum(), 5), np.int32)
    n = 0
    for row in range(height):
        rows[n : n + counts[row]] = found[row, : counts[row]]
        n += counts[row]
    return rows


def walk_edges(
    clip: Float[Tensor, "N 4"],
    faces: Int[Tensor, "F 3"],
    fragments: Fragments,
    adjacency: Int[Tensor, "F 3"],
) -> EdgePairs:
    """`find_edge_pairs` in plain torch, for any device; the same pairs in the same order."""
    surface = _Surface.project(clip, faces, adjacency, tuple(fragments.triangle.shape))
    height, width = fragments.triangle.shape
    triangle, depth = fragments.triangle.reshape(-1).long(), fragments.depth.reshape(-1)
    pixels = torch.arange(height * width, device=clip.device).view(height, width)
    rows = []
    for axis in (HORIZONTAL, VERTICAL):
        first = (pixels[:, :-1] if axis == HORIZONTAL else pixels[:-1]).reshape(-1)
        second = first + (1 if axis == HORIZONTAL else width)
        here, there = triangle[first], triangle[second]
        both = (here != BACKGROUND) & (there != BACKGROUND)
        touching = both & (surface.adjacency[here.clamp_min(0)] == there[:, None]).any(1)
        candidates = (here != there) & ~touching
        first, second, both = first[candidates], second[candidates], both[candidates]
        here, there = triangle[first], triangle[second]
        near_first = torch.where(both, depth[first] < depth[second], here != BACKGROUND)
        for _ in range(2):
            near = torch.where(near_first, first, second)
            far = torch.where(near_first, second, first)
            last, edge = surface.walk(
                triangle[near], near, axis, torch.where(near_first, 1.0, -1.0)
            )
            reached = last == triangle[far]
            hit = ~reached & (edge[:, 0] >= 0)
            axes = torch.full_like(near, axis)
            rows.append(torch.stack([near, far, edge[:, 0], edge[:, 1], axes], 1)[hit])
            again = both & ~hit & ~reached
            first, second, both = first[again], second[again], both[again]
            near_first = ~near_first[again]
    pairs = torch.cat(rows)
    order = torch.argsort(2 * torch.minimum(pairs[:, 0], pairs[:, 1]) + pairs[:, 4], stable=True)
    return EdgePairs.from_rows(pairs[order])


@dataclass(frozen=True)
class _Surface:
    """A projected mesh on which many walks run at once."""

    screen: Float[Tensor, "N 2"]
    front: Bool[Tensor, "F"]
    faces: Int[Tensor, "F 3"]
    adjacency: Int[Tensor, "F 3"]
    width: int

    @classmethod
    def project(
        cls,
        clip: Float[Tensor, "N 4"],
        faces: Int[Tensor, "F 3"],
        adjacency: Int[Tensor, "F 3"],
        image_size: tuple[int, ...],
    ) -> "_Surface":
        """As the kernel `_project`."""
        height, width = image_size
        points, faces = clip.detach().double(), faces.long()
        x = (0.5 + 0.5 * points[:, 0] / points[:, 3]) * width
        y = (0.5 - 0.5 * points[:, 1] / points[:, 3]) * height
        visible = (points[:, 3] > 0.0)[:, None]
        screen = torch.where(visible, torch.stack([x, y], 1), torch.nan)
        a, b, c = points[:, [0, 1, 3]][faces].unbind(1)
        front = (a * torch.linalg.cross(b, c)).sum(-1) > 0.0
        return cls(screen, front, faces, adjacency.long(), width)

    def walk(
        self, start: Int[Tensor, "S"], pixel: Int[Tensor, "S"], axis: int, sign: Float[Tensor, "S"]
    ) -> tuple[Int[Tensor, "S"], Int[Tensor, "S 2"]]:
        """As the kernel `_walk`, all walks in step."""
        centre = torch.stack([pixel % self.width, pixel // self.width], 1).double() + 0.5
        face, edge = start.clone(), start.new_full((len(start), 2), -1)
        live = torch.arange(len(start), device=start.device)
        for _ in range(MAX_WALK_STEPS):
            if not len(live):
                break
            corners = self.faces[face[live]]
            offset = self.screen[corners] - centre[live, None]
            p, q = offset[..., axis] * sign[live, None], offset[..., 1 - axis]
            pa, pb, qa, qb = p.roll(-1, 1), p.roll(-2, 1), q.roll(-1, 1), q.roll(-2, 1)
            meets = (qa > 0.0) != (qb > 0.0)
            crossing = torch.where(meets, pa + qa / (qa - qb) * (pb - pa), NOWHERE)
            best, side = crossing.nan_to_num(NOWHERE).max(1)
            beyond = self.adjacency[face[live]].gather(1, side[:, None])[:, 0]
            inside = (best > NOWHERE) & (best <= 1.0)
            turns = (beyond < 0) | (self.front[beyond.clamp_min(0)] != self.front[start[live]])
            ends = inside & turns & (best >= 0.0)
            ahead = torch.stack([(side + 1) % 3, (side + 2) % 3], 1)
            edge[live[ends]] = corners.gather(1, ahead)[ends]
            onward = inside & ~turns
            face[live[onward]] = beyond[onward]
            live = live[onward]
        return face, edge
