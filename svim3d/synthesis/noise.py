"""Fractal value noise over space: the grain of every invented material."""

import math
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numba import prange
from numpy.typing import NDArray
from torch import Tensor

from svim3d.compiled import kernel

# Odd 32-bit factors that scatter the bits of lattice coordinates; any such numbers would do.
X_FACTOR, Y_FACTOR, Z_FACTOR, MIX_FACTOR = 0x8DA6B343, 0xD8163841, 0xCB1AB31F, 0x2C1B3C6D
WORD = 0xFFFFFFFF
LACUNARITY, GAIN = 2.03, 0.5  # slightly off two, so that lattices of two octaves do not line up


def fractal_noise(points: Float[Tensor, "P 3"], *, octaves: int, seed: int) -> Float[Tensor, "P"]:
    """Smooth noise in [0, 1], mean 1/2, whose coarsest lattice has unit cells.

    Values at lattice points are hashed, blended by the Hermite step within cells; each octave has
    2.03 times the frequency and half the share of the one before.
    """
    if points.device.type != "cpu" or points.dtype != torch.float32:
        return fractal_noise_plainly(points, octaves=octaves, seed=seed)
    out = np.empty(len(points), np.float32)
    _fractal(points.contiguous().numpy(), octaves, seed, out)
    return torch.from_numpy(out)


def fractal_noise_plainly(
    points: Float[Tensor, "P 3"], *, octaves: int, seed: int
) -> Float[Tensor, "P"]:
    """`fractal_noise` in plain torch: the twin of the compiled kernel."""
    p, share, whole = points.double(), 1.0, 0.0
    value = torch.zeros(len(points), dtype=torch.float64, device=points.device)
    for octave in range(octaves):
        value = value + share * _lattice_noise(p, seed + octave)
        whole, share, p = whole + share, share * GAIN, p * LACUNARITY
    return (value / whole).to(points.dtype)


def _lattice_noise(p: Float[Tensor, "P 3"], seed: int) -> Float[Tensor, "P"]:
    """One octave."""
    cell = p.floor()
    t = p - cell
    t = t * t * (3.0 - 2.0 * t)
    i = cell.long()
    value = torch.zeros_like(p[:, 0])
    for corner in range(8):
        bits = (corner & 1, corner >> 1 & 1, corner >> 2)
        weight = torch.ones_like(value)
        for axis, bit in enumerate(bits):
            weight = weight * (t[:, axis] if bit else 1.0 - t[:, axis])
        value = value + weight * _hashed(
            i[:, 0] + bits[0], i[:, 1] + bits[1], i[:, 2] + bits[2], seed
        )
    return value


def _hashed(x: Tensor, y: Tensor, z: Tensor, seed: int) -> Tensor:
    """Value in [0, 1] of a lattice point."""
    h = (x * X_FACTOR ^ y * Y_FACTOR ^ z * Z_FACTOR ^ seed * MIX_FACTOR) & WORD
    h = ((h ^ (h >> 15)) * MIX_FACTOR) & WORD
    h = ((h ^ (h >> 12)) * X_FACTOR) & WORD
    return (h ^ (h >> 15)).double() / WORD


@kernel(fastmath=False)
def _hash(x: int, y: int, z: int, seed: int) -> float:
    h = ((x * X_FACTOR) ^ (y * Y_FACTOR) ^ (z * Z_FACTOR) ^ (seed * MIX_FACTOR)) & WORD
    h = ((h ^ (h >> 15)) * MIX_FACTOR) & WORD
    h = ((h ^ (h >> 12)) * X_FACTOR) & WORD
    return float(h ^ (h >> 15)) / WORD


@kernel(fastmath=False)
def _octave(x: float, y: float, z: float, seed: int) -> float:
    i, j, k = math.floor(x), math.floor(y), math.floor(z)
    u, v, w = x - i, y - j, z - k
    u, v, w = u * u * (3.0 - 2.0 * u), v * v * (3.0 - 2.0 * v), w * w * (3.0 - 2.0 * w)
    near = _hash(i, j, k, seed) * (1.0 - u) + _hash(i + 1, j, k, seed) * u
    far = _hash(i, j + 1, k, seed) * (1.0 - u) + _hash(i + 1, j + 1, k, seed) * u
    low = near * (1.0 - v) + far * v
    near = _hash(i, j, k + 1, seed) * (1.0 - u) + _hash(i + 1, j, k + 1, seed) * u
    far = _hash(i, j + 1, k + 1, seed) * (1.0 - u) + _hash(i + 1, j + 1, k + 1, seed) * u
    return low * (1.0 - w) + (near * (1.0 - v) + far * v) * w


@kernel(parallel=True, fastmath=False)
def _fractal(points: NDArray[Any], octaves: int, seed: int, out: NDArray[np.float32]) -> None:
    for p in prange(len(points)):
        x, y, z = float(points[p, 0]), float(points[p, 1]), float(points[p, 2])
        value, share, whole = 0.0, 1.0, 0.0
        for octave in range(octaves):
            value += share * _octave(x, y, z, seed + octave)
            whole += share
            share *= GAIN
            x, y, z = x * LACUNARITY, y * LACUNARITY, z * LACUNARITY
        out[p] = value / whole
