"""Texture reading in glTF's convention."""

import torch
from jaxtyping import Float, Int
from torch import Tensor


def bilinear_taps(
    uv: Float[Tensor, "P 2"], height: int, width: int
) -> tuple[Int[Tensor, "P 4"], Float[Tensor, "P 4"]]:
    """Flat indices and weights of the four texels around each coordinate.

    Weights are differentiable in `uv`; coordinates outside [0, 1] repeat.
    """
    position = (uv - uv.detach().floor()) * uv.new_tensor([width, height]) - 0.5
    corner = position.detach().floor()
    fraction = position - corner
    column, row = corner.long().unbind(1)
    right, below = (column + 1) % width, (row + 1) % height
    column, row = column % width, row % height
    index = torch.stack(
        [row * width + column, row * width + right, below * width + column, below * width + right],
        1,
    )
    fx, fy = fraction.unbind(1)
    weights = torch.stack([(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy], 1)
    return index, weights


def sample_texture(
    texture: Float[Tensor, "H W C"], uv: Float[Tensor, "P 2"]
) -> Float[Tensor, "P C"]:
    """Bilinear value at texture coordinates; differentiable in both arguments.

    `uv` has its origin at the top left of the image (row 0), texel centres lie at half integers,
    and coordinates outside [0, 1] repeat. Source: glTF 2.0, section 3.8.4 (default sampler).
    """
    height, width, channels = texture.shape
    index, weights = bilinear_taps(uv, height, width)
    corners = texture.reshape(-1, channels).index_select(0, index.reshape(-1))
    return (weights[..., None] * corners.view(-1, 4, channels)).sum(1)
