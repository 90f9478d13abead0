"""What the pixels of one view see of each other: rays of both lobes, traced once per view.

Every pixel sends rays that share its diffuse and its specular lobe evenly, and keeps which pixel
each ray meets. None of it depends on the light, so any light can be turned about the object for the
price of looking it up along the rays; see `image_shading`.
"""

import math
from dataclasses import dataclass
from typing import Self

import torch
from jaxtyping import Float, Int
from torch import Tensor

from svim3d.numerics import dot, normalize, reflect
from svim3d.render.gbuffer import GBuffer
from svim3d.render.screen_march import Relief, march
from svim3d.shading.directional_albedo import MIN_N_DOT_V
from svim3d.shading.lobe_sampling import halton, tangent_frame
from svim3d.shading.metallic_roughness import specular_f0
from svim3d.shading.microfacet import (
    alpha_from_roughness,
    fresnel_schlick,
    masking_shadowing,
    sample_visible_normal,
    smith_lambda,
    visible_normal_density,
)

# Twice the diffuse rays bring 0.05 dB, half the specular ones cost 0.1 dB (mean of ten lit assets).
DIFFUSE_RAYS, SPECULAR_RAYS = 64, 32
COVERED = 0.5  # coverage from which a pixel counts as surface
MIN_DENSITY = 1e-6  # of a ray; below it the ray's share of the sphere is more than all of it
MIN_WEIGHT = 1e-6  # keeps the shares of a lobe finite where all its rays point into the surface


@dataclass(frozen=True)
class LobeRays:
    """K rays of each of P pixels.

    Attributes:
        direction: unit, world frame.
        weight: share of the lobe that each ray stands for; they sum to 1.
        blur: roughness of the pyramid's lobe that is as wide as the ray's share of the sphere.
        hit: which of the P pixels the ray meets; -1 where it leaves the picture or meets nothing.
    """

    direction: Float[Tensor, "P K 3"]
    weight: Float[Tensor, "P K"]
    blur: Float[Tensor, "P K"]
    hit: Int[Tensor, "P K"]


@dataclass(frozen=True)
class ScreenVisibility:
    """What the P covered pixels of one view see.

    Attributes:
        pixels: flat indices of the covered pixels.
        diffuse: rays by the cosine about the shading normal.
        specular: rays by the GGX lobe of each pixel's roughness.
    """

    pixels: Int[Tensor, "P"]
    diffuse: LobeRays
    specular: LobeRays

    @classmethod
    def trace(cls, gbuffer: GBuffer, view: int) -> Self:
        """Trace one view on the CPU.

        Raises:
            ValueError: the views have no depth.
        """
        world = gbuffer.positions(view)
        pixels = covered_pixels(gbuffer, view)
        relief = Relief.of(gbuffer.cameras, view, pixels, world)
        rotation = gbuffer.cameras.c2w[view, :3, :3]

        def chosen(image: Tensor) -> Tensor:
            return image.reshape(-1, image.shape[-1])[pixels]

        # In the camera's frame, so that turning camera and scene together changes no ray.
        normal = chosen(gbuffer.normal_world[view]) @ rotation
        wo, roughness = (
            chosen(gbuffer.view_directions(view)) @ rotation,
            chosen(gbuffer.roughness[view]),
        )
        f0 = specular_f0(chosen(gbuffer.basecolor[view]), chosen(gbuffer.metallic[view]))
        lobes = []
        for direction, weight, density in (
            diffuse_lobe(normal),
            specular_lobe(normal, wo, roughness, f0.mean(-1, keepdim=True)),
        ):
            hit = march(relief, direction)
            blur = _equal_roughness(density)
            lobes.append(LobeRays(direction @ rotation.T, weight, blur, hit))
        return cls(pixels, *lobes)


def covered_pixels(gbuffer: GBuffer, view: int) -> Int[Tensor, "P"]:
    """Flat indices of the pixels that show surface."""
    return torch.nonzero(gbuffer.mask[view].reshape(-1) > COVERED)[:, 0]


def diffuse_lobe(
    normal: Float[Tensor, "P 3"],
) -> tuple[Float[Tensor, "P K 3"], Float[Tensor, "P K"], Float[Tensor, "P K"]]:
    """Directions, weights and densities (per steradian and ray) of rays by the cosine."""
    height, angle = _even_pairs(DIFFUSE_RAYS, normal)
    local = torch.stack(
        [
            (1.0 - height).sqrt() * angle.cos(),
            (1.0 - height).sqrt() * angle.sin(),
            height.sqrt(),
        ],
        -1,
    )
    direction = local @ _frame(normal)
    weight = torch.full_like(direction[..., 0], 1.0 / DIFFUSE_RAYS)
    return direction, weight, (DIFFUSE_RAYS / math.pi * local[:, 2]).expand_as(weight)


def specular_lobe(
    normal: Float[Tensor, "P 3"],
    wo: Float[Tensor, "P 3"],
    roughness: Float[Tensor, "P 1"],
    f0: Float[Tensor, "P 1"],
) -> tuple[Float[Tensor, "P K 3"], Float[Tensor, "P K"], Float[Tensor, "P K"]]:
    """Directions, weights and densities (per steradian and ray) of rays by visible normals.

    Source: Heitz 2018, "Sampling the GGX distribution of visible normals", eq. 19.
    """
    shape = (len(normal), SPECULAR_RAYS, -1)
    frame = _frame(normal)
    local = (frame @ wo[..., None])[..., 0]
    local = normalize(torch.cat([local[:, :2], local[:, 2:].clamp_min(MIN_N_DOT_V)], -1))
    local = local[:, None].expand(shape)
    alpha = alpha_from_roughness(roughness)[:, None].expand(shape)
    u = torch.stack(_even_pairs(SPECULAR_RAYS, normal), -1)
    u = torch.stack([u[:, 1] / (2.0 * math.pi), u[:, 0]], -1).expand(shape)
    wh = sample_visible_normal(local, alpha, u)
    wi = reflect(local, wh)
    # One lobe's rays are weighed by G2/G1 times Fresnel; those into the surface carry nothing.
    masked = masking_shadowing(local[..., 2:], wi[..., 2:], alpha)
    weight = masked * (1.0 + smith_lambda(local[..., 2:], alpha))
    weight = weight * fresnel_schlick(f0[:, None], dot(local, wh))
    weight = torch.where(wi[..., 2:] > 0.0, weight, 0.0)[..., 0]
    density = SPECULAR_RAYS * visible_normal_density(local[..., 2:], wh[..., 2:], alpha)[..., 0]
    return wi @ frame, weight / weight.sum(-1, keepdim=True).clamp_min(MIN_WEIGHT), density


def _even_pairs(count: int, like: Tensor) -> tuple[Float[Tensor, "K"], Float[Tensor, "K"]]:
    """Values in (0, 1) and angles, together spread evenly. Source: Hammersley 1960."""
    even = (torch.arange(count) + 0.5) / count
    return even.to(like), (2.0 * math.pi * halton(count, 2)).to(like)


def _frame(normal: Float[Tensor, "P 3"]) -> Float[Tensor, "P 3 3"]:
    """Rows tangent, bitangent, normal."""
    return torch.stack([*tangent_frame(normal), normal], -2)


def _equal_roughness(density: Float[Tensor, "P K"]) -> Float[Tensor, "P K"]:
    """Roughness whose GGX lobe is as high as `density`: seen from the front, 1 / (4 pi alpha^2)."""
    return (1.0 / (4.0 * math.pi * density.clamp_min(MIN_DENSITY))).clamp_max(1.0) ** 0.25
