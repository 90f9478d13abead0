"""Priors on surfaces under optimisation: few sign changes, even triangles."""

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits


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
    start = faces.reshape(-1).long()
    end = faces.roll(-1, 1).reshape(-1).long()
    # A closed mesh holds each edge once in either direction: every neighbour counts once.
    summed = torch.zeros_like(vertices).index_add(0, start, vertices.index_select(0, end))
    degree = torch.bincount(start, minlength=len(vertices)).clamp_min(1).to(vertices.dtype)
    return (summed / degree[:, None] - vertices).square().sum(1).mean()
