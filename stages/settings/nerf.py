"""Settings of phase 1."""

from typing import Annotated, Literal, Self

from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt, model_validator

from stages.settings.perceptual import PerceptualSettings

GridNodes = Annotated[int, Field(ge=4, le=512)]
Share = Annotated[float, Field(ge=0.0, le=1.0)]


class NerfConfig(PerceptualSettings):
    """Phase 1: fit a surface, its materials and its light to the views."""

    steps: PositiveInt = 1200
    """Optimiser steps. The paper takes 800 at full image size."""
    least_fall: Share = 0.0
    """Share by which the loss of held-out pixels has to fall in each sixteenth of the steps; where
    it does not, the rest of that part of the schedule is left out. 0: all steps are made."""
    rays_per_step: Annotated[int, Field(ge=64, multiple_of=4)] = 4096
    """Rays of a step, drawn as blocks of 2 x 2 pixels over all views."""
    image_size: PositiveInt = 256
    """Longest side that larger views are averaged down to, pixels."""
    density_model: Literal["sdf", "density"] = "sdf"
    """`sdf`: signed-distance grid started at the visual hull (NeuS); `density`: Instant-NGP."""

    half_extent: PositiveFloat = 0.55
    """Half the side of the cube that holds the object, world units."""
    hull_rejections: Annotated[int, Field(ge=0, le=7)] | Literal["auto"] = "auto"
    """Masks that may exclude a point of the object by mistake, the reference view's never among
    them. `auto`: as few as let the hull fill that view's silhouette. Where a number leaves no
    hull, up to two more are tried."""
    grid_nodes: tuple[GridNodes, ...] = (64, 96, 128, 192)
    """Nodes per side of the signed-distance grid, coarse to fine; the last is what is returned."""
    grid_shares: tuple[Share, ...] = (0.0, 0.4, 0.65, 0.8)
    """Share of the steps at which each grid begins."""
    coarse_nodes: tuple[GridNodes, ...] = (16, 32)
    """Nodes per side of coarser grids that are added to the current one, coarse to fine."""
    coarse_largest: PositiveInt = 96
    """They are added to grids of at most this many nodes: later the surface is in place."""
    sharpness_start: PositiveFloat = 80.0
    """Inverse width of the opacity transition at the start, per world unit (NeuS: s)."""
    sharpness_end: PositiveFloat = 2000.0
    """The same at the end; it rises exponentially."""
    density_threshold: PositiveFloat = 12.0
    """Density of the surface, per world unit (density model only)."""

    hash_levels: Annotated[int, Field(ge=1, le=16)] = 8
    """Lattices of the material field's hash grid."""
    hash_log2_entries: Annotated[int, Field(ge=8, le=22)] = 17
    """A level stores at most 2^this nodes."""
    hash_coarsest: PositiveInt = 16
    """Cells per side of the coarsest lattice."""
    hash_finest: PositiveInt = 384
    """Cells per side of the finest lattice; about one per pixel of the object."""
    hidden: PositiveInt = 32
    """Width of the material network."""
    min_weight: Share = 0.02
    """Samples that contribute less to their ray get no material: they cost more than they teach."""
    bump_start: Share = 0.5
    """Share of the steps after which the bump normal is fitted (paper: one half)."""

    environment_size: Literal[16, 32, 64, 128, 256] = 64
    """Side of the octahedral map when phase 0 was skipped, texels."""
    environment_start: PositiveFloat = 0.5
    """Radiance of the flat light when phase 0 was skipped."""
    multiple_scattering: bool = True
    """Give back the energy that rough metals lose to single scattering (Fdez-Aguera 2019)."""

    warp_start: Share = 0.1
    """Share of the steps after which a homography is fitted to each view; 1: never. The paper
    begins at one half."""
    warp_limit: Annotated[float, Field(gt=0.0, lt=0.5)] = 0.12
    """Largest shift of a picture's corner by its homography, in half pictures."""
    warp_gain: Annotated[float, Field(gt=0.0, le=1.0)] = 0.5
    """Share of the missing shift by which a homography moves every eight steps, at first."""
    warp_reach: Annotated[float, Field(ge=0.0, le=0.1)] = 0.02
    """Distance over which a view's slope is taken when its homography is fitted, as a share of
    the picture; it falls to one pixel."""
    weigh_views: bool = True
    """Give less weight to views that disagree with all others; only with homographies."""
    facing_gamma: NonNegativeFloat = 0.0
    """Steepness of the trust in normals by the cosine that they are seen at; 0: all alike."""

    field_rate: PositiveFloat = 1e-2
    """Adam step of the hash grids; Source: Mueller et al. 2022."""
    network_rate: PositiveFloat = 5e-3
    """Adam step of the networks."""
    sdf_rate: PositiveFloat = 0.06
    """Adam step of the signed distance, in cells of the current grid."""
    environment_rate: NonNegativeFloat = 5e-3
    """Adam step of the log radiance; 0 keeps the light as it came."""
    final_rate: Share = 0.05
    """All rates decay exponentially to this share."""

    mask_weight: NonNegativeFloat = 0.3
    """Cross-entropy of coverage."""
    basecolor_weight: NonNegativeFloat = 6.0
    """Squared difference in sRGB."""
    orm_weight: NonNegativeFloat = 3.0
    """Squared difference of roughness and metallic."""
    normal_weight: NonNegativeFloat = 1.0
    """Absolute difference of geometric normals at the start."""
    normal_weight_end: NonNegativeFloat = 0.7
    """The same at the end: normals lead at first, as in the paper."""
    bump_normal_weight: NonNegativeFloat = 0.5
    """Absolute difference of shading normals, once the bump is fitted."""
    radiance_weight: NonNegativeFloat = 0.5
    """Squared difference of tone-mapped radiance."""
    eikonal_weight: NonNegativeFloat = 0.05
    """Unit gradient of the signed distance."""
    normal_smoothness_weight: NonNegativeFloat = 0.02
    """Bilateral smoothness of geometric normals."""
    depth_smoothness_weight: NonNegativeFloat = 0.005
    """RegNeRF smoothness of depth."""
    bump_size_weight: NonNegativeFloat = 0.01
    """Squared length of the bump, so that it holds only what geometry cannot."""
    light_balance_weight: NonNegativeFloat = 0.005
    """Distance of the light's colour from grey; Source: nvdiffrec."""
    perceptual_every: PositiveInt = 4
    """Steps from one comparison of pictures to the next; the weight makes up for those without.
    Each is rendered for this alone."""
    perceptual_weight: NonNegativeFloat = 1.0
    """Distance of pictures at the end; it rises from 0, as in the paper."""

    @model_validator(mode="after")
    def _schedule_is_ordered(self) -> Self:
        if len(self.grid_nodes) != len(self.grid_shares):
            raise ValueError(
                f"grid_nodes and grid_shares pair up, got {len(self.grid_nodes)} and "
                f"{len(self.grid_shares)} entries"
            )
        if list(self.grid_shares) != sorted(self.grid_shares) or self.grid_shares[0] != 0.0:
            raise ValueError(f"grid_shares must rise from 0, got {self.grid_shares}")
        return self
