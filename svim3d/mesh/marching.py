"""Marching tetrahedra: the zero set of a signed distance as a closed triangle mesh.

An edge whose ends differ in sign carries one vertex, at the zero of the linear interpolant. A
tetrahedron with one or three nodes inside adds a triangle, with two inside a quadrilateral.
Source: Doi and Koide 1991; made differentiable in SDF and node positions by Shen et al. 2021.
"""

from typing import Any

import numba
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd.function import once_differentiable

from svim3d.compiled import kernel
from svim3d.mesh.tetrahedra import (
    TetrahedralLattice,
    cell_centres,
    close_border,
    lattice_around_surface,
    node_values,
)

# Edges of the cut, in the order of `EDGE_ENDS`, for each set of inside nodes (bit k = node k);
# triangles wind outward, -1 ends the list.
TRIANGLES = np.array(
    [
        [-1, -1, -1, -1, -1, -1],
        [1, 2, 0, -1, -1, -1],
        [4, 3, 0, -1, -1, -1],
        [1, 2, 4, 1, 4, 3],
        [3, 5, 1, -1, -1, -1],
        [2, 0, 3, 2, 3, 5],
        [1, 0, 4, 1, 4, 5],
        [4, 5, 2, -1, -1, -1],
        [4, 2, 5, -1, -1, -1],
        [4, 0, 1, 4, 1, 5],
        [3, 0, 2, 3, 2, 5],
        [1, 5, 3, -1, -1, -1],
        [4, 2, 1, 4, 1, 3],
        [3, 4, 0, -1, -1, -1],
        [2, 1, 0, -1, -1, -1],
        [-1, -1, -1, -1, -1, -1],
    ],
    dtype=np.int8,
)
TRIANGLE_COUNT = (TRIANGLES >= 0).sum(1) // 3
MIN_DIFFERENCE = 1e-6  # SDF difference along a crossed edge; bounds the gradient of its crossing

Array = NDArray[np.floating[Any]]
IntArray = NDArray[np.int32]
BoolArray = NDArray[np.bool_]


def extract_surface(
    sdf: Float[Tensor, "n n n"], half_extent: float
) -> tuple[Float[Tensor, "N 3"], Int[Tensor, "F 3"]]:
    """Closed surface of a grid over [-half_extent, half_extent]^3, wound outward.

    Where the object touches the border of the cube it is closed within a cell of it.

    Args:
        sdf: values at the nodes, index order x, y, z; positive inside.
        half_extent: half the side of the cube, world units.

    Returns:
        Vertices and faces (int32); both empty where the grid has no sign change.
    """
    spacing = 2.0 * half_extent / (sdf.shape[0] - 1)
    padded = torch.nn.functional.pad(sdf.detach(), (1,) * 6, value=-spacing)
    corners, centres = close_border(padded, cell_centres(padded), spacing)
    lattice = lattice_around_surface(corners, centres, half_extent + spacing)
    values = node_values(lattice, corners, centres)
    edges, faces = find_crossings(values > 0.0, lattice)
    return crossing_points(lattice.nodes, values, edges), faces


def crossing_points(
    nodes: Float[Tensor, "N 3"], sdf: Float[Tensor, "N"], edges: Int[Tensor, "V 2"]
) -> Float[Tensor, "V 3"]:
    """Where the linear interpolant of `sdf` is zero on each edge; differentiable in nodes and sdf.

    p = a + s_a / (s_a - s_b) (b - a) for ends a, b of different sign.
    """
    if sdf.device.type != "cpu":
        return crossing_points_reference(nodes, sdf, edges)
    points: Tensor = _Crossing.apply(  # type: ignore[no-untyped-call]
        nodes, sdf, edges.int().contiguous()
    )
    return points


def crossing_points_reference(
    nodes: Float[Tensor, "N 3"], sdf: Float[Tensor, "N"], edges: Int[Tensor, "V 2"]
) -> Float[Tensor, "V 3"]:
    """`crossing_points` in plain torch, for any device."""
    flat = edges.reshape(-1).long()
    ends = nodes.index_select(0, flat).view(-1, 2, 3)
    values = sdf.index_select(0, flat).view(-1, 2)
    difference = values[:, 0] - values[:, 1]
    # The two values differ in sign, so that only their distance from zero needs a bound.
    guarded = torch.where(difference < 0.0, -1.0, 1.0) * difference.abs().clamp_min(MIN_DIFFERENCE)
    return torch.lerp(ends[:, 0], ends[:, 1], (values[:, 0] / guarded)[:, None])


@kernel()
def _guarded(difference: Any) -> Any:
    """A difference of signed distances, no nearer to zero than `MIN_DIFFERENCE`."""
    if difference < 0.0:
        return min(difference, -MIN_DIFFERENCE)
    return max(difference, MIN_DIFFERENCE)


@kernel(parallel=True)
def _cross(nodes: Array, sdf: Array, edges: IntArray, points: Array) -> None:
    """The point on each edge."""
    for e in numba.prange(edges.shape[0]):
        a, b = edges[e, 0], edges[e, 1]
        t = sdf[a] / _guarded(sdf[a] - sdf[b])
        for axis in range(3):
            # From the nearer end, as torch.lerp does: a zero at b gives exactly b.
            way = nodes[b, axis] - nodes[a, axis]
            near_a = t < 0.5
            points[e, axis] = nodes[a, axis] + t * way if near_a else nodes[b, axis] - (1 - t) * way


@kernel()
def _cross_backward(
    nodes: Array,
    sdf: Array,
    edges: IntArray,
    grad_points: Array,
    grad_nodes: Array,
    grad_sdf: Array,
) -> None:
    """Scatter to the ends; serial, because edges share them."""
    for e in range(edges.shape[0]):
        a, b = edges[e, 0], edges[e, 1]
        difference = sdf[a] - sdf[b]
        guarded = _guarded(difference)
        t = sdf[a] / guarded
        grad_t = 0.0
        for axis in range(3):
            grad = grad_points[e, axis]
            grad_nodes[a, axis] += (1.0 - t) * grad
            grad_nodes[b, axis] += t * grad
            grad_t += grad * (nodes[b, axis] - nodes[a, axis])
        moves = t if guarded == difference else 0.0  # of the denominator, which may be held
        grad_sdf[a] += grad_t * (1.0 - moves) / guarded
        grad_sdf[b] += grad_t * moves / guarded


class _Crossing(torch.autograd.Function):
    """The kernels as one differentiable operator."""

    @staticmethod
    def forward(ctx: Any, nodes: Tensor, sdf: Tensor, edges: Tensor) -> Tensor:
        """Points on the edges."""
        nodes, sdf = nodes.detach().contiguous(), sdf.detach().contiguous()
        points = nodes.new_empty(len(edges), 3)
        _cross(nodes.numpy(), sdf.numpy(), edges.numpy(), points.numpy())
        ctx.save_for_backward(nodes, sdf, edges)
        return points

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_points: Tensor) -> tuple[Tensor, Tensor, None]:
        """Gradients of node positions and values."""
        nodes, sdf, edges = ctx.saved_tensors
        grad_nodes, grad_sdf = torch.zeros_like(nodes), torch.zeros_like(sdf)
        _cross_backward(
            nodes.numpy(),
            sdf.numpy(),
            edges.numpy(),
            grad_points.contiguous().numpy(),
            grad_nodes.numpy(),
            grad_sdf.numpy(),
        )
        return grad_nodes, grad_sdf, None


def find_crossings(
    inside: Bool[Tensor, "N"], lattice: TetrahedralLattice
) -> tuple[Int[Tensor, "V 2"], Int[Tensor, "F 3"]]:
    """Edges that carry a vertex, in lattice order, and the faces between those vertices.

    Args:
        inside: sign of each node.
        lattice: tetrahedra and their edges.
    """
    if inside.device.type != "cpu":
        return find_crossings_reference(inside, lattice)
    crossed, faces = _march(
        inside.numpy(),
        lattice.edges.numpy(),
        lattice.tetrahedra.numpy(),
        lattice.tetrahedron_edges.numpy(),
    )
    return lattice.edges[torch.from_numpy(crossed)], torch.from_numpy(faces)


def find_crossings_reference(
    inside: Bool[Tensor, "N"], lattice: TetrahedralLattice
) -> tuple[Int[Tensor, "V 2"], Int[Tensor, "F 3"]]:
    """`find_crossings` in plain torch, for any device; the same result."""
    device = inside.device
    bits = torch.tensor([1, 2, 4, 8], device=device)
    case = (inside[lattice.tetrahedra.long()] * bits).sum(1)
    cut = torch.nonzero((case > 0) & (case < 15))[:, 0]
    local = torch.from_numpy(TRIANGLES).to(device).long()[case[cut]]
    crossed = inside[lattice.edges[:, 0].long()] != inside[lattice.edges[:, 1].long()]
    rank = torch.cumsum(crossed, 0) - 1
    corners = rank[lattice.tetrahedron_edges[cut].long()].gather(1, local.clamp_min(0))
    faces = corners.view(-1, 3)[(local >= 0).view(-1, 3)[:, 0]]
    return lattice.edges[crossed], faces.int()


@kernel(parallel=True)
def _march(
    inside: BoolArray, edges: IntArray, tetrahedra: IntArray, tetrahedron_edges: IntArray
) -> tuple[BoolArray, IntArray]:
    """Which edges are crossed, and the faces by rank of their crossed edges."""
    crossed = np.empty(edges.shape[0], np.bool_)
    for e in numba.prange(edges.shape[0]):
        crossed[e] = inside[edges[e, 0]] != inside[edges[e, 1]]
    case = np.empty(tetrahedra.shape[0], np.uint8)
    for t in numba.prange(tetrahedra.shape[0]):
        case[t] = (
            inside[tetrahedra[t, 0]]
            + 2 * inside[tetrahedra[t, 1]]
            + 4 * inside[tetrahedra[t, 2]]
            + 8 * inside[tetrahedra[t, 3]]
        )
    rank = np.empty(edges.shape[0], np.int32)
    vertices = 0
    for e in range(edges.shape[0]):
        rank[e] = vertices
        vertices += crossed[e]
    total = 0
    for t in range(tetrahedra.shape[0]):
        total += TRIANGLE_COUNT[case[t]]
    faces = np.empty((total, 3), np.int32)
    f = 0
    for t in range(tetrahedra.shape[0]):
        for triangle in range(TRIANGLE_COUNT[case[t]]):
            for corner in range(3):
                side = TRIANGLES[case[t], 3 * triangle + corner]
                faces[f, corner] = rank[tetrahedron_edges[t, side]]
            f += 1
    return crossed, faces
