"""Settings of the generation stage."""

from pathlib import Path

from pydantic import Field

from stages.settings.base import FileReadingConfig


class GenerationConfig(FileReadingConfig):
    """How a mesh or a scene is turned into views; an orbit folder is taken as it is."""

    views: int = Field(default=21, ge=3, le=200)
    """Cameras on the orbit; the last is the reference. Source: SV3D, 21 frames."""

    size: int = Field(default=256, ge=16, le=2048)
    """Image rows and columns, pixels."""

    fov_y_deg: float = Field(default=33.8, gt=1.0, lt=120.0)
    """Vertical field of view, degrees. Source: SV3D."""

    elevation_mean_deg: float = Field(default=10.0, gt=-60.0, lt=60.0)
    """Mean elevation of the orbit, degrees."""

    elevation_swing_deg: float = Field(default=20.0, ge=0.0, lt=30.0)
    """Elevation rises and falls by this much around the orbit, degrees; 0 is a static orbit."""

    radius: float | None = Field(default=None, gt=0.9, le=100.0)
    """Distance of the cameras from the origin, world units; None fits the object to the image."""

    fill: float = Field(default=0.85, gt=0.1, le=1.0)
    """Share of the image's height that the object's bounding sphere takes when radius is None."""

    environment: Path | None = None
    """Light (.exr, .hdr, .png, ...), lat-long, octahedral or cube; None is the built-in studio."""

    environment_size: int = Field(default=128, ge=16, le=1024)
    """Side of the octahedral light map, pixels, a power of two."""

    supersample: int = Field(default=3, ge=1, le=8)
    """Samples per pixel and axis."""
