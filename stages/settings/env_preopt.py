"""Settings of phase 0, the environment before any geometry."""

from typing import Literal

from pydantic import Field

from stages.settings.base import StageConfig


class EnvPreoptConfig(StageConfig):
    """Settings of `stages.env_preopt`."""

    size: Literal[16, 32, 64, 128, 256] = 128
    """Side of the octahedral environment map, texels (SViM3D optimises at low resolution)."""
    light: Literal["map", "spherical_gaussians"] = "map"
    """`map`: every texel is free; `spherical_gaussians`: 24 white lobes, a baseline. To keep it in
    later phases set their `environment_rate` to 0."""
    prefilter: Literal["exact", "hybrid", "sampled"] = "exact"
    """How the pyramid is filtered: the lobes' own integrals, these with samples where lobes are
    narrow, or the paper's few samples."""
    steps: int = Field(200, ge=1, le=100_000)
    """Full-batch Adam steps (SViM3D, section 4)."""
    learning_rate: float = Field(0.3, gt=0.0, le=10.0)
    """Adam step of log radiance at first; it falls to zero along a half cosine."""
    max_pixels: int = Field(60_000, ge=100)
    """Pixels that are kept of all views, drawn at random."""
    min_mask: float = Field(0.99, ge=0.0, le=1.0)
    """Pixels with less coverage are dropped: at silhouettes they mix two surfaces."""
    min_n_dot_v: float = Field(0.1, ge=0.0, lt=1.0)
    """Pixels seen at a smaller cosine are dropped: split-sum shading is poor at grazing angles."""
    smooth_weight: float = Field(0.03, ge=0.0)
    """Weight of the total variation of log radiance; fills in what no pixel reveals."""
    white_weight: float = Field(0.001, ge=0.0)
    """Weight of the light's departure from grey, in log radiance (nvdiffrec: white balance)."""
    multiple_scattering: bool = True
    """Shade with light that bounces between microfacets, as phases 1 and 2 do (Fdez-Aguera 2019).
    Off fits the views of renderers that scatter once, by up to 0.13 dB after AgX."""
