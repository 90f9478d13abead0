"""Fields, light and rays to pictures: composite materials and normals, then shade once per ray."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from svim3d.fields.material_field import MaterialField
from svim3d.numerics import normalize
from svim3d.render.compositing import accumulate
from svim3d.render.march import Rays
from svim3d.render.volumes import SurfaceSamples, Volume
from svim3d.shading.prefilter import EnvironmentPyramid
from svim3d.shading.split_sum import shade

MIN_LIT_COVERAGE = 0.05  # fainter rays are not shaded: their composited normal is mostly noise
SHADING_NORMAL = slice(8, 11)  # columns of the composited values
MIN_COVERAGE = 1e-3  # guards the division by the weight of a ray's kept samples


@dataclass(frozen=True)
class Rendered:
    """What R rays see; everything but `surface` is premultiplied by the coverage.

    Attributes:
        mask: coverage.
        basecolor: linear.
        roughness: perceptual.
        metallic: share.
        normal_geometric: of the surface, world space; shorter than the coverage where it varies.
        normal_shading: with bump, world space.
        depth: distance along the ray.
        radiance: linear; None without a light.
        surface: the samples behind it.
        bump: world-space normal offset.
    """

    mask: Float[Tensor, "R 1"]
    basecolor: Float[Tensor, "R 3"]
    roughness: Float[Tensor, "R 1"]
    metallic: Float[Tensor, "R 1"]
    normal_geometric: Float[Tensor, "R 3"]
    normal_shading: Float[Tensor, "R 3"]
    depth: Float[Tensor, "R 1"]
    radiance: Float[Tensor, "R 3"] | None
    surface: SurfaceSamples
    bump: Float[Tensor, "M 3"]

    def surface_images(self) -> dict[str, Float[Tensor, "R _"]]:
        """Coverage, materials and geometric normals by the names that they have in views."""
        return {
            "mask": self.mask,
            "basecolor": self.basecolor,
            "roughness": self.roughness,
            "metallic": self.metallic,
            "normal_world": self.normal_geometric,
        }


def render_rays(
    volume: Volume,
    materials: MaterialField,
    rays: Rays,
    *,
    jitter: Float[Tensor, "R"],
    pyramid: EnvironmentPyramid | None,
    min_weight: float,
    use_bump: bool = True,
    multiple_scattering: bool = True,
) -> Rendered:
    """Trace rays through a volume and shade what they see.

    Shading is deferred: materials and normals are composited per ray and shaded once, which costs
    a tenth of shading every sample and is what a mesh will show later.
    Differentiable in the parameters of `volume`, `materials` and `pyramid`.

    Args:
        volume: where the surface is.
        materials: what it is made of.
        rays: world-space rays.
        jitter: offset of each ray's first sample in [0, 1) steps.
        pyramid: the light; None leaves `radiance` out.
        min_weight: samples that contribute less to their ray get no material of their own.
        use_bump: add the material field's bump to the geometric normal.
        multiple_scattering: compensate the energy that single scattering loses.
    """
    surface = volume.trace(rays, jitter, min_weight)
    samples, weights = surface.samples, surface.weights
    material = materials(samples.points)
    normal = normalize(-surface.gradient)
    shading_normal = normalize(normal + material.bump) if use_bump else normal
    values = [
        material.basecolor,
        material.roughness,
        material.metallic,
        normal,
        shading_normal,
        samples.distance,
    ]
    # The light samples left out are taken to look like those kept on their ray.
    kept = accumulate(weights, torch.ones_like(weights), samples)
    scale = surface.coverage / kept.clamp_min(MIN_COVERAGE)
    composited = accumulate(weights, torch.cat(values, -1), samples) * scale
    basecolor, roughness, metallic, geometric, shading, depth = composited.split(
        [value.shape[-1] for value in values], -1
    )
    radiance = None
    if pyramid is not None:
        # Rays that see next to nothing, or opposite sides of a sheet, have no normal to shade with.
        lit = torch.nonzero(shading.detach().norm(dim=-1) > MIN_LIT_COVERAGE)[:, 0]
        coverage = surface.coverage.index_select(0, lit)
        straight = composited.index_select(0, lit) / coverage
        shaded = shade(
            normalize(straight[:, SHADING_NORMAL]),
            -rays.directions.index_select(0, lit),
            straight[:, :3],
            straight[:, 3:4],
            straight[:, 4:5],
            pyramid,
            multiple_scattering=multiple_scattering,
        )
        radiance = torch.zeros_like(basecolor).index_add(0, lit, shaded.radiance * coverage)
    return Rendered(
        mask=surface.coverage,
        basecolor=basecolor,
        roughness=roughness,
        metallic=metallic,
        normal_geometric=geometric,
        normal_shading=shading,
        depth=depth,
        radiance=radiance,
        surface=surface,
        bump=material.bump,
    )
