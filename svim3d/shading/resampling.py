"""Resampling of the sphere: from any picture of it to an octahedral map, with exact energy.

A picture is a list of cells, each with its solid angle, and a rule that names the cells near a
direction. Sub-samples of the octahedral map gather the cells: a sparse matrix whose rows are means.
What the samples catch of a cell's solid angle is a little too much or too little; rows and columns
are therefore balanced until both hold: a constant stays constant, and every cell gives exactly its
own energy, a lamp of one texel included.
Source: Sinkhorn and Knopp 1967, "Concerning nonnegative matrices and doubly stochastic matrices".
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy.typing import NDArray
from scipy import sparse
from torch import Tensor

from svim3d.shading.octahedral import (
    DOUBLE,
    direction_from_octahedral,
    texel_solid_angles,
)

MAX_BALANCE_ROUNDS = 60
MAX_UNEVENNESS = 1e-3  # of a constant, where balancing stops; the energy is exact after each round
CHUNK_SAMPLES = 1 << 18  # sub-samples held in memory at a time
MIN_SUBDIVISION = 2  # samples per texel side, so that a texel is a mean and not a point
SAMPLES_PER_CELL_SIDE = 2.0  # fewer would miss some of the cells

Taps = Callable[
    [Float[Tensor, "P 3"]], tuple[Int[Tensor, "P 4"], Float[Tensor, "P 4"]]
]  # unit directions -> indices of the cells around each and their bilinear weights


@dataclass(frozen=True)
class SphereCells:
    """A picture of the sphere without its layout.

    Attributes:
        radiance: mean of each cell, linear.
        solid_angles: of each cell, steradian; they sum to 4 pi.
        taps: the cells around a direction.
        side: a typical cell's side, radian.
    """

    radiance: Float[Tensor, "S c"]
    solid_angles: Float[Tensor, "S 1"]
    taps: Taps
    side: float


def octahedral_from_cells(cells: SphereCells, size: int) -> Float[Tensor, "size size c"]:
    """Octahedral map whose texels are means over their solid angle; `size` is even.

    The sum of radiance times solid angle equals that of the cells up to rounding.
    """
    texel_side = math.sqrt(4.0 * math.pi) / size
    subdivision = max(MIN_SUBDIVISION, math.ceil(SAMPLES_PER_CELL_SIDE * texel_side / cells.side))
    gather = _gathering_matrix(cells, size, subdivision)
    texel_scale, cell_scale = _balanced(
        gather,
        texel_solid_angles(size, DOUBLE).flatten().numpy(),
        cells.solid_angles.double().cpu().numpy()[:, 0],
    )
    energy = cells.radiance.double().cpu().numpy() * cell_scale[:, None]
    radiance = (gather @ energy) * texel_scale[:, None]
    return torch.from_numpy(radiance).view(size, size, -1).to(cells.radiance)


def _gathering_matrix(cells: SphereCells, size: int, subdivision: int) -> sparse.csr_array:
    """Share of every cell in every texel, [size^2, S]; rows sum to 1."""
    blocks = []
    for directions, share in _sub_samples(size, subdivision, cells.radiance):
        index, weight = cells.taps(directions.reshape(-1, 3))
        weight = weight * share.reshape(-1, 1)
        # Bring the samples of one texel together: [rows, s, columns, s, 4] -> [texel, s s 4].
        shape = (-1, subdivision, size, subdivision, 4)
        columns = index.view(shape).transpose(1, 2).reshape(-1, subdivision**2 * 4)
        values = weight.view(shape).transpose(1, 2).reshape(-1, subdivision**2 * 4)
        begins = np.arange(len(columns) + 1, dtype=np.int64) * columns.shape[1]
        block = sparse.csr_array(
            (values.flatten().double().cpu().numpy(), columns.flatten().cpu().numpy(), begins),
            shape=(len(columns), len(cells.radiance)),
        )
        block.sum_duplicates()
        blocks.append(block)
    return sparse.vstack(blocks, format="csr")


def _balanced(
    gather: sparse.csr_array, texel_omega: NDArray[np.float64], cell_omega: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Factors of rows and columns for which rows sum to 1 and columns give the cells' energy."""
    spread = gather.T.tocsr()
    caught = np.ones(len(texel_omega))
    for _ in range(MAX_BALANCE_ROUNDS):
        texel_scale = 1.0 / caught
        cell_scale = cell_omega / (spread @ (texel_omega * texel_scale))
        caught = gather @ cell_scale
        if np.abs(caught * texel_scale - 1.0).max() < MAX_UNEVENNESS:
            break
    return texel_scale, cell_scale


def weighted_blocks(
    values: Float[Tensor, "H W c"], weights: Float[Tensor, "H W 1"], factor: int
) -> Float[Tensor, "h w c"]:
    """Weighted means over factor x factor blocks."""
    height, width, channels = values.shape
    shape = (height // factor, factor, width // factor, factor)
    total = (values * weights).view(*shape, channels).sum((1, 3))
    return total / weights.reshape(*shape, 1).sum((1, 3))


def _sub_samples(
    size: int, subdivision: int, like: Tensor
) -> Iterator[tuple[Float[Tensor, "h w 3"], Float[Tensor, "h w"]]]:
    """Directions of subdivision^2 points per texel, and their share of the texel's solid angle."""
    n = size * subdivision
    axis = ((torch.arange(n, dtype=torch.float64) * 2.0 + 1.0) / n - 1.0).to(like)
    rows = subdivision * max(1, CHUNK_SAMPLES // (n * subdivision))
    for block in torch.split(axis, rows):
        v, u = torch.meshgrid(block, axis, indexing="ij")
        directions = direction_from_octahedral(torch.stack([u, v], -1))
        # Solid angle per area of the square: |d|_1^3 for the unit direction d.
        density = directions.abs().sum(-1) ** 3
        mean = torch.nn.functional.avg_pool2d(density[None], subdivision)[0]
        mean = mean.repeat_interleave(subdivision, 0).repeat_interleave(subdivision, 1)
        yield directions, density / (mean * subdivision**2)
