"""Settings of the uv_bake stage."""

from typing import Literal

from pydantic import Field

from stages.settings.base import StageConfig


class UvBakeConfig(StageConfig):
    """Phase 3: from a fitted surface to a mesh of few faces with textures."""

    texture_size: int = Field(default=1024, ge=16, le=8192, description="texels per side")
    supersample: int = Field(
        default=1, ge=1, le=4, description="bake at this multiple of the size and average"
    )
    max_faces: int = Field(
        default=16_000,
        ge=100,
        le=100_000,
        description="decimate to this; xatlas takes 0.5 s for 10k, 6 s for 20k rough faces",
    )
    faces: Literal["fixed", "evidence"] = Field(
        default="fixed",
        description="evidence: fewer than max_faces where the views would not notice "
        "(0.2 % of silhouettes, 1 degree of normals)",
    )
    materials: Literal["texture", "nested"] = Field(
        default="texture",
        description="nested: a constant or a palette where the views do not pay for a texture",
    )
    materials_lost_db: float = Field(
        default=100.0,
        ge=0.0,
        description="nested: how much farther from held-out pixels than a texture a form may be",
    )
    texture_sizes: Literal["fixed", "evidence"] = Field(
        default="fixed",
        description="evidence: each map as small as its detail (45 dB) and the views allow",
    )
    min_area_share: float = Field(
        default=0.002,
        ge=0.0,
        le=1.0,
        description="parts below, and below min_extent_share, are floaters",
    )
    min_extent_share: float = Field(
        default=0.05,
        ge=0.0,
        le=1.0,
        description="longest side of a part, of the object's; keeps thin rods",
    )
    atlas_timeout_s: float = Field(
        default=60.0,
        ge=0.0,
        description="seconds for xatlas before boxes take over; 0: boxes at once",
    )
    gutter_px: int = Field(
        default=4, ge=0, le=64, description="least distance of charts; 4 keeps two mip levels apart"
    )
    occlusion_rays: int = Field(
        default=64,
        ge=0,
        le=4096,
        description="rays per vertex for the occlusion channel; 0: none baked",
    )
    fit_iterations: int = Field(
        default=20,
        ge=0,
        le=1000,
        description="conjugate-gradient steps that sharpen the textures against the views; 0: none",
    )
    correct_views: bool = Field(
        default=True,
        description="sharpen with the views' homographies and weights of earlier phases, if any",
    )
    fit_prior: float = Field(
        default=0.015,
        gt=0.0,
        description="pull of a texel towards its baked value, against 1 for a pixel seen head on",
    )
