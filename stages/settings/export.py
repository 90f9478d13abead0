"""Settings of the export stage."""

from typing import Literal

from pydantic import Field, field_validator

from stages.settings.base import StageConfig


class ExportConfig(StageConfig):
    """The finished files."""

    formats: tuple[Literal["glb", "obj"], ...] = Field(
        default=("glb",), description="file formats; glb is always among them"
    )
    vertex_color_faces: int = Field(
        default=100_000,
        ge=100,
        le=2_000_000,
        description="decimate to this when phase 3 was skipped and vertices carry the colour",
    )

    lods: int = Field(
        default=0,
        ge=0,
        le=3,
        description="coarser levels of detail at most, written beside it as asset_lod1.glb, ...",
    )

    @field_validator("formats")
    @classmethod
    def _has_glb(cls, formats: tuple[str, ...]) -> tuple[str, ...]:
        """The GLB is what a run is for; without it nothing could be checked."""
        if "glb" not in formats:
            raise ValueError('formats must contain "glb"')
        return formats
