"""Settings of relighting."""

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, FiniteFloat, model_validator

from stages.settings.base import FileReadingConfig

MAX_FRAMES = 1440  # a turntable of quarter degrees


class RelightConfig(FileReadingConfig):
    """Which light, from where, on which views, and how well."""

    environment: Path | None = None
    """Light: .exr, .hdr or an 8-bit picture; None is the built-in studio."""

    layout: Literal["auto", "latlong", "octahedral", "cube cross"] = "auto"
    """How the light's picture maps to directions; auto goes by its sides."""

    azimuths_deg: Annotated[tuple[FiniteFloat, ...], Field(min_length=1, max_length=MAX_FRAMES)] = (
        0.0,
    )
    """Turns of the light about y, counter-clockwise seen from above. The first lights the views,
    all together make the turntable."""

    exposure: Annotated[FiniteFloat, Field(ge=-30.0, le=30.0)] = 0.0
    """Stops by which pictures are brightened for display; EXR files stay scene-linear."""

    edits: tuple[str, ...] = ()
    """Changes of materials, applied in this order, like `roughness*0.5`."""

    mask: Path | None = None
    """Picture of the region that the edits are for, one for all views; None edits everything."""

    quality: Literal["fast", "exact"] = "fast"
    """Split-sum approximation, or unbiased sampling of the whole reflectance."""

    samples: Annotated[int, Field(ge=1, le=65536)] = 256
    """Light directions per pixel of exact shading, or paths per pixel of the path tracer."""

    occlusion: bool = True
    """Let the object shadow and light itself, as far as its depth picture shows it."""

    multiple_scattering: bool | Literal["scaled"] = True
    """Give back the energy that rough metals lose to single scattering: as light of all directions
    (Fdez-Aguera 2019), or by scaling the first bounce (Turquin 2019)."""

    engine: Literal["raster", "path"] = "raster"
    """What renders a finished asset: our rasteriser, or Mitsuba's path tracer."""

    views: tuple[Annotated[int, Field(ge=0)], ...] | Literal["all", "reference"] = "all"
    """Which views to relight, by index."""

    turntable: Literal["gif", "mp4", "png", "none"] = "gif"
    """How the turns of the light are shown, on the reference view or else the first one."""

    frames_per_s: Annotated[int, Field(ge=1, le=120)] = 20
    """Speed of the turntable."""

    orbit_views: Annotated[int, Field(ge=1, le=200)] = 8
    """Cameras around an asset; the last stands at azimuth 0."""

    size: Annotated[int, Field(ge=16, le=4096)] = 512
    """Image rows and columns of an asset's views, pixels."""

    supersample: Annotated[int, Field(ge=1, le=8)] = 2
    """Samples per pixel and axis of an asset's views."""

    fov_y_deg: Annotated[float, Field(gt=1.0, lt=120.0)] = 33.8
    """Vertical field of view of those cameras, degrees. Source: SV3D."""

    elevation_deg: Annotated[float, Field(gt=-90.0, lt=90.0)] = 10.0
    """Elevation of those cameras, degrees."""

    @model_validator(mode="after")
    def _refuse_contradictions(self) -> "RelightConfig":
        """Options that would be ignored are errors."""
        if self.mask is not None and not self.edits:
            raise ValueError("a mask says where edits apply: give an edit too")
        return self
