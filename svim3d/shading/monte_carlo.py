"""Unbiased shading by sampling: the reference that every approximation is tested against.

Same material as `split_sum` without multiple scattering: a GGX lobe with height-correlated Smith
masking over a diffuse base that receives what the lobe does not reflect towards the viewer.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from svim3d.numerics import dot, normalize, reflect
from svim3d.shading.directional_albedo import MIN_N_DOT_V, lobe_albedos
from svim3d.shading.lobe_sampling import tangent_frame
from svim3d.shading.metallic_roughness import diffuse_albedo, specular_f0
from svim3d.shading.microfacet import (
    alpha_from_roughness,
    distribution_ggx,
    fresnel_schlick,
    masking_shadowing,
    sample_visible_normal,
    visible_normal_density,
)
from svim3d.shading.octahedral import sample_octahedral
from svim3d.shading.split_sum import Shading

MIN_DENSITY = 1e-12  # of a light direction; below it the direction's weight is zero


def specular_brdf(
    n_dot_wo: Float[Tensor, "*batch 1"],
    n_dot_wi: Float[Tensor, "*batch 1"],
    n_dot_wh: Float[Tensor, "*batch 1"],
    wo_dot_wh: Float[Tensor, "*batch 1"],
    f0: Float[Tensor, "*batch 3"],
    alpha: Float[Tensor, "*batch 1"],
) -> Float[Tensor, "*batch 3"]:
    """Cook-Torrance reflectance F D G2 / (4 n.wo n.wi), for both cosines above zero.

    Source: Walter et al. 2007, eq. 20.
    """
    geometry = masking_shadowing(n_dot_wo, n_dot_wi, alpha) * distribution_ggx(n_dot_wh, alpha)
    return fresnel_schlick(f0, wo_dot_wh) * geometry / (4.0 * n_dot_wo * n_dot_wi)


def shade_by_sampling(
    normal: Float[Tensor, "P 3"],
    wo: Float[Tensor, "P 3"],
    basecolor: Float[Tensor, "P 3"],
    roughness: Float[Tensor, "P 1"],
    metallic: Float[Tensor, "P 1"],
    environment: Float[Tensor, "n n 3"],
    *,
    samples: int,
    generator: torch.Generator,
) -> Shading:
    """Radiance towards `wo` under an octahedral map, with `samples` light directions per point.

    Half of the directions follow visible normals, half the cosine; the balance heuristic joins
    them (Veach and Guibas 1995). Points must be seen from the front.
    """
    alpha = alpha_from_roughness(roughness)
    f0 = specular_f0(basecolor, metallic)
    n_dot_wo = dot(normal, wo).clamp_min(MIN_N_DOT_V)
    tangent, bitangent = tangent_frame(normal)
    frame = torch.stack([tangent, bitangent, normal], -2)
    wo_local = normalize((frame @ wo[..., None])[..., 0])
    single, _ = lobe_albedos(f0, n_dot_wo, roughness, multiple_scattering=False)
    base = diffuse_albedo(basecolor, metallic) * (1.0 - single) / math.pi
    diffuse, specular = torch.zeros_like(basecolor), torch.zeros_like(basecolor)
    for index in range(samples):
        u = torch.rand(len(normal), 2, generator=generator, dtype=normal.dtype).to(normal.device)
        if index % 2:
            wi = _cosine_direction(u)
        else:
            wi = reflect(wo_local, sample_visible_normal(wo_local, alpha, u))
        wh = normalize(wi + wo_local)
        n_dot_wi = wi[:, 2:]
        density = 0.5 * n_dot_wi.clamp_min(0.0) / math.pi
        density = density + 0.5 * visible_normal_density(n_dot_wo, wh[:, 2:], alpha)
        lit = n_dot_wi > 0
        cosine = torch.where(lit, n_dot_wi, 1.0)
        weight = torch.where(lit, cosine / density.clamp_min(MIN_DENSITY), 0.0) / samples
        world = (wi[:, None] @ frame)[:, 0]
        light = sample_octahedral(environment, world) * weight
        lobe = specular_brdf(n_dot_wo, cosine, wh[:, 2:], dot(wo_local, wh), f0, alpha)
        diffuse = diffuse + base * light
        specular = specular + lobe * light
    return Shading(diffuse, specular)


def _cosine_direction(u: Float[Tensor, "P 2"]) -> Float[Tensor, "P 3"]:
    """Cosine-distributed directions about +z."""
    sine, phi = u[:, :1].sqrt(), 2.0 * math.pi * u[:, 1:]
    return torch.cat([sine * phi.cos(), sine * phi.sin(), (1.0 - u[:, :1]).sqrt()], -1)
