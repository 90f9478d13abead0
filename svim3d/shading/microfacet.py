"""The GGX microfacet model: distribution, masking-shadowing, Fresnel, sampling.

`alpha` is the GGX width, roughness^2. All cosines are with the shading normal unless named
otherwise, and all directions leave the surface.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from svim3d.numerics import MIN_NORM_SQUARED, normalize, saturate

MIN_ALPHA = 1e-4  # keeps the distribution finite for a perfect mirror (roughness 0.01)


def alpha_from_roughness(roughness: Float[Tensor, "*#batch 1"]) -> Float[Tensor, "*#batch 1"]:
    """GGX width of a perceptual roughness. Source: Burley 2012, section 5.4."""
    return (roughness * roughness).clamp_min(MIN_ALPHA)


def distribution_ggx(
    n_dot_wh: Float[Tensor, "*#batch 1"], alpha: Float[Tensor, "*#batch 1"]
) -> Float[Tensor, "*#batch 1"]:
    """Density D of microfacet normals per solid angle. Source: Walter et al. 2007, eq. 33."""
    cosine_squared = n_dot_wh * n_dot_wh
    spread = alpha * alpha * cosine_squared + (1.0 - cosine_squared).clamp_min(0.0)
    return alpha * alpha / (math.pi * spread * spread)


def smith_lambda(
    n_dot_w: Float[Tensor, "*#batch 1"], alpha: Float[Tensor, "*#batch 1"]
) -> Float[Tensor, "*#batch 1"]:
    """Smith's Lambda: hidden over visible microfacet area. Source: Heitz 2014, eq. 72."""
    cosine_squared = (n_dot_w * n_dot_w).clamp_min(MIN_NORM_SQUARED)
    tangent_squared = (1.0 - cosine_squared).clamp_min(0.0) / cosine_squared
    return 0.5 * (torch.sqrt(1.0 + alpha * alpha * tangent_squared) - 1.0)


def masking_shadowing(
    n_dot_wo: Float[Tensor, "*#batch 1"],
    n_dot_wi: Float[Tensor, "*#batch 1"],
    alpha: Float[Tensor, "*#batch 1"],
) -> Float[Tensor, "*#batch 1"]:
    """Height-correlated Smith G2. Source: Heitz 2014, eq. 99."""
    return 1.0 / (1.0 + smith_lambda(n_dot_wo, alpha) + smith_lambda(n_dot_wi, alpha))


def fresnel_schlick(
    f0: Float[Tensor, "*#batch c"], wo_dot_wh: Float[Tensor, "*#batch 1"]
) -> Float[Tensor, "*#batch c"]:
    """Fresnel reflectance, Schlick's approximation. Source: Schlick 1994, eq. 15."""
    return f0 + (1.0 - f0) * schlick_weight(wo_dot_wh)


def schlick_weight(cosine: Float[Tensor, "*#batch 1"]) -> Float[Tensor, "*#batch 1"]:
    """(1 - cosine)^5."""
    remainder = saturate(1.0 - cosine)
    squared = remainder * remainder
    return squared * squared * remainder


def sample_visible_normal(
    wo_local: Float[Tensor, "*#batch 3"],
    alpha: Float[Tensor, "*#batch 1"],
    u: Float[Tensor, "*#batch 2"],
) -> Float[Tensor, "*#batch 3"]:
    """Half vectors from the distribution of normals visible from `wo_local` (z is the normal).

    Source: Dupuy and Benyoub 2023, "Sampling visible GGX normals with spherical caps", listing 3.
    """
    stretched = normalize(torch.cat([wo_local[..., :2] * alpha, wo_local[..., 2:]], -1))
    phi = 2.0 * math.pi * u[..., :1]
    z = (1.0 - u[..., 1:]) * (1.0 + stretched[..., 2:]) - stretched[..., 2:]
    sine = torch.sqrt((1.0 - z * z).clamp_min(0.0))
    cap = torch.cat([sine * phi.cos(), sine * phi.sin(), z], -1)
    half = cap + stretched
    return normalize(torch.cat([half[..., :2] * alpha, half[..., 2:].clamp_min(0.0)], -1))


def visible_normal_density(
    n_dot_wo: Float[Tensor, "*#batch 1"],
    n_dot_wh: Float[Tensor, "*#batch 1"],
    alpha: Float[Tensor, "*#batch 1"],
) -> Float[Tensor, "*#batch 1"]:
    """Density per solid angle of the light direction that a visible normal reflects to.

    D_v(h) / (4 wo.h) = G1(wo) D(h) / (4 n.wo). Source: Heitz 2018, eq. 3 and 17.
    """
    g1 = 1.0 / (1.0 + smith_lambda(n_dot_wo, alpha))
    return g1 * distribution_ggx(n_dot_wh, alpha) / (4.0 * n_dot_wo)
