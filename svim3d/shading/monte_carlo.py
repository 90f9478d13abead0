"""Unbiased shading by sampling: the reference that every approximation is tested against.

Same material as `split_sum` without multiple scattering: a GGX lobe with height-correlated Smith
masking over a diffuse base that receives what the lobe does not reflect towards the viewer.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from typing import Self

import torch
from jaxtyping import Float, Int
from torch import Tensor

from svim3d.numerics import dot, normalize, reflect
from svim3d.shading.directional_albedo import MIN_N_DOT_V, lobe_albedos
from svim3d.shading.environment_sampling import SampledLight
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

MAX_RAYS = 1 << 18  # light directions held in memory at a time
R2_STEP = (0.7548776662466927, 0.5698402909980532)  # 1/g and 1/g^2, g^3 = g + 1

# From the index of a point and a unit world direction per ray, the share of light let through.
Visibility = Callable[[Int[Tensor, "R"], Float[Tensor, "R 3"]], Float[Tensor, "R 1"]]


class Technique(IntEnum):
    """What light directions are drawn in proportion to."""

    LOBE = 0
    COSINE = 1
    LIGHT = 2


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
    visibility: Visibility | None = None,
) -> Shading:
    """Radiance towards `wo`, with `samples` light directions per point.

    A third of the directions follow visible normals, a third the cosine, a third the light; the
    balance heuristic joins them (Veach and Guibas 1995). Each third is a low-discrepancy sequence
    with its own random shift per point. A point seen from behind is shaded as if at grazing view.

    Args:
        normal: unit shading normals, world frame.
        wo: unit directions to the viewer, world frame.
        basecolor: linear Rec.709 in [0, 1].
        roughness: perceptual, in [0, 1].
        metallic: in [0, 1].
        light: the environment, in the same frame.
        samples: light directions per point, at least 3.
        generator: source of the shifts, on the CPU; the result depends on nothing else.
        visibility: from the index of a point and a world direction for each ray, the share of
            light that comes through, in [0, 1].
    """
    if samples < len(Technique):
        raise ValueError(f"samples must be at least {len(Technique)}, got {samples}")
    shifts = torch.rand(len(normal), len(Technique), 2, generator=generator, dtype=torch.float64)
    chunk = max(1, MAX_RAYS // samples)
    parts = []
    for start in range(0, len(normal), chunk):
        rows = slice(start, start + chunk)
        surface = _Surface.build(*(t[rows] for t in (normal, wo, basecolor, roughness, metallic)))
        index = torch.arange(len(normal), device=normal.device)[rows]
        parts.append(_shade_chunk(surface, light, samples, shifts[rows], index, visibility))
    if not parts:
        return Shading(torch.zeros_like(basecolor), torch.zeros_like(basecolor))
    diffuse, specular = zip(*parts, strict=True)
    return Shading(torch.cat(diffuse), torch.cat(specular))


@dataclass(frozen=True)
class _Surface:
    """Points in their own frames, where z is the normal.

    Attributes:
        frame: rows tangent, bitangent, normal.
        wo: directions to the viewer.
        f0: specular reflectance at normal incidence.
        alpha: GGX width.
        base: reflectance of the diffuse base over pi, per unit cosine.
    """

    frame: Float[Tensor, "P 3 3"]
    wo: Float[Tensor, "P 3"]
    f0: Float[Tensor, "P 3"]
    alpha: Float[Tensor, "P 1"]
    base: Float[Tensor, "P 3"]

    @classmethod
    def build(
        cls, normal: Tensor, wo: Tensor, basecolor: Tensor, roughness: Tensor, metallic: Tensor
    ) -> Self:
        """Arguments as in `shade_by_sampling`."""
        frame = torch.stack([*tangent_frame(normal), normal], -2)
        local = (frame @ wo[..., None])[..., 0]
        local = normalize(torch.cat([local[:, :2], local[:, 2:].clamp_min(MIN_N_DOT_V)], -1))
        f0 = specular_f0(basecolor, metallic)
        single, _ = lobe_albedos(f0, local[:, 2:], roughness, multiple_scattering=False)
        base = diffuse_albedo(basecolor, metallic) * (1.0 - single) / math.pi
        return cls(frame, local, f0, alpha_from_roughness(roughness), base)


def _shade_chunk(
    surface: _Surface,
    light: SampledLight,
    samples: int,
    shifts: Float[Tensor, "P 3 2"],
    index: Int[Tensor, "P"],
    visibility: Visibility | None,
) -> tuple[Float[Tensor, "P 3"], Float[Tensor, "P 3"]]:
    """Diffuse and specular radiance of a few points, all directions at once."""
    points, alpha = len(index), surface.alpha[:, None]
    counts = [(samples + t) // len(Technique) for t in Technique]
    drawn = []
    for technique, count in zip(Technique, counts, strict=True):
        u = _shifted_points(count, shifts[:, technique]).to(surface.wo)
        if technique == Technique.LOBE:
            wo = surface.wo[:, None].expand(-1, count, -1)
            wi = reflect(wo, sample_visible_normal(wo, alpha.expand(-1, count, -1), u))
        elif technique == Technique.COSINE:
            wi = _cosine_direction(u)
        else:
            world = light.sample(u.reshape(-1, 2)).view(points, count, 3)
            wi = world @ surface.frame.transpose(1, 2)
        drawn.append(wi)
    wi = torch.cat(drawn, 1)
    world = (wi @ surface.frame).reshape(-1, 3)
    wo = surface.wo[:, None].expand_as(wi)
    wh, lit = normalize(wi + wo), wi[..., 2:] > 0
    cosine = torch.where(lit, wi[..., 2:], 1.0)
    densities = (
        visible_normal_density(wo[..., 2:], wh[..., 2:], alpha),
        cosine / math.pi,
        light.density(world).view_as(cosine),
    )
    density = sum(c * d for c, d in zip(counts, densities, strict=True))
    incoming = sample_octahedral(light.radiance, world).view_as(wi)
    incoming = incoming * torch.where(lit, cosine / density, 0.0)
    if visibility is not None:
        through = visibility(index.repeat_interleave(samples), world)
        incoming = incoming * through.view_as(cosine)
    lobe = specular_brdf(wo[..., 2:], cosine, wh[..., 2:], dot(wo, wh), surface.f0[:, None], alpha)
    return surface.base * incoming.sum(1), (lobe * incoming).sum(1)


def _shifted_points(count: int, shift: Float[Tensor, "P 2"]) -> Float[Tensor, "P count 2"]:
    """The R2 sequence, shifted on the torus by each point's own amount.

    Source: Roberts 2018, "The unreasonable effectiveness of quasirandom sequences".
    """
    steps = torch.arange(count, dtype=shift.dtype)[:, None] * shift.new_tensor(R2_STEP)
    return (shift[:, None] + steps) % 1.0


def _cosine_direction(u: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch 3"]:
    """Cosine-distributed directions about +z."""
    sine, phi = u[..., :1].sqrt(), 2.0 * math.pi * u[..., 1:]
    return torch.cat([sine * phi.cos(), sine * phi.sin(), (1.0 - u[..., :1]).sqrt()], -1)
