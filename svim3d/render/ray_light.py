"""Light along stored rays: what a lobe would receive, and what of it comes from the environment."""

import math
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numba import prange
from numpy.typing import NDArray
from torch import Tensor

from svim3d.compiled import kernel
from svim3d.render.screen_visibility import LobeRays
from svim3d.shading.octahedral import octahedral_from_direction
from svim3d.shading.prefilter import EnvironmentPyramid

Light = Float[Tensor, "P 3"]


def lobe_light(
    rays: LobeRays, pyramid: EnvironmentPyramid, *, azimuth_deg: float
) -> tuple[Light, Light]:
    """Weighted radiance of all rays as if nothing were in their way, and of the free ones alone.

    Every ray reads one texel of the level nearest to its blur. Pixels whose rays are all free get
    zeros in both: the caller needs only how the two compare.

    Args:
        rays: of P pixels, from one view.
        pyramid: of the unturned light.
        azimuth_deg: how far the light is turned, counter-clockwise seen from above.
    """
    every = torch.zeros_like(rays.direction[:, 0])
    free = torch.zeros_like(every)
    angle = math.radians(azimuth_deg)
    _light(
        _rays(rays),
        (math.cos(angle), math.sin(angle)),
        pyramid.texels.detach().contiguous().numpy(),
        _layout(pyramid),
        (every.numpy(), free.numpy()),
    )
    return every, free


def lobe_light_plainly(
    rays: LobeRays, pyramid: EnvironmentPyramid, *, azimuth_deg: float
) -> tuple[Light, Light]:
    """`lobe_light` in plain tensor operations: the twin of the compiled kernel."""
    knots, sizes, offsets = (torch.from_numpy(part) for part in _layout(pyramid))
    level = (rays.blur[..., None] - knots).abs().argmin(-1)
    uv = octahedral_from_direction(turn_about_y(rays.direction, -azimuth_deg))
    size = sizes[level]
    column, row = (
        ((uv * 0.5 + 0.5) * size[..., None]).long().minimum(size[..., None] - 1).unbind(-1)
    )
    radiance = pyramid.texels[offsets[level] + row * size + column]
    weighted = radiance * rays.weight[..., None] * (rays.hit >= 0).any(-1)[:, None, None]
    return weighted.sum(1), (weighted * (rays.hit < 0)[..., None]).sum(1)


def gather_hits(rays: LobeRays, radiance: Light) -> Light:
    """Weighted radiance of the pixels that rays meet; zero for free rays."""
    gathered = torch.empty_like(radiance)
    _gather(rays.hit.numpy(), rays.weight.numpy(), radiance.contiguous().numpy(), gathered.numpy())
    return gathered


def gather_hits_plainly(rays: LobeRays, radiance: Light) -> Light:
    """`gather_hits` in plain tensor operations: the twin of the compiled kernel."""
    met = radiance[rays.hit.clamp_min(0).long()] * rays.weight[..., None]
    return (met * (rays.hit >= 0)[..., None]).sum(1)


def turn_about_y(d: Float[Tensor, "*batch 3"], azimuth_deg: float) -> Float[Tensor, "*batch 3"]:
    """Turn directions counter-clockwise seen from above: +z becomes +x after 90 degrees."""
    angle = math.radians(azimuth_deg)
    cosine, sine = math.cos(angle), math.sin(angle)
    x, y, z = d.unbind(-1)
    return torch.stack([cosine * x + sine * z, y, cosine * z - sine * x], -1)


def _rays(rays: LobeRays) -> Any:
    fields = (rays.direction, rays.weight, rays.blur, rays.hit)
    return tuple(field.contiguous().numpy() for field in fields)


def _layout(pyramid: EnvironmentPyramid) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Roughness, side and first texel of each level."""
    layout = pyramid.layout
    return (
        np.array(layout.roughness, np.float32),
        np.array(layout.sizes),
        np.array(layout.offsets),
    )


@kernel(parallel=True)
def _light(rays: Any, turn: Any, texels: NDArray[Any], layout: Any, out: Any) -> None:
    direction, weight, blur, hit = rays
    knots, sizes, offsets = layout
    cosine, sine = turn
    every, free = out
    for p in prange(direction.shape[0]):
        blocked = False
        for k in range(direction.shape[1]):
            blocked = blocked or hit[p, k] >= 0
        if not blocked:
            continue
        for k in range(direction.shape[1]):
            level = 0
            while level + 1 < len(knots) and knots[level] + knots[level + 1] < 2.0 * blur[p, k]:
                level += 1
            x = cosine * direction[p, k, 0] - sine * direction[p, k, 2]
            y = direction[p, k, 1]
            z = sine * direction[p, k, 0] + cosine * direction[p, k, 2]
            scale = 1.0 / (abs(x) + abs(y) + abs(z))
            u, v = x * scale, z * scale
            if y < 0.0:
                folded = (1.0 - abs(v)) * (1.0 if u >= 0.0 else -1.0)
                v = (1.0 - abs(u)) * (1.0 if v >= 0.0 else -1.0)
                u = folded
            size = sizes[level]
            column = min(int((u * 0.5 + 0.5) * size), size - 1)
            row = min(int((v * 0.5 + 0.5) * size), size - 1)
            texel = offsets[level] + row * size + column
            for c in range(3):
                light = texels[texel, c] * weight[p, k]
                every[p, c] += light
                if hit[p, k] < 0:
                    free[p, c] += light


@kernel(parallel=True)
def _gather(
    hit: NDArray[np.int32], weight: NDArray[Any], radiance: NDArray[Any], gathered: NDArray[Any]
) -> None:
    for p in prange(hit.shape[0]):
        red, green, blue = 0.0, 0.0, 0.0
        for k in range(hit.shape[1]):
            other = hit[p, k]
            if other >= 0:
                red += weight[p, k] * radiance[other, 0]
                green += weight[p, k] * radiance[other, 1]
                blue += weight[p, k] * radiance[other, 2]
        gathered[p, 0], gathered[p, 1], gathered[p, 2] = red, green, blue
