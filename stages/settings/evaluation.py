"""Settings of the evaluation stage."""

from pydantic import Field

from stages.settings.base import StageConfig


class EvaluationConfig(StageConfig):
    """How finely an asset is held against its truth; figures of other settings do not compare."""

    surface_samples: int = Field(default=100_000, ge=100, le=10_000_000)
    """Points on each surface for distances."""

    volume_cells: int = Field(default=128, ge=8, le=512)
    """Cells along the cube in which volumes are compared."""

    supersample: int = Field(default=4, ge=1, le=8)
    """Samples per pixel and axis when the asset is rendered."""

    light_size: int = Field(default=256, ge=16, le=512)
    """Side of the octahedral maps of the true lights, texels, a power of two."""
