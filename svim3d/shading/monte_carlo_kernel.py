"""Compiled kernel of shading by sampling: all light directions of a batch of points.

The arithmetic of `monte_carlo.gather_plainly`, sample by sample in double precision. All kernels
live in this file, because numba's cache watches only the file of the caller.
"""

import math
from typing import Any

import numba
from numpy.typing import NDArray

from svim3d.compiled import kernel

Array = NDArray[Any]
Triple = tuple[float, float, float]
Light = tuple[Array, Array, Array]  # radiance with a border of one texel, cumulative, density

MIN_DENSITY = 1e-12  # of a light direction, per steradian; keeps the weight finite
MIN_COSINE_SQUARED = 1e-20  # keeps Smith's tangent finite at the horizon


@kernel(parallel=True)
def gather_light(
    points: tuple[Array, Array, Array, Array],
    light: Light,
    counts: tuple[int, int, int],
    u: Array,
    gathered: tuple[Array, Array],
) -> None:
    """Write irradiance and specular radiance; one point per iteration.

    `points` holds frames, views in them, F0 and widths; `u` three uniform numbers per sample.
    """
    frames, views, f0s, alphas = points
    irradiance, reflected = gathered
    samples = counts[0] + counts[1] + counts[2]
    for p in numba.prange(len(views)):
        frame, wo, alpha = frames[p], (views[p, 0], views[p, 1], views[p, 2]), alphas[p, 0]
        for c in range(3):
            irradiance[p, c], reflected[p, c] = 0.0, 0.0
        hidden_v = _smith_lambda(wo[2], alpha)
        for s in range(samples):
            if s < counts[0]:
                wi = _to_local(frame, _light_direction(light, u[p, s]))
            elif s < counts[0] + counts[1]:
                wi = _cosine_direction(u[p, s])
            else:
                wi = _lobe_direction(wo, alpha, u[p, s])
            if not wi[2] > 0.0:
                continue
            wh = _unit(wi[0] + wo[0], wi[1] + wo[1], wi[2] + wo[2])
            u_square, v_square, per_square = _square(_to_world(frame, wi))
            distribution = _distribution(wh[2], alpha)
            density = (
                counts[0] * _light_density(light, u_square, v_square) / per_square
                + counts[1] * wi[2] / math.pi
                + counts[2] * distribution / ((1.0 + hidden_v) * 4.0 * wo[2])
            ) / samples
            weight = wi[2] / (max(density, MIN_DENSITY) * samples)
            hidden_l = _smith_lambda(wi[2], alpha)
            lobe = distribution / ((1.0 + hidden_v + hidden_l) * 4.0 * wo[2] * wi[2])
            facing = wo[0] * wh[0] + wo[1] * wh[1] + wo[2] * wh[2]
            grazing = min(max(1.0 - facing, 0.0), 1.0) ** 5
            for c in range(3):
                incoming = weight * _fetch(light[0], u_square, v_square, c)
                irradiance[p, c] += incoming
                f0 = f0s[p, c]
                reflected[p, c] += (f0 + (1.0 - f0) * grazing) * lobe * incoming


@kernel()
def _light_direction(light: Light, u: Array) -> Triple:
    """Unit direction in the world; see `SampledLight.sample`."""
    n = light[0].shape[0] - 2
    cumulative = light[1]
    low, high = 0, n * n - 1  # the first texel whose cumulative share exceeds the number
    while low < high:
        middle = (low + high) // 2
        if cumulative[middle] > u[0]:
            high = middle
        else:
            low = middle + 1
    a = (low % n + u[1]) * (2.0 / n) - 1.0
    b = (low // n + u[2]) * (2.0 / n) - 1.0
    y = 1.0 - abs(a) - abs(b)
    fold = max(-y, 0.0)
    return _unit(a - fold * _sign(a), y, b - fold * _sign(b))


@kernel()
def _light_density(light: Light, u: float, v: float) -> float:
    """Probability per area of the square at square coordinates in [-1, 1]."""
    n = light[0].shape[0] - 2
    column = min(max(int((u + 1.0) * (0.5 * n)), 0), n - 1)
    row = min(max(int((v + 1.0) * (0.5 * n)), 0), n - 1)
    density: float = light[2][row * n + column]
    return density


@kernel()
def _fetch(border: Array, u: float, v: float, c: int) -> float:
    """Bilinear lookup in a map with a border of one texel."""
    n = border.shape[0] - 2
    column, row = (u * 0.5 + 0.5) * n + 0.5, (v * 0.5 + 0.5) * n + 0.5
    j, i = min(max(int(column), 0), n), min(max(int(row), 0), n)
    fx, fy = column - j, row - i
    top = border[i, j, c] * (1.0 - fx) + border[i, j + 1, c] * fx
    bottom = border[i + 1, j, c] * (1.0 - fx) + border[i + 1, j + 1, c] * fx
    value: float = top * (1.0 - fy) + bottom * fy
    return value


@kernel()
def _square(d: Triple) -> Triple:
    """Square coordinates of a unit direction, and solid angle per area of the square there."""
    x, y, z = d
    norm = abs(x) + abs(y) + abs(z)
    u, v = x / norm, z / norm
    if y < 0.0:
        u, v = (1.0 - abs(v)) * _sign(u), (1.0 - abs(u)) * _sign(v)
    return u, v, norm * norm * norm


@kernel()
def _cosine_direction(u: Array) -> Triple:
    """Cosine-distributed direction about +z."""
    sine, phi = math.sqrt(u[0]), 2.0 * math.pi * u[1]
    return sine * math.cos(phi), sine * math.sin(phi), math.sqrt(1.0 - u[0])


@kernel()
def _lobe_direction(wo: Triple, alpha: float, u: Array) -> Triple:
    """`wo` reflected by a visible normal; see `microfacet.sample_visible_normal`."""
    sx, sy, sz = _unit(wo[0] * alpha, wo[1] * alpha, wo[2])
    phi = 2.0 * math.pi * u[0]
    z = (1.0 - u[1]) * (1.0 + sz) - sz
    sine = math.sqrt(max(1.0 - z * z, 0.0))
    hx, hy, hz = sine * math.cos(phi) + sx, sine * math.sin(phi) + sy, z + sz
    wh = _unit(hx * alpha, hy * alpha, max(hz, 0.0))
    twice = 2.0 * (wo[0] * wh[0] + wo[1] * wh[1] + wo[2] * wh[2])
    return twice * wh[0] - wo[0], twice * wh[1] - wo[1], twice * wh[2] - wo[2]


@kernel()
def _distribution(n_dot_wh: float, alpha: float) -> float:
    """GGX density of normals; see `microfacet.distribution_ggx`."""
    cosine_squared = n_dot_wh * n_dot_wh
    spread = alpha * alpha * cosine_squared + max(1.0 - cosine_squared, 0.0)
    return alpha * alpha / (math.pi * spread * spread)


@kernel()
def _smith_lambda(n_dot_w: float, alpha: float) -> float:
    """Hidden over visible microfacet area; see `microfacet.smith_lambda`."""
    cosine_squared = max(n_dot_w * n_dot_w, MIN_COSINE_SQUARED)
    tangent_squared = max(1.0 - cosine_squared, 0.0) / cosine_squared
    return 0.5 * (math.sqrt(1.0 + alpha * alpha * tangent_squared) - 1.0)


@kernel()
def _to_local(frame: Array, d: Triple) -> Triple:
    """A world direction in a frame whose rows are its axes."""
    return (
        frame[0, 0] * d[0] + frame[0, 1] * d[1] + frame[0, 2] * d[2],
        frame[1, 0] * d[0] + frame[1, 1] * d[1] + frame[1, 2] * d[2],
        frame[2, 0] * d[0] + frame[2, 1] * d[1] + frame[2, 2] * d[2],
    )


@kernel()
def _to_world(frame: Array, d: Triple) -> Triple:
    """A local direction of a frame whose rows are its axes, in the world."""
    return (
        frame[0, 0] * d[0] + frame[1, 0] * d[1] + frame[2, 0] * d[2],
        frame[0, 1] * d[0] + frame[1, 1] * d[1] + frame[2, 1] * d[2],
        frame[0, 2] * d[0] + frame[1, 2] * d[1] + frame[2, 2] * d[2],
    )


@kernel()
def _unit(x: float, y: float, z: float) -> Triple:
    """Scaled to length one."""
    scale = 1.0 / math.sqrt(max(x * x + y * y + z * z, 1e-20))
    return x * scale, y * scale, z * scale


@kernel()
def _sign(x: float) -> float:
    """Sign that counts zero as positive."""
    return 1.0 if x >= 0.0 else -1.0
