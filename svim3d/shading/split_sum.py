"""Split-sum shading: environment light times a microfacet material, from two lookups and a table.

The integral over light directions splits into prefiltered radiance, looked up about one dominant
direction, times the directional albedo of the specular lobe.

Source: Karis 2013, "Real shading in Unreal Engine 4"; Fdez-Aguera 2019, "A multiple-scattering
microfacet model for real-time image-based lighting".
"""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from svim3d.numerics import dot
from svim3d.shading.directional_albedo import (
    MIN_N_DOT_V,
    MultipleScattering,
    lobe_albedos,
    lookup_table,
)
from svim3d.shading.dominant_lobe import dominant_direction
from svim3d.shading.metallic_roughness import diffuse_albedo, specular_f0
from svim3d.shading.prefilter import EnvironmentPyramid
from svim3d.shading.split_sum_cpu import fused_shade


@dataclass(frozen=True)
class Shading:
    """Outgoing radiance, linear Rec.709, by lobe.

    Attributes:
        diffuse: from the diffuse base.
        specular: from the specular lobe, multiple scattering included.
    """

    diffuse: Float[Tensor, "P 3"]
    specular: Float[Tensor, "P 3"]

    @property
    def radiance(self) -> Float[Tensor, "P 3"]:
        """The sum of both lobes."""
        return self.diffuse + self.specular


def shade(
    normal: Float[Tensor, "P 3"],
    wo: Float[Tensor, "P 3"],
    basecolor: Float[Tensor, "P 3"],
    roughness: Float[Tensor, "P 1"],
    metallic: Float[Tensor, "P 1"],
    pyramid: EnvironmentPyramid,
    *,
    multiple_scattering: MultipleScattering = True,
) -> Shading:
    """Radiance that leaves P points towards `wo`; differentiable in everything.

    Args:
        normal: unit shading normals, world frame.
        wo: unit directions to the viewer, world frame.
        basecolor: linear Rec.709 in [0, 1].
        roughness: perceptual, in [0, 1].
        metallic: in [0, 1].
        pyramid: the prefiltered environment, in the same frame.
        multiple_scattering: return the light that bounces between microfacets as well: True as a
            broad lobe, "scaled" in the shape of the first bounce.
    """
    if normal.device.type == "cpu":
        return Shading(
            *fused_shade(
                normal,
                wo,
                basecolor,
                roughness,
                metallic,
                pyramid,
                multiple_scattering=multiple_scattering,
            )
        )
    return shade_plainly(
        normal,
        wo,
        basecolor,
        roughness,
        metallic,
        pyramid,
        multiple_scattering=multiple_scattering,
    )


def shade_plainly(
    normal: Float[Tensor, "P 3"],
    wo: Float[Tensor, "P 3"],
    basecolor: Float[Tensor, "P 3"],
    roughness: Float[Tensor, "P 1"],
    metallic: Float[Tensor, "P 1"],
    pyramid: EnvironmentPyramid,
    *,
    multiple_scattering: MultipleScattering,
) -> Shading:
    """`shade` in plain tensor operations, for any device: the twin of the compiled kernel."""
    n_dot_v = dot(normal, wo)
    visible = n_dot_v.clamp(MIN_N_DOT_V, 1.0)
    single, multiple = lobe_albedos(
        specular_f0(basecolor, metallic),
        visible,
        roughness,
        multiple_scattering=multiple_scattering,
    )
    direction = dominant_direction(normal, wo, n_dot_v, lookup_table(visible, roughness)[:, 2:])
    irradiance = pyramid.irradiance(normal)
    specular = single * pyramid.specular(direction, roughness) + multiple * irradiance
    # What the specular layer does not reflect reaches the diffuse base.
    transmitted = 1.0 - single - multiple
    return Shading(diffuse_albedo(basecolor, metallic) * transmitted * irradiance, specular)
