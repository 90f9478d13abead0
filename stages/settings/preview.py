"""Settings of the preview stage."""

from pydantic import Field

from stages.settings.base import StageConfig


class PreviewConfig(StageConfig):
    """How the finished asset is shown beside the views it was made from."""

    views: int = Field(default=5, ge=1, le=12)
    """Views shown and measured, the reference first, spread over the orbit."""

    cell: int = Field(default=224, ge=64, le=1024)
    """Side of each picture on the sheet, pixels."""

    supersample: int = Field(default=3, ge=1, le=8)
    """Samples per pixel and axis when the asset is rendered."""
