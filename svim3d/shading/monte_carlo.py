"""Unbiased shading by sampling: the reference that every approximation is tested against.

Same material as `split_sum` without multiple scattering: a GGX lobe with height-correlated Smith
masking over a diffuse base that receives what the lobe does not reflect towards the viewer.

Light directions come from three strategies, each good where the others fail: visible normals for
glossy lobes, the cosine for the diffuse base, the environment's bright texels for hard lamps. The
balance heuristic joins them. Source: Veach and Guibas 1995, "Optimally combining sampling
techniques for Monte Carlo rendering".
"""

import math
from dataclasses import dataclass
from typing import Self

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
from svim3d.shading.monte_carlo_kernel import MIN_DENSITY, gather_light
from svim3d.shading.octahedral import sample_octahedral
from svim3d.shading.sampled_light import SampledLight, padded
from svim3d.shading.split_sum import Shading

CHUNK_SAMPLES = 1 << 18  # light directions held in memory at a time
CUBE_RATIO = 1.2207440846057596  # root of x^4 = x + 1


def specular_brdf(
    n_dot_wo: Float[Tensor, "*#batch 1"],
    n_dot_wi: Float[Tensor, "*#batch 1"],
    n_dot_wh: Float[Tensor, "*#batch 1"],
    wo_dot_wh: Float[Tensor, "*#batch 1"],
    f0: Float[Tensor, "*#batch 3"],
    alpha: Float[Tensor, "*#batch 1"],
) -> Float[Tensor, "*#batch 3"]:
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
    light: SampledLight,
    *,
    samples: int,
    generator: torch.Generator,
) -> Shading:
    """Radiance towards `wo`, with `samples` light directions per point; not differentiable.

    Computed in double precision whatever the inputs are. Points must be seen from the front.

    Args:
        normal: unit shading normals, world frame.
        wo: unit directions to the viewer, world frame.
        basecolor: linear Rec.709 in [0, 1].
        roughness: perceptual, in [0, 1].
        metallic: in [0, 1].
        light: the environment, in the same frame.
        samples: light directions per point; the error falls with the square root.
        generator: of the CPU, so that the result is the same on every device.
    """
    if samples < 1:
        raise ValueError(f"shading needs at least one sample per point, got {samples}")
    counts = strategy_counts(samples)
    gather = gather_compiled if normal.device.type == "cpu" else gather_plainly
    diffuse, specular = [], []
    with torch.no_grad():
        for points in zip(
            *(
                torch.split(t.detach().double(), max(1, CHUNK_SAMPLES // samples))
                for t in (normal, wo, basecolor, roughness, metallic)
            ),
            strict=True,
        ):
            count = len(points[0])
            shift = torch.rand(count, 1, 3, generator=generator, dtype=torch.float64)
            u = (shift + low_discrepancy_points(samples)) % 1.0
            surface = Surface.build(*points)
            irradiance, reflected = gather(surface, light, counts, u.to(normal.device))
            diffuse.append(surface.base * irradiance)
            specular.append(reflected)
    return Shading(torch.cat(diffuse).to(normal), torch.cat(specular).to(normal))


def low_discrepancy_points(samples: int) -> Float[Tensor, "S 3"]:
    """Points that fill the unit cube evenly, and so do any that follow each other.

    A random shift per surface point makes every one of them uniform: the estimate stays unbiased.

    Source: Roberts 2018, "The unreasonable effectiveness of quasirandom sequences", R3.
    """
    steps = CUBE_RATIO ** -torch.arange(1, 4, dtype=torch.float64)
    return (torch.arange(samples, dtype=torch.float64)[:, None] * steps) % 1.0


def strategy_counts(samples: int) -> tuple[int, int, int]:
    """Samples from the light, from the cosine, and from visible normals: a third each.

    Half from the light would cut the variance by 1.6 under a hard sun, and raise it by 1.3 for
    glossy lobes under a soft sky.
    """
    third = samples // 3
    return third, third, samples - 2 * third


@dataclass(frozen=True)
class Surface:
    """Points to be shaded by sampling, each in its own frame whose z is the normal.

    Attributes:
        frame: rows tangent, bitangent and normal, in the world.
        wo: unit direction to the viewer, in that frame, above the horizon.
        base: reflectance of the diffuse base per steradian.
        f0: specular reflectance at normal incidence.
        alpha: GGX width.
    """

    frame: Float[Tensor, "P 3 3"]
    wo: Float[Tensor, "P 3"]
    base: Float[Tensor, "P 3"]
    f0: Float[Tensor, "P 3"]
    alpha: Float[Tensor, "P 1"]

    @classmethod
    def build(
        cls,
        normal: Float[Tensor, "P 3"],
        wo: Float[Tensor, "P 3"],
        basecolor: Float[Tensor, "P 3"],
        roughness: Float[Tensor, "P 1"],
        metallic: Float[Tensor, "P 1"],
    ) -> Self:
        """Arguments as in `shade_by_sampling`."""
        tangent, bitangent = tangent_frame(normal)
        frame = torch.stack([tangent, bitangent, normal], -2)
        local = (frame @ wo[..., None])[..., 0]
        local = normalize(torch.cat([local[:, :2], local[:, 2:].clamp_min(MIN_N_DOT_V)], -1))
        f0 = specular_f0(basecolor, metallic)
        single, _ = lobe_albedos(f0, local[:, 2:], roughness, multiple_scattering=False)
        base = diffuse_albedo(basecolor, metallic) * (1.0 - single) / math.pi
        return cls(frame, local, base, f0, alpha_from_roughness(roughness))


def gather_compiled(
    surface: Surface,
    light: SampledLight,
    counts: tuple[int, int, int],
    u: Float[Tensor, "P S 3"],
) -> tuple[Float[Tensor, "P 3"], Float[Tensor, "P 3"]]:
    """`gather_plainly` by the compiled kernel, on the CPU."""
    irradiance, reflected = torch.empty_like(surface.f0), torch.empty_like(surface.f0)
    gather_light(
        (
            surface.frame.numpy(),
            surface.wo.numpy(),
            surface.f0.numpy(),
            surface.alpha.numpy(),
        ),
        (padded(light.radiance).numpy(), light.cumulative.numpy(), light.density.numpy()),
        counts,
        u.numpy(),
        (irradiance.numpy(), reflected.numpy()),
    )
    return irradiance, reflected


def gather_plainly(
    surface: Surface,
    light: SampledLight,
    counts: tuple[int, int, int],
    u: Float[Tensor, "P S 3"],
) -> tuple[Float[Tensor, "P 3"], Float[Tensor, "P 3"]]:
    """Estimates of irradiance and of specular radiance from uniform numbers in [0, 1).

    In plain tensor operations, for any device: the twin of the compiled kernel.
    """
    samples = sum(counts)
    frame, alpha = surface.frame, surface.alpha[:, None]
    wo = surface.wo[:, None].expand(-1, samples, -1)
    from_light, from_cosine, from_lobe = u.split(counts, 1)
    viewed = wo[:, : counts[2]]
    wi = torch.cat(
        [
            light.sample(from_light) @ frame.mT,
            _cosine_direction(from_cosine),
            reflect(viewed, sample_visible_normal(viewed, alpha, from_lobe[..., :2])),
        ],
        1,
    )
    world, wh, n_dot_wi = wi @ frame, normalize(wi + wo), wi[..., 2:]
    # The balance heuristic weighs every sample by the density of the whole mixture.
    density = (
        counts[0] * light.density_towards(world)
        + counts[1] * n_dot_wi / math.pi
        + counts[2] * visible_normal_density(wo[..., 2:], wh[..., 2:], alpha)
    ) / samples
    lit = n_dot_wi > 0.0
    cosine = torch.where(lit, n_dot_wi, 1.0)
    weight = torch.where(lit, cosine / density.clamp_min(MIN_DENSITY), 0.0) / samples
    incoming = sample_octahedral(light.radiance, world.reshape(-1, 3)).view_as(wi) * weight
    f0 = surface.f0[:, None]
    lobe = specular_brdf(wo[..., 2:], cosine, wh[..., 2:], dot(wo, wh), f0, alpha)
    return incoming.sum(1), (lobe * incoming).sum(1)


def _cosine_direction(u: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """Cosine-distributed directions about +z, from the first two of three numbers."""
    sine, phi = u[..., :1].sqrt(), 2.0 * math.pi * u[..., 1:2]
    return torch.cat([sine * phi.cos(), sine * phi.sin(), (1.0 - u[..., :1]).sqrt()], -1)
