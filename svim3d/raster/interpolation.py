"""Vertex attributes at the pixels that see them, perspective-correct and differentiable."""

from typing import Any

import numba
import numpy as np
import torch
from jaxtyping import Float, Int
from numpy.typing import NDArray
from torch import Tensor

from svim3d.compiled import kernel
from svim3d.raster.zbuffer import Fragments

BLOCKS_PER_THREAD = 4  # evens out the load of the pixel blocks

Array = NDArray[np.floating[Any]]
IntArray = NDArray[np.integer[Any]]


def interpolate(
    clip: Float[Tensor, "N 4"],
    faces: Int[Tensor, "F 3"],
    fragments: Fragments,
    attributes: Float[Tensor, "N C"],
) -> tuple[Int[Tensor, "P"], Float[Tensor, "P C"]]:
    """Attributes at all covered pixels. Differentiable in `clip` and `attributes`.

    Returns:
        Flat indices of the covered pixels, ascending, and the attribute values there.
    """
    pixels = fragments.pixels
    size = tuple(fragments.triangle.shape)
    triangle = fragments.triangle.reshape(-1)[pixels]
    if clip.device.type == "cpu":
        values: Tensor = _Interpolation.apply(  # type: ignore[no-untyped-call]
            clip, attributes, faces.int().contiguous(), triangle, pixels, size
        )
        return pixels, values
    _, weights = barycentrics(clip, faces, fragments)
    return pixels, blend_corners(weights, faces[triangle.long()], attributes)


def barycentrics(
    clip: Float[Tensor, "N 4"], faces: Int[Tensor, "F 3"], fragments: Fragments
) -> tuple[Int[Tensor, "P"], Float[Tensor, "P 3"]]:
    """Perspective-correct weights of the three corners at all covered pixels, in plain torch.

    b_k = e_k / (e_0 + e_1 + e_2) with the homogeneous edge functions e_k, so that no corner is
    divided by its w. Differentiable in `clip`.
    """
    height, width = fragments.triangle.shape
    pixels = fragments.pixels
    triangle = fragments.triangle.reshape(-1)[pixels].long()
    corners = clip.index_select(0, faces[triangle].reshape(-1).long()).view(-1, 3, 4)
    x = ((pixels % width).to(clip.dtype) + 0.5) * (2.0 / width) - 1.0
    y = 1.0 - (pixels // width + 0.5).to(clip.dtype) * (2.0 / height)
    # Corners seen from the pixel: its own position becomes the origin.
    dx = corners[..., 0] - x[:, None] * corners[..., 3]
    dy = corners[..., 1] - y[:, None] * corners[..., 3]
    edge = dx.roll(-1, 1) * dy.roll(-2, 1) - dx.roll(-2, 1) * dy.roll(-1, 1)
    return pixels, edge / edge.sum(1, keepdim=True)


def blend_corners(
    weights: Float[Tensor, "P 3"], corners: Int[Tensor, "P 3"], attributes: Float[Tensor, "N C"]
) -> Float[Tensor, "P C"]:
    """Weighted mean of each point's three corner attributes."""
    gathered = attributes.index_select(0, corners.reshape(-1).long())
    return (weights[..., None] * gathered.view(*corners.shape, -1)).sum(1)


@kernel()
def _pixel_edges(
    clip: Array, face: IntArray, pixel: int, height: int, width: int, out: Array
) -> None:
    """Rows x, y (corners seen from the pixel) and e (edge functions), for the three corners."""
    x = (pixel % width + 0.5) * (2.0 / width) - 1.0
    y = 1.0 - (pixel // width + 0.5) * (2.0 / height)
    for k in range(3):
        out[0, k] = clip[face[k], 0] - x * clip[face[k], 3]
        out[1, k] = clip[face[k], 1] - y * clip[face[k], 3]
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        out[2, k] = out[0, i] * out[1, j] - out[0, j] * out[1, i]


@kernel(parallel=True)
def _interpolate_forward(
    clip: Array,
    attributes: Array,
    faces: IntArray,
    triangle: IntArray,
    pixels: IntArray,
    size: tuple[int, int],
    values: Array,
    blocks: int,
) -> None:
    """values[p] = sum_k b_k attributes[corner k]; each block of pixels is one task."""
    for block in numba.prange(blocks):
        edges = np.empty((3, 3), clip.dtype)
        first = block * pixels.shape[0] // blocks
        for p in range(first, (block + 1) * pixels.shape[0] // blocks):
            face = faces[triangle[p]]
            _pixel_edges(clip, face, pixels[p], size[0], size[1], edges)
            scale = 1.0 / (edges[2, 0] + edges[2, 1] + edges[2, 2])
            b0, b1, b2 = edges[2, 0] * scale, edges[2, 1] * scale, edges[2, 2] * scale
            for c in range(attributes.shape[1]):
                values[p, c] = (
                    b0 * attributes[face[0], c]
                    + b1 * attributes[face[1], c]
                    + b2 * attributes[face[2], c]
                )


@kernel()
def _interpolate_backward(
    clip: Array,
    attributes: Array,
    faces: IntArray,
    triangle: IntArray,
    pixels: IntArray,
    size: tuple[int, int],
    grad_values: Array,
    grad_clip: Array,
    grad_attributes: Array,
) -> None:
    """Transpose of the forward pass; serial, because neighbouring pixels share corners."""
    edges = np.empty((3, 3), clip.dtype)
    b = np.empty(3, clip.dtype)
    grad_b = np.empty(3, clip.dtype)
    for p in range(pixels.shape[0]):
        face = faces[triangle[p]]
        _pixel_edges(clip, face, pixels[p], size[0], size[1], edges)
        scale = 1.0 / (edges[2, 0] + edges[2, 1] + edges[2, 2])
        mean = 0.0
        for k in range(3):
            b[k] = edges[2, k] * scale
            total = 0.0
            for c in range(attributes.shape[1]):
                total += grad_values[p, c] * attributes[face[k], c]
                grad_attributes[face[k], c] += grad_values[p, c] * b[k]
            grad_b[k] = total
            mean += total * b[k]
        x = (pixels[p] % size[1] + 0.5) * (2.0 / size[1]) - 1.0
        y = 1.0 - (pixels[p] // size[1] + 0.5) * (2.0 / size[0])
        for k in range(3):
            # e_i = x_j y_k - x_k y_j and e_j = x_k y_i - x_i y_k hold this corner's x and y.
            i, j = (k + 1) % 3, (k + 2) % 3
            grad_i, grad_j = (grad_b[i] - mean) * scale, (grad_b[j] - mean) * scale
            grad_x = grad_j * edges[1, i] - grad_i * edges[1, j]
            grad_y = grad_i * edges[0, j] - grad_j * edges[0, i]
            grad_clip[face[k], 0] += grad_x
            grad_clip[face[k], 1] += grad_y
            grad_clip[face[k], 3] -= x * grad_x + y * grad_y


class _Interpolation(torch.autograd.Function):
    """The fused kernels as one differentiable operator."""

    @staticmethod
    def forward(
        ctx: Any,
        clip: Tensor,
        attributes: Tensor,
        faces: Tensor,
        triangle: Tensor,
        pixels: Tensor,
        size: tuple[int, int],
    ) -> Tensor:
        """Values at the pixels."""
        clip, attributes = clip.detach().contiguous(), attributes.detach().contiguous()
        ctx.save_for_backward(clip, attributes, faces, triangle, pixels)
        ctx.size = size
        values = attributes.new_empty(len(pixels), attributes.shape[1])
        _interpolate_forward(
            clip.numpy(),
            attributes.numpy(),
            faces.numpy(),
            triangle.numpy(),
            pixels.numpy(),
            size,
            values.numpy(),
            BLOCKS_PER_THREAD * numba.get_num_threads(),
        )
        return values

    @staticmethod
    def backward(ctx: Any, grad_values: Tensor) -> tuple[Tensor | None, ...]:
        """Gradients of clip positions and attributes."""
        clip, attributes, faces, triangle, pixels = ctx.saved_tensors
        grad_clip, grad_attributes = torch.zeros_like(clip), torch.zeros_like(attributes)
        _interpolate_backward(
            clip.numpy(),
            attributes.numpy(),
            faces.numpy(),
            triangle.numpy(),
            pixels.numpy(),
            ctx.size,
            grad_values.contiguous().numpy(),
            grad_clip.numpy(),
            grad_attributes.numpy(),
        )
        return grad_clip, grad_attributes, None, None, None, None
