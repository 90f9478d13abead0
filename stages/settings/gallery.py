"""Settings of the gallery stage."""

from pydantic import Field

from stages.settings.base import StageConfig


class GalleryConfig(StageConfig):
    """What the report of a run shows."""

    most_model_mib: float = Field(default=8.0, ge=0.1, le=64.0)
    """Of the asset inside the page; larger ones get smaller textures there."""
