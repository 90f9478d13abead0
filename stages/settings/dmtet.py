"""Settings of phase 2."""

from typing import Annotated

from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt

from stages.settings.perceptual import PerceptualSettings

Share = Annotated[float, Field(ge=0.0, le=1.0)]


class DmtetConfig(PerceptualSettings):
    """Phase 2: refine an explicit surface, its materials and its light on whole images."""

    steps: PositiveInt = 150
    """Optimiser steps. The paper takes 1500; after phase 1 most of the gain comes early."""
    least_fall: Share = 0.0
    """Share by which the loss over all views has to fall from window to window (each view once, or
    a sixteenth of the steps); where it does not, only the last part of the schedule is left. 0: all
    steps are made."""
    views_per_step: PositiveInt = 1
    """Views rendered in each step."""
    image_size: PositiveInt = 256
    """Longest side that larger views are averaged down to, pixels."""
    cells: Annotated[int, Field(ge=8, le=256)] = 96
    """Cells of the tetrahedral lattice along each side of the field's cube."""
    reach: PositiveFloat = 2.0
    """Room for the surface to move, in cells; nodes farther from phase 1's are not kept."""

    warp_start: Share = 0.0
    """Share of the steps after which each view's homography goes on being fitted; 1: never."""
    warp_limit: Annotated[float, Field(gt=0.0, lt=0.5)] = 0.12
    """Largest shift of a picture's corner by its homography, in half pictures."""
    warp_gain: Annotated[float, Field(gt=0.0, le=1.0)] = 0.5
    """Share of the missing shift by which a view's homography moves at each visit, at first."""
    warp_patience: PositiveInt = 50
    """Visits in a row at which a view fits better without its homography, until that begins anew
    at the identity."""
    weigh_views: bool = True
    """Give less weight to views that disagree with all others; only with homographies."""
    facing_gamma: NonNegativeFloat = 0.0
    """Steepness of the trust in normals by the cosine that they are seen at; 0: all alike."""

    sdf_rate: NonNegativeFloat = 0.01
    """Adam step of the signed distance, in cells."""
    offset_rate: NonNegativeFloat = 0.01
    """Adam step of the nodes' offsets, in units of their limit."""
    field_rate: NonNegativeFloat = 4e-4
    """Adam step of the hash grid. It comes fitted: phase 1's rate costs it 0.6 dB of basecolor."""
    network_rate: NonNegativeFloat = 2e-4
    """Adam step of the material network."""
    environment_rate: NonNegativeFloat = 5e-3
    """Adam step of the log radiance; 0 keeps the light as it came."""
    final_rate: Share = 0.1
    """All rates decay exponentially to this share."""
    multiple_scattering: bool = True
    """Give back the energy that rough metals lose to single scattering (Fdez-Aguera 2019)."""

    mask_weight: NonNegativeFloat = 1.0
    """Squared difference of coverage."""
    basecolor_weight: NonNegativeFloat = 1.0
    """Squared difference in sRGB."""
    orm_weight: NonNegativeFloat = 0.5
    """Absolute difference of roughness and metallic."""
    normal_weight: NonNegativeFloat = 0.5
    """Absolute difference of shading normals."""
    radiance_weight: NonNegativeFloat = 0.1
    """Squared difference of tone-mapped radiance. It leads the light at any weight; a higher one
    bends materials and normals to what the light cannot explain, such as shadows."""
    normal_smoothness_weight: NonNegativeFloat = 0.02
    """Bilateral smoothness of shading normals."""
    sign_change_weight: NonNegativeFloat = 0.02
    """SDF sign regulariser at the start; Source: nvdiffrec, which starts at 0.2 from noise."""
    sign_change_weight_end: NonNegativeFloat = 0.005
    """The same from a quarter of the steps on."""
    laplacian_weight: NonNegativeFloat = 0.02
    """Squared distance from the neighbours' mean, in cells; too much erases thin parts."""
    light_balance_weight: NonNegativeFloat = 0.005
    """Distance of the light's colour from grey; Source: nvdiffrec."""
    perceptual_weight: NonNegativeFloat = 0.7
    """Distance of pictures: less than at the end of phase 1, as in the paper."""
