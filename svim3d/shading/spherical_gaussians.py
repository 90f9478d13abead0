"""White light of a few spherical Gaussians: the baseline that an environment map is held against.

A lobe is G(x) = a exp(s (mu.x - 1)) with axis mu, sharpness s and amplitude a. It is kept as one
row of five numbers that any step of an optimiser leaves valid: the axis, of any length, log s and
log a. The sum of all lobes is a map like any other, so that it is prefiltered and shaded as one.

Source: Voleti et al. 2024 (SV3D), section 4, and Boss et al. 2024 (SF3D), which light objects by 24
such lobes; Wang et al. 2009, "All-frequency rendering of dynamic, spatially-varying reflectance".
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from svim3d.numerics import normalize
from svim3d.shading.octahedral import texel_directions

LOBES = 24  # Source: SV3D, section 4
GOLDEN_ANGLE = math.pi * (3.0 - math.sqrt(5.0))  # between neighbours of a Fibonacci lattice


def lobes_over_sphere(count: int, radiance: Float[Tensor, ""]) -> Float[Tensor, "count 5"]:
    """Lobes spread evenly whose sum is about even and has this mean radiance.

    The sharpness, half the number of lobes, gives each an integral of a 4 pi / count.
    """
    place = torch.arange(count).to(radiance)
    height = 1.0 - (2.0 * place + 1.0) / count
    azimuth = GOLDEN_ANGLE * place
    radius = (1.0 - height.square()).sqrt()
    axis = torch.stack([radius * azimuth.cos(), height, radius * azimuth.sin()], 1)
    sharpness = torch.full_like(place, 0.5 * count)
    each = 4.0 * math.pi * radiance / count
    amplitude = each / lobe_integral(torch.ones_like(place), sharpness)
    return torch.cat([axis, sharpness.log()[:, None], amplitude.log()[:, None]], 1)


def lobe_integral(
    amplitude: Float[Tensor, "*batch"], sharpness: Float[Tensor, "*batch"]
) -> Float[Tensor, "*batch"]:
    """Integral over the sphere: 2 pi a (1 - exp(-2 s)) / s."""
    return -2.0 * math.pi * amplitude * torch.expm1(-2.0 * sharpness) / sharpness


def log_radiance(
    lobes: Float[Tensor, "K 5"], directions: Float[Tensor, "*batch 3"]
) -> Float[Tensor, "*batch 1"]:
    """Logarithm of the sum of all lobes in unit directions; finite however far the lobes are."""
    cosine = directions @ normalize(lobes[:, :3]).T
    exponent = lobes[:, 4] + lobes[:, 3].exp() * (cosine - 1.0)
    return torch.logsumexp(exponent, -1, keepdim=True)


def log_octahedral(lobes: Float[Tensor, "K 5"], size: int) -> Float[Tensor, "size size 3"]:
    """The same at the texels of an octahedral map, grey."""
    return log_radiance(lobes, texel_directions(size, lobes)).expand(-1, -1, 3)
