"""Figures of merit of pictures and surfaces.

Pictures: PSNR and mean angle inside a mask, structural similarity. Surfaces: exact distances from
points to triangles (no sampling floor on the side measured against) and the overlap of enclosed
volumes.
"""

import math
from dataclasses import dataclass

import numba
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from svim3d.compiled import kernel
from svim3d.numerics import dot, normalize

LEAF_FACES = 4  # triangles per leaf of the search tree
MORTON_BITS = 20  # per axis; three axes fit a 63-bit key
MAX_TREE_DEPTH = 64  # entries of the search stack: twice the depth of a tree over 2^30 leaves
# Sample points stand off the cell centres by this share of a cell, so that columns never run
# along edges and faces of meshes that were cut from the same lattice.
OFF_LATTICE = math.pi * 1e-4

# Source: Wang et al. 2004, "Image Quality Assessment", section III.C.
SSIM_RADIUS_PX, SSIM_SPREAD_PX = 5, 1.5
SSIM_C1, SSIM_C2 = 0.01**2, 0.03**2

Vector = tuple[float, float, float]


def psnr(
    image: Float[Tensor, "*batch C"],
    truth: Float[Tensor, "*batch C"],
    mask: Bool[Tensor, "*batch 1"],
) -> float:
    """Peak signal-to-noise ratio in dB inside a mask; both images are encoded for display, peak 1.

    Equal images give infinity. The mean runs over masked pixels only: over a whole picture with
    an equal background the figure would be higher by 10 log10(1 / share of the mask).
    """
    squared = (image - truth).square()[mask.expand_as(image)]
    return float(-10.0 * squared.double().mean().log10())


def mean_angle_deg(
    a: Float[Tensor, "*batch 3"], b: Float[Tensor, "*batch 3"], mask: Bool[Tensor, "*batch 1"]
) -> float:
    """Mean angle between two direction fields inside a mask; need not be unit.

    A zero vector (a pixel that one side does not cover) counts as 90 degrees.
    """
    a, b = normalize(a.double()), normalize(b.double())
    # atan2 keeps small angles exact where acos loses half of the digits.
    angle = torch.atan2(
        torch.linalg.vector_norm(torch.linalg.cross(a, b), dim=-1), dot(a, b)[..., 0]
    )
    blank = (a.square().sum(-1) < 0.5) | (b.square().sum(-1) < 0.5)
    angle = torch.where(blank, math.pi / 2, angle)
    return math.degrees(float(angle[mask[..., 0]].mean()))


def structural_similarity(
    image: Float[Tensor, "V H W C"], truth: Float[Tensor, "V H W C"]
) -> Float[Tensor, "V H W 1"]:
    """SSIM at every pixel, averaged over channels; display-encoded pictures, peak 1.

    The Gaussian window has 11 pixels; beyond the border a picture goes on as its last row.

    Source: Wang et al. 2004, eq. 13.
    """
    mean_a, mean_b = _gaussian_mean(image), _gaussian_mean(truth)
    variance_a = _gaussian_mean(image.square()) - mean_a.square()
    variance_b = _gaussian_mean(truth.square()) - mean_b.square()
    covariance = _gaussian_mean(image * truth) - mean_a * mean_b
    level = (2 * mean_a * mean_b + SSIM_C1) / (mean_a.square() + mean_b.square() + SSIM_C1)
    structure = (2 * covariance + SSIM_C2) / (variance_a + variance_b + SSIM_C2)
    return (level * structure).mean(-1, keepdim=True)


def _gaussian_mean(pictures: Float[Tensor, "V H W C"]) -> Float[Tensor, "V H W C"]:
    """Mean over SSIM's window, one axis after the other."""
    offset = torch.arange(-SSIM_RADIUS_PX, SSIM_RADIUS_PX + 1).to(pictures)
    window = (-0.5 * (offset / SSIM_SPREAD_PX) ** 2).exp()
    window = window / window.sum()
    planes = pictures.movedim(-1, 1).flatten(0, 1)[:, None]
    padded = functional.pad(planes, [SSIM_RADIUS_PX] * 4, mode="replicate")
    rows = functional.conv2d(padded, window.view(1, 1, -1, 1))
    mean = functional.conv2d(rows, window.view(1, 1, 1, -1))
    views, channels = len(pictures), pictures.shape[-1]
    return mean.view(views, channels, *mean.shape[2:]).movedim(1, -1)


def sample_surface(
    vertices: Float[Tensor, "N 3"],
    faces: Int[Tensor, "F 3"],
    count: int,
    generator: torch.Generator,
) -> Float[Tensor, "count 3"]:
    """Points spread uniformly by area over a mesh."""
    corners = vertices.double()[faces.long()]
    edge_a, edge_b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = torch.linalg.vector_norm(torch.linalg.cross(edge_a, edge_b), dim=-1)
    face = torch.multinomial(area, count, replacement=True, generator=generator)
    u, v = torch.rand(2, count, 1, generator=generator, dtype=torch.float64)
    # Points of the parallelogram's far half are folded back into the triangle.
    u, v = torch.where(u + v > 1, 1 - u, u), torch.where(u + v > 1, 1 - v, v)
    return (corners[face, 0] + u * edge_a[face] + v * edge_b[face]).to(vertices.dtype)


def distance_to_surface(
    points: Float[Tensor, "P 3"], vertices: Float[Tensor, "N 3"], faces: Int[Tensor, "F 3"]
) -> Float[Tensor, "P"]:
    """Exact distance from each point to its nearest triangle."""
    corners = vertices.detach().cpu().double()[faces.cpu().long()].numpy()
    tree = _SearchTree.build(corners)
    queries = np.ascontiguousarray(points.detach().cpu().double().numpy())
    squared = np.empty(len(queries))
    _nearest_squared(queries, tree.corners, tree.low, tree.high, tree.first_leaf, squared)
    return torch.from_numpy(np.sqrt(squared)).to(points)


@dataclass(frozen=True)
class _SearchTree:
    """A complete binary tree of boxes over triangles in Morton order.

    Node i has children 2i + 1 and 2i + 2; leaf j = node first_leaf + j holds the triangles
    [LEAF_FACES * j, LEAF_FACES * (j + 1)). The last triangle is repeated to fill the tree.
    """

    corners: NDArray[np.float64]
    low: NDArray[np.float64]
    high: NDArray[np.float64]
    first_leaf: int

    @classmethod
    def build(cls, corners: NDArray[np.float64]) -> "_SearchTree":
        order = np.argsort(_morton_keys(corners.mean(1)), kind="stable")
        leaves = 1 << max(0, math.ceil(math.log2(max(1, len(corners) / LEAF_FACES))))
        padded = corners[np.pad(order, (0, leaves * LEAF_FACES - len(order)), mode="edge")]
        blocks = padded.reshape(leaves, LEAF_FACES * 3, 3)
        low, high = [blocks.min(1)], [blocks.max(1)]
        while len(low[0]) > 1:
            low.insert(0, np.minimum(low[0][0::2], low[0][1::2]))
            high.insert(0, np.maximum(high[0][0::2], high[0][1::2]))
        return cls(padded, np.concatenate(low), np.concatenate(high), leaves - 1)


def _morton_keys(points: NDArray[np.float64]) -> NDArray[np.int64]:
    """Interleaved bits of quantised coordinates: neighbours in space stay close in order."""
    low, extent = points.min(0), np.ptp(points, axis=0).max()
    scale = (2**MORTON_BITS - 1) / extent if extent > 0 else 0.0
    cells = ((points - low) * scale).astype(np.int64)
    keys = np.zeros(len(points), np.int64)
    for bit in range(MORTON_BITS):
        for axis in range(3):
            keys |= ((cells[:, axis] >> bit) & 1) << (3 * bit + axis)
    return keys


@kernel(fastmath=False)
def _box_squared(
    point: NDArray[np.float64], low: NDArray[np.float64], high: NDArray[np.float64]
) -> float:
    """Squared distance from a point to a box, zero inside."""
    total = 0.0
    for axis in range(3):
        gap = max(low[axis] - point[axis], 0.0, point[axis] - high[axis])
        total += gap * gap
    return total


@kernel(fastmath=False)
def _vector(a: NDArray[np.float64], b: NDArray[np.float64]) -> Vector:
    """From a to b, as scalars: small arrays would be allocated on the heap."""
    return b[0] - a[0], b[1] - a[1], b[2] - a[2]


@kernel(fastmath=False)
def _inner(a: Vector, b: Vector) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@kernel(fastmath=False)
def _segment_squared(offset: Vector, edge: Vector) -> float:
    """Squared distance from a point, given relative to the start of a segment."""
    squared = _inner(edge, edge)
    along = _inner(offset, edge) / squared if squared > 0.0 else 0.0
    along = min(max(along, 0.0), 1.0)
    x, y, z = offset[0] - edge[0] * along, offset[1] - edge[1] * along, offset[2] - edge[2] * along
    return x * x + y * y + z * z


@kernel(fastmath=False)
def _triangle_squared(p: NDArray[np.float64], corners: NDArray[np.float64]) -> float:
    """Squared distance from a point to a triangle: to its plane or to its nearest edge.

    Source: Ericson, Real-Time Collision Detection (2005), section 5.1.5 (region tests). A
    degenerate triangle falls through to its edges, a degenerate edge to its end point.
    """
    ab, ac = _vector(corners[0], corners[1]), _vector(corners[0], corners[2])
    bc = _vector(corners[1], corners[2])
    ap, bp, cp = _vector(corners[0], p), _vector(corners[1], p), _vector(corners[2], p)
    d1, d2 = _inner(ab, ap), _inner(ac, ap)
    d3, d4 = _inner(ab, bp), _inner(ac, bp)
    d5, d6 = _inner(ab, cp), _inner(ac, cp)
    va, vb, vc = d3 * d6 - d5 * d4, d5 * d2 - d1 * d6, d1 * d4 - d3 * d2
    if va > 0.0 and vb > 0.0 and vc > 0.0:
        # The projection falls inside: what is left is the height over the plane.
        v, w = vb / (va + vb + vc), vc / (va + vb + vc)
        x = ap[0] - ab[0] * v - ac[0] * w
        y = ap[1] - ab[1] * v - ac[1] * w
        z = ap[2] - ab[2] * v - ac[2] * w
        return x * x + y * y + z * z
    return min(_segment_squared(ap, ab), _segment_squared(ap, ac), _segment_squared(bp, bc))


@kernel(parallel=True, fastmath=False)
def _nearest_squared(
    points: NDArray[np.float64],
    corners: NDArray[np.float64],
    low: NDArray[np.float64],
    high: NDArray[np.float64],
    first_leaf: int,
    squared: NDArray[np.float64],
) -> None:
    """Depth-first search of the box tree, nearer child first."""
    for i in numba.prange(len(points)):
        stack = np.empty(MAX_TREE_DEPTH, np.int64)
        stack[0], top, best = 0, 1, np.inf
        while top > 0:
            top -= 1
            node = stack[top]
            if _box_squared(points[i], low[node], high[node]) >= best:
                continue
            if node >= first_leaf:
                start = (node - first_leaf) * LEAF_FACES
                for face in range(start, start + LEAF_FACES):
                    best = min(best, _triangle_squared(points[i], corners[face]))
            else:
                near, far = 2 * node + 1, 2 * node + 2
                if _box_squared(points[i], low[far], high[far]) < _box_squared(
                    points[i], low[near], high[near]
                ):
                    near, far = far, near
                stack[top], stack[top + 1] = far, near
                top += 2
        squared[i] = best


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
