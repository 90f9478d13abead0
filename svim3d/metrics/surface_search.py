"""Points on a surface, and exact distances from points to triangles.

There is no sampling floor on the side that is measured against.
"""

import math
from dataclasses import dataclass

import numba
import numpy as np
import torch
from jaxtyping import Float, Int
from numpy.typing import NDArray
from torch import Tensor

from svim3d.compiled import kernel

LEAF_FACES = 4  # triangles per leaf of the search tree
MORTON_BITS = 20  # per axis; three axes fit a 63-bit key
MAX_TREE_DEPTH = 64  # entries of the search stack: twice the depth of a tree over 2^30 leaves

Vector = tuple[float, float, float]


def sample_surface(
    vertices: Float[Tensor, "N 3"],
    faces: Int[Tensor, "F 3"],
    count: int,
    generator: torch.Generator,
) -> Float[Tensor, "count 3"]:
    """Points spread uniformly by area over a mesh."""
    return sample_faces(vertices, faces, count, generator)[0]


def sample_faces(
    vertices: Float[Tensor, "N 3"],
    faces: Int[Tensor, "F 3"],
    count: int,
    generator: torch.Generator,
) -> tuple[Float[Tensor, "count 3"], Int[Tensor, "count"]]:
    """As `sample_surface`, and the face that each point lies on."""
    corners = vertices.double()[faces.long()]
    edge_a, edge_b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = torch.linalg.vector_norm(torch.linalg.cross(edge_a, edge_b), dim=-1)
    face = torch.multinomial(area, count, replacement=True, generator=generator)
    u, v = torch.rand(2, count, 1, generator=generator, dtype=torch.float64)
    # Points of the parallelogram's far half are folded back into the triangle.
    u, v = torch.where(u + v > 1, 1 - u, u), torch.where(u + v > 1, 1 - v, v)
    return (corners[face, 0] + u * edge_a[face] + v * edge_b[face]).to(vertices.dtype), face


def distance_to_surface(
    points: Float[Tensor, "P 3"], vertices: Float[Tensor, "N 3"], faces: Int[Tensor, "F 3"]
) -> Float[Tensor, "P"]:
    """Exact distance from each point to its nearest triangle."""
    return nearest_face(points, vertices, faces)[0]


def nearest_face(
    points: Float[Tensor, "P 3"], vertices: Float[Tensor, "N 3"], faces: Int[Tensor, "F 3"]
) -> tuple[Float[Tensor, "P"], Int[Tensor, "P"]]:
    """As `distance_to_surface`, and which triangle that is; of several one."""
    corners = vertices.detach().cpu().double()[faces.cpu().long()].numpy()
    tree = _SearchTree.build(corners)
    queries = np.ascontiguousarray(points.detach().cpu().double().numpy())
    squared, nearest = np.empty(len(queries)), np.empty(len(queries), np.int64)
    _search(queries, tree.corners, tree.low, tree.high, tree.first_leaf, squared, nearest)
    distance = torch.from_numpy(np.sqrt(squared)).to(points)
    return distance, torch.from_numpy(tree.faces[nearest]).to(points.device)


@dataclass(frozen=True)
class _SearchTree:
    """A complete binary tree of boxes over triangles in Morton order.

    Node i has children 2i + 1 and 2i + 2; leaf j = node first_leaf + j holds the triangles
    [LEAF_FACES * j, LEAF_FACES * (j + 1)). The last triangle is repeated to fill the tree; `faces`
    says which one of the mesh each is.
    """

    corners: NDArray[np.float64]
    faces: NDArray[np.int64]
    low: NDArray[np.float64]
    high: NDArray[np.float64]
    first_leaf: int

    @classmethod
    def build(cls, corners: NDArray[np.float64]) -> "_SearchTree":
        order = np.argsort(_morton_keys(corners.mean(1)), kind="stable")
        leaves = 1 << max(0, math.ceil(math.log2(max(1, len(corners) / LEAF_FACES))))
        filled = np.pad(order, (0, leaves * LEAF_FACES - len(order)), mode="edge")
        padded = corners[filled]
        blocks = padded.reshape(leaves, LEAF_FACES * 3, 3)
        low, high = [blocks.min(1)], [blocks.max(1)]
        while len(low[0]) > 1:
            low.insert(0, np.minimum(low[0][0::2], low[0][1::2]))
            high.insert(0, np.maximum(high[0][0::2], high[0][1::2]))
        return cls(padded, filled, np.concatenate(low), np.concatenate(high), leaves - 1)


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
def _search(
    points: NDArray[np.float64],
    corners: NDArray[np.float64],
    low: NDArray[np.float64],
    high: NDArray[np.float64],
    first_leaf: int,
    squared: NDArray[np.float64],
    nearest: NDArray[np.int64],
) -> None:
    """Depth-first search of the box tree, nearer child first."""
    for i in numba.prange(len(points)):
        stack = np.empty(MAX_TREE_DEPTH, np.int64)
        stack[0], top, best, found = 0, 1, np.inf, 0
        while top > 0:
            top -= 1
            node = stack[top]
            if _box_squared(points[i], low[node], high[node]) >= best:
                continue
            if node >= first_leaf:
                start = (node - first_leaf) * LEAF_FACES
                for face in range(start, start + LEAF_FACES):
                    here = _triangle_squared(points[i], corners[face])
                    if here < best:
                        best, found = here, face
            else:
                near, far = 2 * node + 1, 2 * node + 2
                if _box_squared(points[i], low[far], high[far]) < _box_squared(
                    points[i], low[near], high[near]
                ):
                    near, far = far, near
                stack[top], stack[top + 1] = far, near
                top += 2
        squared[i], nearest[i] = best, found
