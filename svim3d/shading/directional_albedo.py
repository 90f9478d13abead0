"""How much light a specular lobe reflects towards the viewer when lit evenly from everywhere.

The single-bounce albedo is F0 A + B, with (A, B) from a table that is integrated at first use; the
rest of the energy bounces between microfacets until it leaves.

Source: Karis 2013, "Real shading in Unreal Engine 4"; Fdez-Aguera 2019, "A multiple-scattering
microfacet model for real-time image-based lighting".
"""

import functools
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from svim3d.numerics import dot, reflect
from svim3d.shading.dominant_lobe import bend_table
from svim3d.shading.microfacet import (
    alpha_from_roughness,
    sample_visible_normal,
    schlick_weight,
    smith_lambda,
)

# Light that bounces between microfacets: lost, returned as a broad lobe (Fdez-Aguera), or returned
# in the shape of the first bounce ("scaled", Turquin).
MultipleScattering = bool | Literal["scaled"]
TABLE_SIZE = 64  # entries per side
AZIMUTHS, ELEVATIONS = 20, 40  # quadrature points of one entry: error below 1e-3
MIN_N_DOT_V = 1e-3  # a normal that faces away is shaded as if seen at grazing incidence
SCHLICK_MEAN_WEIGHT = 1.0 / 21.0  # cosine-weighted mean of (1 - cos)^5


@functools.lru_cache(maxsize=8)
def split_sum_table(device: torch.device, dtype: torch.dtype) -> Float[Tensor, "r v 3"]:
    """The table of A, B and the lobe's bend.

    Rows: roughness, columns: sqrt(n.v), from 0 to 1, both ends included.

    The square root gives grazing angles, where smooth materials change fast, their resolution.
    """
    axis = torch.linspace(0.0, 1.0, TABLE_SIZE, dtype=torch.float64)[:, None]
    rows = [
        torch.cat(integrate_split_sum(axis * axis, roughness.expand_as(axis)), -1)
        for roughness in axis
    ]
    bend = bend_table(TABLE_SIZE)[..., None]
    return torch.cat([torch.stack(rows), bend], -1).to(device, dtype)


def integrate_split_sum(
    n_dot_v: Float[Tensor, "P 1"], roughness: Float[Tensor, "P 1"]
) -> tuple[Float[Tensor, "P 1"], Float[Tensor, "P 1"]]:
    """A and B such that F0 A + B is the lobe's directional albedo for any F0.

    Midpoint quadrature over visible normals, whose estimator is bounded by one:
    G2 / G1 = (1 + Lambda(v)) / (1 + Lambda(v) + Lambda(l)).
    """
    alpha = alpha_from_roughness(roughness)[:, None]
    n_dot_v = n_dot_v.clamp_min(MIN_N_DOT_V)[:, None]
    sine = (1.0 - n_dot_v * n_dot_v).clamp_min(0.0).sqrt()
    azimuth = (torch.arange(AZIMUTHS, dtype=n_dot_v.dtype) + 0.5) / (2 * AZIMUTHS)  # half a turn
    fraction = (torch.arange(ELEVATIONS, dtype=n_dot_v.dtype) + 0.5) / ELEVATIONS
    # The squared remainder puts points where visible normals lie flat and the integrand turns.
    elevation = 1.0 - (1.0 - fraction) ** 2
    jacobian = (2.0 * (1.0 - fraction)).repeat(AZIMUTHS)[None, :, None]
    u = torch.stack(torch.meshgrid(azimuth, elevation, indexing="ij"), -1).view(1, -1, 2)
    wo = torch.cat([sine, torch.zeros_like(sine), n_dot_v], -1).expand(-1, u.shape[1], -1)
    wh = sample_visible_normal(wo, alpha, u)
    wi = reflect(wo, wh)
    lambda_v, lambda_l = smith_lambda(n_dot_v, alpha), smith_lambda(wi[..., 2:], alpha)
    weight = jacobian * (1.0 + lambda_v) / (1.0 + lambda_v + lambda_l)
    weight = torch.where(wi[..., 2:] > 0, weight, 0.0)
    fresnel = schlick_weight(dot(wo, wh))
    return (weight * (1.0 - fresnel)).mean(1), (weight * fresnel).mean(1)


def lookup_split_sum(
    n_dot_v: Float[Tensor, "P 1"], roughness: Float[Tensor, "P 1"]
) -> tuple[Float[Tensor, "P 1"], Float[Tensor, "P 1"]]:
    """A and B from the table."""
    scale, bias, _ = lookup_table(n_dot_v, roughness).split(1, -1)
    return scale, bias


def lookup_table(
    n_dot_v: Float[Tensor, "P 1"], roughness: Float[Tensor, "P 1"]
) -> Float[Tensor, "P 3"]:
    """Bilinear (A, B, bend) from the table; differentiable in both arguments."""
    table = split_sum_table(n_dot_v.device, n_dot_v.dtype).view(-1, 3)
    x = n_dot_v.clamp(MIN_N_DOT_V, 1.0).sqrt() * (TABLE_SIZE - 1)
    y = roughness.clamp(0.0, 1.0) * (TABLE_SIZE - 1)
    x0 = x.detach().floor().clamp_max(TABLE_SIZE - 2)
    y0 = y.detach().floor().clamp_max(TABLE_SIZE - 2)
    fx, fy = x - x0, y - y0
    corner = (y0 * TABLE_SIZE + x0).long()[:, 0]
    low = table[corner] + fx * (table[corner + 1] - table[corner])
    above = corner + TABLE_SIZE
    high = table[above] + fx * (table[above + 1] - table[above])
    return low + fy * (high - low)


def lobe_albedos(
    f0: Float[Tensor, "P 3"],
    n_dot_v: Float[Tensor, "P 1"],
    roughness: Float[Tensor, "P 1"],
    *,
    multiple_scattering: MultipleScattering,
) -> tuple[Float[Tensor, "P 3"], Float[Tensor, "P 3"]]:
    """Directional albedos of the specular lobe: of one bounce, and of all further bounces.

    With f0 = 1 and either kind of multiple scattering they sum to one: the white furnace.

    Source: Fdez-Aguera 2019, eq. 13 to 19; "scaled": Turquin 2019, "Practical multiple scattering
    compensation for microfacet models": 1 + F0 (1 - E)/E. The first differs from its paper:
    F0 A + B takes plain F0; the listing's roughness-dependent Fresnel term counts the grazing
    reflection twice.
    """
    scale, bias = lookup_split_sum(n_dot_v, roughness)
    single = f0 * scale + bias
    escaped = 1.0 - (scale + bias)
    if multiple_scattering == "scaled":
        return single * (1.0 + f0 * escaped / (scale + bias)), torch.zeros_like(single)
    if not multiple_scattering:
        return single, torch.zeros_like(single)
    mean_fresnel = f0 + (1.0 - f0) * SCHLICK_MEAN_WEIGHT
    return single, escaped * single * mean_fresnel / (1.0 - mean_fresnel * escaped)
