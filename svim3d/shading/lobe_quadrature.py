"""Exact lobes over an octahedral map, as rows of a sparse matrix over its mip stack.

A row is the integral of one lobe against the map. Far from the lobe's axis the lobe varies slowly,
so a coarse mip texel stands for all texels below it; near the axis the map's own texels are used,
and the lobe is averaged over a texel where it is narrower than that. Every texel of the map counts
once, and the mips hold the same energy, so nothing is cut off however long the tail.
(The same idea as the tree codes of Barnes and Hut 1986.)
"""

import math
from typing import Any

import numba
import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from svim3d.compiled import kernel
from svim3d.shading.octahedral import DOUBLE, texel_directions, texel_solid_angles

TAIL_EXPONENT = 1.0  # how much faster than the lobe's length scale texels grow in the tail
HALF_DIAGONAL = 0.7  # of a square texel, over its side
SUBDIVISION = 4  # points per side at which a lobe narrower than a texel is averaged
MAX_WAITING = 128  # nodes on the traversal stack: the coarsest mip's 16 and 3 per further mip
MAX_NODES = 1024  # stored entries of one row; 40 to 500 are used
ROWS_PER_CHUNK = 2048  # bounds memory while rows are built


def exact_rows(
    size: int, mips: tuple[int, ...], roughness: float | None, accuracy: float
) -> scipy.sparse.csr_matrix:
    """Rows of a size x size level: weights over the mip stack whose sides are `mips`.

    Args:
        size: side of the output level.
        mips: sides of the map and its mips, finest first.
        roughness: perceptual roughness of the GGX lobe, or None for the cosine lobe.
        accuracy: side over the lobe's local length scale (a radian at most) below which a texel
            may stand for all texels below it. The error under one small lamp is about a tenth.

    Returns:
        Weights in float32, columns in int32.

    Raises:
        ValueError: a row would have more than MAX_NODES entries.
    """
    # The GGX lobe of width 1 times the cosine is the cosine lobe.
    alpha = 1.0 if roughness is None else roughness * roughness
    axes = _directions(size)
    sizes = np.array(mips)
    offsets = np.cumsum([0, *(n * n for n in mips)])
    directions = np.concatenate([_directions(n) for n in mips])
    omega = np.concatenate([texel_solid_angles(n, DOUBLE).numpy().ravel() for n in mips])
    blocks = []
    for start in range(0, len(axes), ROWS_PER_CHUNK):
        chunk = axes[start : start + ROWS_PER_CHUNK]
        columns = np.empty((len(chunk), MAX_NODES), np.int32)
        weights = np.empty((len(chunk), MAX_NODES), np.float32)
        counts = np.zeros(len(chunk), np.int64)
        _integrate(
            chunk,
            alpha,
            accuracy,
            sizes,
            offsets,
            directions,
            omega,
            columns,
            weights,
            counts,
        )
        if counts.min() < 0:
            raise ValueError(
                f"accuracy {accuracy:g} at roughness {roughness} needs more than {MAX_NODES} "
                "entries in a row; ask for a larger accuracy value"
            )
        used = np.arange(MAX_NODES) < counts[:, None]
        pointers = np.concatenate([[0], np.cumsum(counts)])
        shape = (len(chunk), int(offsets[-1]))
        blocks.append(scipy.sparse.csr_matrix((weights[used], columns[used], pointers), shape))
    return scipy.sparse.vstack(blocks, format="csr")


def _directions(n: int) -> NDArray[np.float64]:
    """Unit directions of texel centres, flat."""
    directions: NDArray[np.float64] = texel_directions(n, DOUBLE).view(-1, 3).numpy()
    return directions


@kernel(parallel=True)
def _integrate(
    axes: NDArray[np.float64],
    alpha: float,
    accuracy: float,
    sizes: NDArray[np.int64],
    offsets: NDArray[np.int64],
    directions: NDArray[np.float64],
    omega: NDArray[np.float64],
    columns: NDArray[np.int32],
    weights: NDArray[np.float32],
    counts: NDArray[np.int64],
) -> None:
    """Columns and normalised weights of one row per axis, from the coarsest mip downwards.

    A count of -1 says that a row has no room for its entries.
    """
    coarsest = len(sizes) - 1
    for row in numba.prange(len(axes)):
        waiting = np.empty((MAX_WAITING, 2), np.int64)
        length = sizes[coarsest] ** 2
        for node in range(length):
            waiting[node, 0] = coarsest
            waiting[node, 1] = node
        count, total = 0, 0.0
        while length > 0:
            length -= 1
            level, node = waiting[length, 0], waiting[length, 1]
            entry = offsets[level] + node
            side = math.sqrt(omega[entry])
            if side > accuracy * _length_scale(axes[row], directions[entry], side, alpha):
                size = sizes[level]
                i, j = node // size, node % size
                if level > 0:
                    for child in range(4):
                        waiting[length, 0] = level - 1
                        waiting[length, 1] = (2 * i + child // 2) * 2 * size + 2 * j + child % 2
                        length += 1
                    continue
                value = _texel_mean(axes[row], i, j, size, alpha) * omega[entry]
            else:
                value = _lobe(axes[row], directions[entry], alpha) * omega[entry]
            if value > 0.0:
                if count == columns.shape[1]:
                    count = -1
                    break
                columns[row, count] = entry
                weights[row, count] = value
                count += 1
                total += value
        for k in range(count):
            weights[row, k] /= total
        counts[row] = count


@kernel()
def _texel_mean(axis: NDArray[np.float64], i: int, j: int, size: int, alpha: float) -> float:
    """Mean of the lobe over texel (row i, column j) of the map."""
    points = size * SUBDIVISION
    value = 0.0
    for k in range(SUBDIVISION * SUBDIVISION):
        y, x = i * SUBDIVISION + k // SUBDIVISION, j * SUBDIVISION + k % SUBDIVISION
        value += _lobe(axis, _direction(y, x, points), alpha)
    return value / (SUBDIVISION * SUBDIVISION)


@kernel()
def _direction(i: int, j: int, size: int) -> tuple[float, float, float]:
    """Unit direction of a texel centre; `octahedral.texel_directions` for one texel."""
    u, v = (2.0 * j + 1.0) / size - 1.0, (2.0 * i + 1.0) / size - 1.0
    y = 1.0 - abs(u) - abs(v)
    fold = max(0.0, -y)
    x, z = u - math.copysign(fold, u), v - math.copysign(fold, v)
    norm = math.sqrt(x * x + y * y + z * z)
    return x / norm, y / norm, z / norm


@kernel()
def _lobe(axis: NDArray[np.float64], wi: Any, alpha: float) -> float:
    """D(h) n.wi for view = normal = axis, up to a constant factor."""
    cosine = axis[0] * wi[0] + axis[1] * wi[1] + axis[2] * wi[2]
    if cosine <= 0.0:
        return 0.0
    spread = _spread(cosine, alpha)
    value: float = cosine / (spread * spread)
    return value


@kernel()
def _spread(cosine: float, alpha: float) -> float:
    """GGX denominator alpha^2 cos^2 + sin^2 at half the angle to the axis."""
    half_squared = 0.5 * (1.0 + min(cosine, 1.0))
    return alpha * alpha * half_squared + (1.0 - half_squared)


@kernel()
def _length_scale(
    axis: NDArray[np.float64], centre: NDArray[np.float64], side: float, alpha: float
) -> float:
    """Angle in radian over which the lobe changes near a texel, a radian at most.

    That is 2 sqrt(spread), measured at the texel's nearest point, and more in the tail, which
    matters the less the farther out it is.
    """
    cosine = axis[0] * centre[0] + axis[1] * centre[1] + axis[2] * centre[2]
    nearest = max(0.0, math.acos(min(1.0, max(-1.0, cosine))) - HALF_DIAGONAL * side)
    scale = math.sqrt(_spread(math.cos(nearest), alpha))
    length: float = min(1.0, 2.0 * scale * (scale / alpha) ** TAIL_EXPONENT)
    return length
