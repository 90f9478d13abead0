"""Settings of the prepare stage."""

from pathlib import Path
from typing import Literal, Self

from pydantic import Field, model_validator

from stages.settings.base import FileReadingConfig


class PrepareConfig(FileReadingConfig):
    """How a photo becomes a square with the object cut out."""

    size: int = Field(default=576, ge=16, le=2048)
    """Rows and columns of the square, pixels. Source: SV3D, 576."""

    fill: float = Field(default=0.9, gt=0.1, le=1.0)
    """Share of the square that the object's longer side takes."""

    matting: Literal["auto", "alpha", "network", "plain"] = "auto"
    """What tells the object from its background: the file's transparency, a network, or a plain
    background. `auto` takes the first of these that there is."""

    network: Path | None = None
    """Matting network (.onnx, like U-2-Net); None looks for an installed one."""

    min_coverage: float = Field(default=0.001, ge=0.0, le=1.0)
    """Share of the photo that the object must cover."""

    @model_validator(mode="after")
    def _refuse_contradictions(self) -> Self:
        """Options that would be ignored are errors."""
        if self.network is not None and self.matting in ("alpha", "plain"):
            raise ValueError(f"matting {self.matting} uses no network: leave out one of the two")
        return self
