"""Settings of the figures behind tables."""

from pathlib import Path

from pydantic import Field

from stages.settings.base import FileReadingConfig


class TableScoresConfig(FileReadingConfig):
    """How finely an asset is compared; figures of other settings do not compare."""

    surface_samples: int = Field(default=100_000, ge=100, le=10_000_000)
    """Points on each surface."""

    volume_cells: int = Field(default=128, ge=8, le=512)
    """Cells along the cube in which volumes are compared."""

    supersample: int = Field(default=3, ge=1, le=8)
    """Samples per pixel and axis when the asset is rendered."""

    light_size: int = Field(default=256, ge=16, le=512)
    """Side of the octahedral maps of lights, texels, a power of two."""

    from_photo: bool = False
    """Whether the asset was made of a photo: then its views are scored too, and all is framed by
    the photo's view."""

    stanford_orb: bool = False
    """Whether test views are scored by Stanford-ORB's rules, too."""

    lpips_weights: Path | None = None
    """State of `lpips.LPIPS(net='alex')` or of another of its networks, backbone included, or of
    the shift-tolerant kind; None leaves the figure out."""

    efficientnet_weights: Path | None = None
    """State of EfficientNet-Lite0, whose features of pictures are kept for sets of them."""

    inception_weights: Path | None = None
    """State of pytorch-fid's Inception, the same for FID."""

    clip_folder: Path | None = None
    """Folder of transformers' CLIPModel, the same for CMMD and CLIP-S."""
