"""Compiled kernels of split-sum shading: one pass forward, one backward, over a batch of points.

The arithmetic of `split_sum.shade_plainly`, scalar by scalar in double precision. The backward pass
repeats the forward arithmetic instead of storing it; in it, `g_x` is the derivative of the loss by
`x`. All kernels live in this file, because numba's cache watches only the file of the caller.
"""

import math
from typing import Any

import numba
from numpy.typing import NDArray

from svim3d.compiled import kernel
from svim3d.shading.directional_albedo import MIN_N_DOT_V, SCHLICK_MEAN_WEIGHT, TABLE_SIZE
from svim3d.shading.metallic_roughness import DIELECTRIC_F0
from svim3d.shading.octahedral import MIN_L1_NORM

OFF, BROAD, SCALED = 0, 1, 2  # what becomes of light that bounces between microfacets
Array = NDArray[Any]
Points = tuple[Array, Array, Array, Array, Array]  # normal, view, base colour, roughness, metallic
Pyramid = tuple[Array, Array, Array, Array]  # texels, roughness knots, sizes and offsets of levels
Triple = tuple[float, float, float]
Taps = tuple[int, int, int, int, float, float]


@kernel(parallel=True)
def shade_forward(
    points: Points,
    pyramid: Pyramid,
    table: Array,
    bounces: int,
    shaded: tuple[Array, Array],
) -> None:
    """Write diffuse and specular radiance; one point per iteration."""
    normal, wo, basecolor, roughness, metallic = points
    texels, knots, sizes, offsets = pyramid
    diffuse, specular = shaded
    last = len(knots)
    for p in numba.prange(len(normal)):
        r, m = float(roughness[p, 0]), float(metallic[p, 0])
        raw = _dot(normal[p], wo[p])
        (scale, bias, bend), _, _ = _table_lookup(table, raw, r)
        dx, dy, dz = _direction(normal[p], wo[p], raw, bend)
        level, fraction, _ = _level(knots, r)
        sharp = _locate(dx, dy, dz, sizes[level])
        blurred = _locate(dx, dy, dz, sizes[level + 1])
        around = _locate(normal[p, 0], normal[p, 1], normal[p, 2], sizes[last])
        for c in range(3):
            low, _, _ = _fetch(texels, offsets[level], sharp, sizes[level], c)
            high, _, _ = _fetch(texels, offsets[level + 1], blurred, sizes[level + 1], c)
            irradiance, _, _ = _fetch(texels, offsets[last], around, sizes[last], c)
            radiance = low + fraction * (high - low)
            f0 = DIELECTRIC_F0 * (1.0 - m) + basecolor[p, c] * m
            single = f0 * scale + bias
            multiple = _further(f0, single, scale + bias) if bounces == BROAD else 0.0
            if bounces == SCALED:
                single *= 1.0 + f0 * (1.0 - scale - bias) / (scale + bias)
            albedo = basecolor[p, c] * (1.0 - m)
            diffuse[p, c] = albedo * (1.0 - single - multiple) * irradiance
            specular[p, c] = single * radiance + multiple * irradiance


@kernel(parallel=True)
def shade_backward(
    points: Points,
    pyramid: Pyramid,
    table: Array,
    bounces: int,
    upstream: tuple[Array, Array],
    gradients: Points,
    grad_texels: Array,
) -> None:
    """Write the derivatives by the points; add those by the texels, one copy per chunk."""
    normal, wo, basecolor, roughness, metallic = points
    texels, knots, sizes, offsets = pyramid
    grad_diffuse, grad_specular = upstream
    grad_normal, grad_wo, grad_basecolor, grad_roughness, grad_metallic = gradients
    count, chunks, last = len(normal), len(grad_texels), len(knots)
    for chunk in numba.prange(chunks):
        for p in range(chunk * count // chunks, (chunk + 1) * count // chunks):
            r, m = float(roughness[p, 0]), float(metallic[p, 0])
            raw = _dot(normal[p], wo[p])
            (scale, bias, bend), along_v, along_r = _table_lookup(table, raw, r)
            dx, dy, dz = _direction(normal[p], wo[p], raw, bend)
            level, fraction, slope = _level(knots, r)
            sharp = _locate(dx, dy, dz, sizes[level])
            blurred = _locate(dx, dy, dz, sizes[level + 1])
            around = _locate(normal[p, 0], normal[p, 1], normal[p, 2], sizes[last])
            g_scale, g_bias, g_fraction, g_m = 0.0, 0.0, 0.0, 0.0
            g_u, g_v, g_around_u, g_around_v = 0.0, 0.0, 0.0, 0.0
            for c in range(3):
                low, low_u, low_v = _fetch(texels, offsets[level], sharp, sizes[level], c)
                high, high_u, high_v = _fetch(
                    texels, offsets[level + 1], blurred, sizes[level + 1], c
                )
                irradiance, around_u, around_v = _fetch(
                    texels, offsets[last], around, sizes[last], c
                )
                light = (low + fraction * (high - low), irradiance, fraction)
                g_shaded = (grad_diffuse[p, c], grad_specular[p, c])
                g_low, g_high, g_irradiance, g_base, g_metal, g_a, g_b = _channel_adjoint(
                    basecolor[p, c], m, (scale, bias), bounces, light, g_shaded
                )
                grad_basecolor[p, c] = g_base
                g_m, g_scale, g_bias = g_m + g_metal, g_scale + g_a, g_bias + g_b
                g_fraction += (g_low + g_high) * (high - low)
                g_u += g_low * low_u + g_high * high_u
                g_v += g_low * low_v + g_high * high_v
                g_around_u += g_irradiance * around_u
                g_around_v += g_irradiance * around_v
                if grad_texels.shape[1] > 0:
                    _scatter(grad_texels[chunk], offsets[level], sharp, c, g_low)
                    _scatter(grad_texels[chunk], offsets[level + 1], blurred, c, g_high)
                    _scatter(grad_texels[chunk], offsets[last], around, c, g_irradiance)
            g_direction = _square_adjoint(dx, dy, dz, g_u, g_v)
            nx, ny, nz = normal[p, 0], normal[p, 1], normal[p, 2]
            g_around = _square_adjoint(nx, ny, nz, g_around_u, g_around_v)
            g_bend = _bend_adjoint(normal[p], wo[p], raw, g_direction)
            g_table = (g_scale, g_bias, g_bend)
            g_dot = _inner(g_table, along_v)
            grad_roughness[p, 0] = _inner(g_table, along_r) + g_fraction * slope
            to = (grad_normal[p], grad_wo[p])
            _direction_adjoint(normal[p], wo[p], raw, bend, g_direction, g_around, g_dot, to)
            grad_metallic[p, 0] = g_m


@kernel()
def _further(f0: float, single: float, evenly_lit: float) -> float:
    """Albedo of all bounces after the first; see `directional_albedo.lobe_albedos`."""
    escaped = 1.0 - evenly_lit
    mean = f0 + (1.0 - f0) * SCHLICK_MEAN_WEIGHT
    return escaped * single * mean / (1.0 - mean * escaped)


@kernel()
def _channel_adjoint(
    base: float,
    m: float,
    table: tuple[float, float],
    bounces: int,
    light: Triple,
    g_shaded: tuple[float, float],
) -> tuple[float, float, float, float, float, float, float]:
    """Derivatives by both levels' radiance, irradiance, base colour, metallic, A and B.

    `light` holds prefiltered radiance, irradiance, and the fraction between the levels.
    """
    scale, bias = table
    radiance, irradiance, fraction = light
    g_diffuse, g_specular = g_shaded
    f0, albedo = DIELECTRIC_F0 * (1.0 - m) + base * m, base * (1.0 - m)
    first, multiple, gain, stretch = f0 * scale + bias, 0.0, 0.0, 1.0
    escaped = 1.0 - (scale + bias)
    lost = escaped / (scale + bias) if bounces == SCALED else 0.0
    mean = f0 + (1.0 - f0) * SCHLICK_MEAN_WEIGHT
    if bounces == BROAD:
        gain = 1.0 / (1.0 - mean * escaped)
        multiple = escaped * first * mean * gain
    stretch += f0 * lost
    single = first * stretch
    transmitted = 1.0 - single - multiple
    # Through the products to radiance, irradiance and the three shares.
    g_radiance = g_specular * single
    g_irradiance = g_specular * multiple + g_diffuse * albedo * transmitted
    g_albedo = g_diffuse * transmitted * irradiance
    g_multiple = (g_specular - g_diffuse * albedo) * irradiance
    g_single = g_specular * radiance - g_diffuse * albedo * irradiance
    # Through the geometric series of bounces; `gain` is zero without them.
    g_first = g_single * stretch + g_multiple * escaped * mean * gain
    g_escaped = g_multiple * first * mean * gain * gain
    g_mean = g_multiple * first * escaped * gain * gain
    g_f0 = g_first * scale + g_mean * (1.0 - SCHLICK_MEAN_WEIGHT)
    # Through the scale of the first bounce: lost = (1 - E) / E, so d lost / d escaped = 1 / E^2.
    g_f0 += g_single * first * lost
    if bounces == SCALED:
        g_escaped += g_single * first * f0 / ((scale + bias) * (scale + bias))
    return (
        g_radiance * (1.0 - fraction),
        g_radiance * fraction,
        g_irradiance,
        g_f0 * m + g_albedo * (1.0 - m),
        g_f0 * (base - DIELECTRIC_F0) - g_albedo * base,
        g_first * f0 - g_escaped,
        g_first - g_escaped,
    )


@kernel()
def _bend_adjoint(normal: Array, wo: Array, raw: float, g_direction: Triple) -> float:
    """Derivative by the bend: direction = mirror + bend (normal - mirror)."""
    g_bend = 0.0
    for k in range(3):
        g_bend += g_direction[k] * (normal[k] - (2.0 * raw * normal[k] - wo[k]))
    return g_bend


@kernel()
def _direction_adjoint(
    normal: Array,
    wo: Array,
    raw: float,
    bend: float,
    g_direction: Triple,
    g_around: Triple,
    g_dot: float,
    grads: tuple[Array, Array],
) -> None:
    """Write the derivatives by normal and view; mirror = 2 (n.v) n - v. `g_dot` is by n.v."""
    grad_normal, grad_wo = grads
    for k in range(3):
        g_dot += 2.0 * (1.0 - bend) * g_direction[k] * normal[k]
    for k in range(3):
        g_mirror = (1.0 - bend) * g_direction[k]
        g_straight = bend * g_direction[k] + 2.0 * raw * g_mirror
        grad_normal[k] = g_straight + g_around[k] + g_dot * wo[k]
        grad_wo[k] = g_dot * normal[k] - g_mirror


@kernel()
def _direction(normal: Array, wo: Array, raw: float, bend: float) -> Triple:
    """The dominant direction, not unit; see `dominant_lobe.dominant_direction`."""
    against = 1.0 - bend
    straight = 2.0 * raw * against + bend
    return (
        straight * normal[0] - against * wo[0],
        straight * normal[1] - against * wo[1],
        straight * normal[2] - against * wo[2],
    )


@kernel()
def _dot(a: Array, b: Array) -> float:
    """Inner product in double precision."""
    product: float = float(a[0]) * b[0] + float(a[1]) * b[1] + float(a[2]) * b[2]
    return product


@kernel()
def _inner(a: Triple, b: Triple) -> float:
    """Inner product of triples."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@kernel()
def _table_lookup(table: Array, raw: float, r: float) -> tuple[Triple, Triple, Triple]:
    """(A, B, bend), and their derivatives by n.v, which is brought within its bounds, and by r."""
    root, span = math.sqrt(min(max(raw, MIN_N_DOT_V), 1.0)), TABLE_SIZE - 1
    x, y = root * span, min(max(r, 0.0), 1.0) * span
    # Bounded from below too: a NaN must come out as NaN, not as a read outside the table.
    x0, y0 = max(0, min(int(x), TABLE_SIZE - 2)), max(0, min(int(y), TABLE_SIZE - 2))
    at = (x0, y0, x - x0, y - y0)
    per_x = span / (2.0 * root) if MIN_N_DOT_V <= raw <= 1.0 else 0.0
    per_y = float(span) if 0.0 <= r <= 1.0 else 0.0
    a, a_v, a_r = _table_channel(table, at, 0)
    b, b_v, b_r = _table_channel(table, at, 1)
    bend, bend_v, bend_r = _table_channel(table, at, 2)
    return (
        (a, b, bend),
        (a_v * per_x, b_v * per_x, bend_v * per_x),
        (a_r * per_y, b_r * per_y, bend_r * per_y),
    )


@kernel()
def _table_channel(table: Array, at: tuple[int, int, float, float], c: int) -> Triple:
    """One bilinear value, and its derivatives per column and per row."""
    x0, y0, fx, fy = at
    below = table[y0, x0 + 1, c] - table[y0, x0, c]
    above = table[y0 + 1, x0 + 1, c] - table[y0 + 1, x0, c]
    low, high = table[y0, x0, c] + fx * below, table[y0 + 1, x0, c] + fx * above
    return low + fy * (high - low), below + fy * (above - below), high - low


@kernel()
def _level(knots: Array, r: float) -> tuple[int, float, float]:
    """Level below a roughness, fraction towards the next, and its derivative by roughness."""
    level = 0
    while level < len(knots) - 2 and r >= knots[level + 1]:
        level += 1
    slope = 1.0 / (float(knots[level + 1]) - knots[level])
    fraction = (r - knots[level]) * slope
    if fraction < 0.0 or fraction > 1.0:
        return level, min(max(fraction, 0.0), 1.0), 0.0
    return level, fraction, slope


@kernel()
def _locate(x: float, y: float, z: float, size: int) -> Taps:
    """Four texels around a direction and the position between them."""
    norm = max(abs(x) + abs(y) + abs(z), MIN_L1_NORM)
    u, v = x / norm, z / norm
    if y < 0.0:
        u, v = (1.0 - abs(v)) * _sign(u), (1.0 - abs(u)) * _sign(v)
    column, row = (u * 0.5 + 0.5) * size - 0.5, (v * 0.5 + 0.5) * size - 0.5
    j, i = math.floor(column), math.floor(row)
    return (
        _wrap(i, j, size),
        _wrap(i, j + 1, size),
        _wrap(i + 1, j, size),
        _wrap(i + 1, j + 1, size),
        column - j,
        row - i,
    )


@kernel()
def _sign(x: float) -> float:
    """Sign that counts zero as positive."""
    return 1.0 if x >= 0.0 else -1.0


@kernel()
def _wrap(i: int, j: int, size: int) -> int:
    """Flat index of a texel at most one beyond the square; see `octahedral.bilinear_taps`."""
    if j < 0 or j >= size:
        i, j = size - 1 - i, min(max(j, 0), size - 1)
    if i < 0 or i >= size:
        j, i = size - 1 - j, min(max(i, 0), size - 1)
    return i * size + j


@kernel()
def _fetch(texels: Array, offset: int, taps: Taps, size: int, c: int) -> Triple:
    """Bilinear value and its derivatives by the square coordinates u and v."""
    a, b = texels[offset + taps[0], c], texels[offset + taps[1], c]
    d, e = texels[offset + taps[2], c], texels[offset + taps[3], c]
    fx, fy, per_texel = taps[4], taps[5], 0.5 * size
    top, bottom = a * (1.0 - fx) + b * fx, d * (1.0 - fx) + e * fx
    along_u = (b - a) * (1.0 - fy) + (e - d) * fy
    return top * (1.0 - fy) + bottom * fy, along_u * per_texel, (bottom - top) * per_texel


@kernel()
def _scatter(grad: Array, offset: int, taps: Taps, c: int, value: float) -> None:
    """Adjoint of `_fetch`."""
    fx, fy = taps[4], taps[5]
    grad[offset + taps[0], c] += (1.0 - fx) * (1.0 - fy) * value
    grad[offset + taps[1], c] += fx * (1.0 - fy) * value
    grad[offset + taps[2], c] += (1.0 - fx) * fy * value
    grad[offset + taps[3], c] += fx * fy * value


@kernel()
def _square_adjoint(x: float, y: float, z: float, g_u: float, g_v: float) -> Triple:
    """Derivative by the direction, given those by its square coordinates."""
    norm = max(abs(x) + abs(y) + abs(z), MIN_L1_NORM)
    a, b = x / norm, z / norm
    g_a, g_b = g_u, g_v
    if y < 0.0:
        g_a, g_b = -g_v * _sign(a) * _sign(b), -g_u * _sign(a) * _sign(b)
    shared = (g_a * a + g_b * b) / norm
    return (
        g_a / norm - shared * _sign(x),
        -shared * _sign(y),
        g_b / norm - shared * _sign(z),
    )
