"""Triangle meshes as tensors: adjacency, normals, areas."""

from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd.function import once_differentiable

from svim3d.compiled import kernel
from svim3d.numerics import MIN_NORM_SQUARED, dot, length, normalize

Array = NDArray[np.floating[Any]]
IntArray = NDArray[np.int32]


def face_normals_scaled(
    vertices: Float[Tensor, "N 3"], faces: Int[Tensor, "F 3"]
) -> Float[Tensor, "F 3"]:
    """Face normals whose length is twice the face's area; outward for outward winding."""
    corners = vertices.index_select(0, faces.reshape(-1).long()).view(-1, 3, 3)
    edge_a = corners[:, 1] - corners[:, 0]
    edge_b = corners[:, 2] - corners[:, 0]
    return torch.linalg.cross(edge_a, edge_b)


def vertex_normals(
    vertices: Float[Tensor, "N 3"], faces: Int[Tensor, "F 3"]
) -> Float[Tensor, "N 3"]:
    """Unit vertex normals, area weighted. Differentiable in `vertices`."""
    if vertices.device.type != "cpu":
        return vertex_normals_reference(vertices, faces)
    normals: Tensor = _VertexNormals.apply(  # type: ignore[no-untyped-call]
        vertices, faces.int().contiguous()
    )
    return normals


def vertex_normals_reference(
    vertices: Float[Tensor, "N 3"], faces: Int[Tensor, "F 3"]
) -> Float[Tensor, "N 3"]:
    """`vertex_normals` in plain torch, for any device."""
    scaled = face_normals_scaled(vertices, faces)
    summed = torch.zeros_like(vertices).index_add(
        0, faces.reshape(-1).long(), scaled.repeat_interleave(3, 0)
    )
    return normalize(summed)


@kernel()
def _sum_normals(vertices: Array, faces: IntArray, summed: Array) -> None:
    """Add each face's scaled normal to its corners; serial, because faces share them."""
    for f in range(faces.shape[0]):
        i, j, k = faces[f, 0], faces[f, 1], faces[f, 2]
        ax, bx = vertices[j, 0] - vertices[i, 0], vertices[k, 0] - vertices[i, 0]
        ay, by = vertices[j, 1] - vertices[i, 1], vertices[k, 1] - vertices[i, 1]
        az, bz = vertices[j, 2] - vertices[i, 2], vertices[k, 2] - vertices[i, 2]
        x, y, z = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
        for corner in (i, j, k):
            summed[corner, 0] += x
            summed[corner, 1] += y
            summed[corner, 2] += z


@kernel()
def _sum_normals_backward(
    vertices: Array, faces: IntArray, grad_summed: Array, grad_vertices: Array
) -> None:
    """Transpose of the Jacobian of `_sum_normals`: for n = a x b, g_a = b x g and g_b = g x a."""
    for f in range(faces.shape[0]):
        i, j, k = faces[f, 0], faces[f, 1], faces[f, 2]
        ax, bx = vertices[j, 0] - vertices[i, 0], vertices[k, 0] - vertices[i, 0]
        ay, by = vertices[j, 1] - vertices[i, 1], vertices[k, 1] - vertices[i, 1]
        az, bz = vertices[j, 2] - vertices[i, 2], vertices[k, 2] - vertices[i, 2]
        gx = grad_summed[i, 0] + grad_summed[j, 0] + grad_summed[k, 0]
        gy = grad_summed[i, 1] + grad_summed[j, 1] + grad_summed[k, 1]
        gz = grad_summed[i, 2] + grad_summed[j, 2] + grad_summed[k, 2]
        jx, jy, jz = by * gz - bz * gy, bz * gx - bx * gz, bx * gy - by * gx
        kx, ky, kz = gy * az - gz * ay, gz * ax - gx * az, gx * ay - gy * ax
        grad_vertices[j, 0] += jx
        grad_vertices[j, 1] += jy
        grad_vertices[j, 2] += jz
        grad_vertices[k, 0] += kx
        grad_vertices[k, 1] += ky
        grad_vertices[k, 2] += kz
        grad_vertices[i, 0] -= jx + kx
        grad_vertices[i, 1] -= jy + ky
        grad_vertices[i, 2] -= jz + kz


class _VertexNormals(torch.autograd.Function):
    """The kernels as one differentiable operator: half the time of a mesh's step otherwise."""

    @staticmethod
    def forward(ctx: Any, vertices: Tensor, faces: Tensor) -> Tensor:
        """Unit normals."""
        vertices = vertices.detach().contiguous()
        summed = torch.zeros_like(vertices)
        _sum_normals(vertices.numpy(), faces.numpy(), summed.numpy())
        ctx.save_for_backward(vertices, faces, summed)
        return normalize(summed)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_normals: Tensor) -> tuple[Tensor, None]:
        """Gradient of the vertices."""
        vertices, faces, summed = ctx.saved_tensors
        size = length(summed)
        normals = summed / size
        # Where the sum vanishes its guarded length is constant, and the quotient linear.
        is_free = dot(summed, summed) > MIN_NORM_SQUARED
        along = torch.where(is_free, dot(normals, grad_normals), 0.0)
        grad_summed = ((grad_normals - normals * along) / size).contiguous()
        grad_vertices = torch.zeros_like(vertices)
        _sum_normals_backward(
            vertices.numpy(), faces.numpy(), grad_summed.numpy(), grad_vertices.numpy()
        )
        return grad_vertices, None


def signed_volume(vertices: Float[Tensor, "N 3"], faces: Int[Tensor, "F 3"]) -> Float[Tensor, ""]:
    """Enclosed volume of a closed mesh; positive when faces wind outward."""
    corners = vertices.index_select(0, faces.reshape(-1).long()).view(-1, 3, 3)
    return (corners[:, 0] * torch.linalg.cross(corners[:, 1], corners[:, 2])).sum() / 6.0


def face_adjacency(faces: Int[Tensor, "F 3"]) -> Int[Tensor, "F 3"]:
    """Neighbour across the edge opposite each corner; -1 at a boundary.

    An edge shared by more than two faces links them pairwise in face order.
    """
    if faces.device.type != "cpu":
        return face_adjacency_sorted(faces)
    vertices = int(faces.max()) + 1 if len(faces) else 0
    return torch.from_numpy(_pair_edges(faces.int().contiguous().numpy(), vertices))


def face_adjacency_sorted(faces: Int[Tensor, "F 3"]) -> Int[Tensor, "F 3"]:
    """`face_adjacency` in plain torch, for any device; the same result."""
    count = faces.shape[0]
    edges = torch.stack([faces[:, [1, 2]], faces[:, [2, 0]], faces[:, [0, 1]]], 1).reshape(-1, 2)
    low, high = edges.long().sort(1).values.unbind(1)
    key, order = torch.sort(low * (int(faces.max()) + 1 if count else 1) + high, stable=True)
    place = torch.arange(len(key), device=faces.device)
    repeats = torch.zeros_like(key, dtype=torch.bool)
    repeats[1:] = key[1:] == key[:-1]
    rank = place - torch.where(repeats, 0, place).cummax(0).values
    second = torch.nonzero(repeats & (rank % 2 == 1))[:, 0]
    neighbours = torch.full((3 * count,), -1, dtype=torch.int32, device=faces.device)
    neighbours[order[second]] = (order[second - 1] // 3).int()
    neighbours[order[second - 1]] = (order[second] // 3).int()
    return neighbours.view(count, 3)


@kernel()
def _pair_edges(faces: IntArray, vertices: int) -> IntArray:
    """Bucket half-edges by their lower vertex, then match equal ones within each bucket."""
    start = np.zeros(vertices + 1, np.int64)
    for f in range(faces.shape[0]):
        for k in range(3):
            start[min(faces[f, (k + 1) % 3], faces[f, (k + 2) % 3]) + 1] += 1
    for v in range(vertices):
        start[v + 1] += start[v]
    filled = start[:vertices].copy()
    open_edges = np.empty(3 * faces.shape[0], np.int64)
    neighbours = np.full((faces.shape[0], 3), -1, np.int32)
    for f in range(faces.shape[0]):
        for k in range(3):
            a, b = faces[f, (k + 1) % 3], faces[f, (k + 2) % 3]
            low, high = min(a, b), max(a, b)
            matched = False
            for slot in range(start[low], filled[low]):
                g, m = open_edges[slot] // 3, open_edges[slot] % 3
                if max(faces[g, (m + 1) % 3], faces[g, (m + 2) % 3]) == high:
                    neighbours[f, k], neighbours[g, m] = g, f
                    # Matched edges leave the bucket, so that most searches are short.
                    filled[low] -= 1
                    open_edges[slot] = open_edges[filled[low]]
                    matched = True
                    break
            if not matched:
                open_edges[filled[low]] = 3 * f + k
                filled[low] += 1
    return neighbours
