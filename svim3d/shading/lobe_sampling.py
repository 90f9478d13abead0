"""Filtered importance sampling of lobes, as rows of a sparse matrix over a mip stack.

Source: Krivanek and Colbert 2008, "Real-time shading with filtered importance sampling".
"""

import math

import numpy as np
import scipy.sparse
import torch
from jaxtyping import Float
from torch import Tensor

from svim3d.numerics import normalize
from svim3d.shading.octahedral import bilinear_taps, texel_directions

ENTRIES_PER_CHUNK = 1 << 21  # bounds memory while rows are built, about 100 bytes each


def sampled_rows(
    size: int, mips: tuple[int, ...], roughness: float | None, samples: int, lod_bias: float
) -> scipy.sparse.csr_matrix:
    """Rows of a size x size level: weights over the mip stack whose sides are `mips`.

    Args:
        size: side of the output level.
        mips: sides of the map and its mips, finest first.
        roughness: perceptual roughness of the GGX lobe, or None for the cosine lobe.
        samples: directions per texel, shared by all texels (Halton points in bases 2 and 3).
        lod_bias: mips coarser than a sample's share of the lobe at which it is read.

    Returns:
        Weights in float32, columns in int32.
    """
    if roughness is None:
        local, density, weight = cosine_lobe_samples(samples)
    else:
        local, density, weight = ggx_lobe_samples(samples, roughness)
    normals = texel_directions(size, like=local).view(-1, 3)
    share = 1.0 / (samples * density)
    offsets = np.cumsum([0, *(n * n for n in mips)])
    blocks = [
        _chunk_rows(chunk, local, share, weight / weight.sum(), mips, offsets, lod_bias)
        for chunk in torch.split(normals, max(1, ENTRIES_PER_CHUNK // (8 * len(local))))
    ]
    return scipy.sparse.vstack(blocks, format="csr")


def halton(count: int, base: int) -> Float[Tensor, "count"]:
    """First `count` points of the radical-inverse sequence, starting after zero."""
    points = []
    for index in range(1, count + 1):
        value, digit = 0.0, 1.0
        while index:
            digit /= base
            value += digit * (index % base)
            index //= base
        points.append(value)
    return torch.tensor(points, dtype=torch.float64)


def ggx_lobe_samples(
    samples: int, roughness: float
) -> tuple[Float[Tensor, "S 3"], Float[Tensor, "S 1"], Float[Tensor, "S 1"]]:
    """Light directions about +z with their densities and cosines, for view = normal = +z.

    Half vectors follow D (n.h); the density of the reflected direction is then D / 4. Directions
    below the horizon are dropped.
    """
    alpha = roughness * roughness
    u, v = halton(samples, 2), halton(samples, 3)
    cosine_squared = (1.0 - u) / (1.0 + (alpha * alpha - 1.0) * u)
    cosine, sine = cosine_squared.sqrt(), (1.0 - cosine_squared).sqrt()
    phi = 2.0 * math.pi * v
    direction = torch.stack(
        [
            2.0 * cosine * sine * phi.cos(),
            2.0 * cosine * sine * phi.sin(),
            2.0 * cosine_squared - 1.0,
        ],
        -1,
    )
    spread = 1.0 + (alpha * alpha - 1.0) * cosine_squared
    density = alpha * alpha / (4.0 * math.pi * spread * spread)
    above = direction[:, 2] > 0
    direction, density = direction[above], density[above, None]
    return direction, density, direction[:, 2:]


def cosine_lobe_samples(
    samples: int,
) -> tuple[Float[Tensor, "S 3"], Float[Tensor, "S 1"], Float[Tensor, "S 1"]]:
    """Cosine-distributed directions about +z with their densities and equal weights."""
    u, phi = halton(samples, 2), 2.0 * math.pi * halton(samples, 3)
    cosine, sine = (1.0 - u).sqrt(), u.sqrt()
    direction = torch.stack([sine * phi.cos(), sine * phi.sin(), cosine], -1)
    return direction, cosine[:, None] / math.pi, torch.ones_like(cosine)[:, None]


def tangent_frame(
    normal: Float[Tensor, "P 3"],
) -> tuple[Float[Tensor, "P 3"], Float[Tensor, "P 3"]]:
    """Two unit vectors that make a right-handed frame with unit normals.

    Source: Duff et al. 2017, "Building an orthonormal basis, revisited".
    """
    x, y, z = normal.unbind(-1)
    sign = torch.where(z >= 0, 1.0, -1.0).to(normal.dtype)
    a = -1.0 / (sign + z)
    b = x * y * a
    tangent = torch.stack([1.0 + sign * x * x * a, sign * b, -sign * x], -1)
    return tangent, torch.stack([b, sign + y * y * a, -y], -1)


def sample_lod(
    direction: Float[Tensor, "P 3"], share: float, size: int, coarsest: int, lod_bias: float
) -> Float[Tensor, "P 1"]:
    """Mip whose texels match a sample's share of solid angle, and `lod_bias` more.

    The texel of a size^2 map towards the unit direction d covers 4 |d|_1^3 / size^2 steradian.
    """
    texel = 4.0 * direction.abs().sum(-1, keepdim=True) ** 3 / size**2
    return (0.5 * torch.log2(share / texel) + lod_bias).clamp(0.0, coarsest)


def _chunk_rows(
    normals: Float[Tensor, "P 3"],
    local: Float[Tensor, "S 3"],
    share: Float[Tensor, "S 1"],
    weight: Float[Tensor, "S 1"],
    mips: tuple[int, ...],
    offsets: np.ndarray,
    lod_bias: float,
) -> scipy.sparse.csr_matrix:
    """Rows of one chunk of output texels."""
    tangent, bitangent = tangent_frame(normals)
    sizes = torch.tensor(mips)
    starts = torch.from_numpy(offsets)
    columns, values = [], []
    for s in range(len(local)):
        x, y, z = local[s].tolist()
        direction = normalize(x * tangent + y * bitangent + z * normals)
        lod = sample_lod(direction, float(share[s]), mips[0], len(mips) - 1, lod_bias)
        lower = lod.floor().clamp_max(len(mips) - 2)
        for step in (0, 1):
            level = lower[:, 0].long() + step
            trilinear = lod - lower if step else 1.0 - (lod - lower)
            taps, bilinear = bilinear_taps(direction, sizes[level])
            columns.append(taps + starts[level][:, None])
            values.append(bilinear * trilinear * float(weight[s]))
    pointers = np.arange(len(normals) + 1) * 4 * len(columns)
    flat = torch.cat(columns, 1).to(torch.int32).numpy().ravel()
    shape = (len(normals), int(offsets[-1]))
    matrix = scipy.sparse.csr_matrix((torch.cat(values, 1).numpy().ravel(), flat, pointers), shape)
    matrix.sum_duplicates()
    matrix.eliminate_zeros()
    return matrix.astype(np.float32)
