"""Priors on surfaces under optimisation: few sign changes, even triangles."""

from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn.functional import binary_cross_entropy_with_logits

from svim3d.compiled import kernel

Array = NDArray[np.floating[Any]]
IntArray = NDArray[np.int32]


def sign_change_loss(sdf: Float[Tensor, "N"], edges: Int[Tensor, "E 2"]) -> Float[Tensor, ""]:
    """Pull the ends of crossed edges to one sign, which removes floaters and hidden sheets.

    Mean over the edges of BCE(sigmoid(s_a), [s_b > 0]) + BCE(sigmoid(s_b), [s_a > 0]).
    Source: Munkberg et al. 2022, eq. 2.

    Args:
        sdf: node values in units of a lattice cell.
        edges: edges whose ends differ in sign.
    """
    ends = sdf.index_select(0, edges.reshape(-1).long()).view(-1, 2)
    target = (ends.detach() > 0.0).to(sdf.dtype).flip(1)
    return 2.0 * binary_cross_entropy_with_logits(ends, target)


def laplacian_loss(vertices: Float[Tensor, "N 3"], faces: Int[Tensor, "F 3"]) -> Float[Tensor, ""]:
    """Mean squared distance of each vertex from the mean of its neighbours (closed meshes)."""
    if vertices.device.type != "cpu":
        return laplacian_loss_reference(vertices, faces)
    loss: Tensor = _Laplacian.apply(  # type: ignore[no-untyped-call]
        vertices, faces.int().contiguous()
    )
    return loss


def laplacian_loss_reference(
    vertices: Float[Tensor, "N 3"], faces: Int[Tensor, "F 3"]
) -> Float[Tensor, ""]:
    """`laplacian_loss` in plain torch, for any device."""
    start = faces.reshape(-1).long()
    end = faces.roll(-1, 1).reshape(-1).long()
    # A closed mesh holds each edge once in either direction: every neighbour counts once.
    summed = torch.zeros_like(vertices).index_add(0, start, vertices.index_select(0, end))
    degree = torch.bincount(start, minlength=len(vertices)).clamp_min(1).to(vertices.dtype)
    return (summed / degree[:, None] - vertices).square().sum(1).mean()


@kernel()
def _laplacian(vertices: Array, faces: IntArray, degree: Array, offset: Array) -> None:
    """Number of each vertex' neighbours, at least 1, and the way from it to their mean."""
    for f in range(faces.shape[0]):
        for corner in range(3):
            start, end = faces[f, corner], faces[f, (corner + 1) % 3]
            degree[start] += 1.0
            for axis in range(3):
                offset[start, axis] += vertices[end, axis]
    for v in range(vertices.shape[0]):
        degree[v] = max(degree[v], 1.0)
        for axis in range(3):
            offset[v, axis] = offset[v, axis] / degree[v] - vertices[v, axis]


@kernel()
def _laplacian_backward(
    faces: IntArray, degree: Array, offset: Array, scale: float, grad_vertices: Array
) -> None:
    """Gradient of scale / 2 times the summed squares of `offset`."""
    for v in range(offset.shape[0]):
        for axis in range(3):
            grad_vertices[v, axis] = -scale * offset[v, axis]
    for f in range(faces.shape[0]):
        for corner in range(3):
            start, end = faces[f, corner], faces[f, (corner + 1) % 3]
            share = scale / degree[start]
            for axis in range(3):
                grad_vertices[end, axis] += share * offset[start, axis]


class _Laplacian(torch.autograd.Function):
    """The kernels as one differentiable operator."""

    @staticmethod
    def forward(ctx: Any, vertices: Tensor, faces: Tensor) -> Tensor:
        """Mean square."""
        vertices = vertices.detach().contiguous()
        degree, offset = vertices.new_zeros(len(vertices)), torch.zeros_like(vertices)
        _laplacian(vertices.numpy(), faces.numpy(), degree.numpy(), offset.numpy())
        ctx.save_for_backward(faces, degree, offset)
        return offset.square().sum(1).mean()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_loss: Tensor) -> tuple[Tensor, None]:
        """Gradient of the vertices."""
        faces, degree, offset = ctx.saved_tensors
        grad_vertices = torch.empty_like(offset)
        scale = 2.0 * float(grad_loss) / max(len(offset), 1)
        _laplacian_backward(
            faces.numpy(), degree.numpy(), offset.numpy(), scale, grad_vertices.numpy()
        )
        return grad_vertices, None
