"""glTF's metallic-roughness parameters as reflectances. Source: glTF 2.0 specification, app. B."""

from jaxtyping import Float
from torch import Tensor

DIELECTRIC_F0 = 0.04  # normal-incidence reflectance at an index of refraction of 1.5


def specular_f0(
    basecolor: Float[Tensor, "*batch 3"], metallic: Float[Tensor, "*batch 1"]
) -> Float[Tensor, "*batch 3"]:
    """Reflectance at normal incidence, linear Rec.709."""
    return DIELECTRIC_F0 * (1.0 - metallic) + basecolor * metallic


def diffuse_albedo(
    basecolor: Float[Tensor, "*batch 3"], metallic: Float[Tensor, "*batch 1"]
) -> Float[Tensor, "*batch 3"]:
    """Albedo of the diffuse base below the specular layer, linear Rec.709."""
    return basecolor * (1.0 - metallic)
