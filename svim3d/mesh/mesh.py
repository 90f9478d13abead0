"""Triangle meshes as tensors: adjacency, normals, areas."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from svim3d.numerics import normalize


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
    scaled = face_normals_scaled(vertices, faces)
    summed = torch.zeros_like(vertices).index_add(
        0, faces.reshape(-1).long(), scaled.repeat_interleave(3, 0)
    )
    return normalize(summed)


def signed_volume(vertices: Float[Tensor, "N 3"], faces: Int[Tensor, "F 3"]) -> Float[Tensor, ""]:
    """Enclosed volume of a closed mesh; positive when faces wind outward."""
    corners = vertices.index_select(0, faces.reshape(-1).long()).view(-1, 3, 3)
    return (corners[:, 0] * torch.linalg.cross(corners[:, 1], corners[:, 2])).sum() / 6.0


def face_adjacency(faces: Int[Tensor, "F 3"]) -> Int[Tensor, "F 3"]:
    """Neighbour across the edge opposite each corner; -1 at a boundary.

    An edge shared by more than two faces links the first pairs in face order.
    """
    count = faces.shape[0]
    edges = torch.stack([faces[:, [1, 2]], faces[:, [2, 0]], faces[:, [0, 1]]], 1).reshape(-1, 2)
    low, high = edges.long().sort(1).values.unbind(1)
    key = low * (int(faces.max()) + 1 if count else 1) + high
    order = torch.argsort(key, stable=True)
    paired = torch.nonzero(key[order[1:]] == key[order[:-1]])[:, 0]
    neighbours = torch.full((3 * count,), -1, dtype=torch.int32, device=faces.device)
    neighbours[order[paired]] = (order[paired + 1] // 3).int()
    neighbours[order[paired + 1]] = (order[paired] // 3).int()
    return neighbours.view(count, 3)
