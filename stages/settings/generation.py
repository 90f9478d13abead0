"""Settings of the generation stage."""

import importlib.resources
from pathlib import Path
from typing import Annotated, ClassVar, Literal, Self

from pydantic import Field, model_validator

from stages.settings.base import FileReadingConfig

Elevation = Annotated[float, Field(gt=-60.0, lt=89.0)]
NoiseLevel = Annotated[float, Field(ge=0.0)]


class PhotoSettings(FileReadingConfig):
    """How views are drawn from a photo."""

    bundled: ClassVar[dict[str, Path]] = {
        "model": Path(str(importlib.resources.files("svim3d") / "models/svim3d-small"))
    }

    model: Path | None = None
    """Folder of the generator; None takes the one that comes with the program."""

    path: Literal["static", "sine", "list"] = "static"
    """Where the cameras stand: at one elevation, on a rising and falling orbit, or at `angles`."""

    elevation_deg: Elevation = 10.0
    """Elevation of the photo's camera, and of a static orbit."""

    swing_deg: float = Field(default=20.0, ge=0.0, lt=30.0)
    """A sine orbit rises and falls by this much."""

    angles: tuple[tuple[Elevation, float], ...] = ()
    """Elevation and azimuth of each camera, degrees; azimuths count from the photo's camera, which
    must be the last."""

    samples: int = Field(default=1, ge=1, le=16)
    """Orbits drawn. Of several the most agreed-on one is kept, with a confidence for each pixel."""

    sampler_steps: int | None = Field(default=None, ge=1, le=1000)
    """Steps from noise to views; None takes the model's own number."""

    guidance_max: float | None = Field(default=None, ge=1.0, le=20.0)
    """Strength of guidance behind the object; None takes the model's own."""

    guidance_by: Literal["index", "azimuth"] | None = None
    """How guidance grows from the photo's view: with the frame's number (SV3D), or its azimuth;
    None takes the number on an orbit, the azimuth where cameras are listed."""

    guidance_interval: tuple[NoiseLevel, NoiseLevel] | None = None
    """Noise levels between which guidance acts; None is all of them. Source: Kynkaanniemi 2024."""

    dtype: Literal["auto", "float32", "bfloat16"] = "auto"
    """Of the weights; `auto` takes bfloat16 on a GPU, float32 elsewhere."""

    compiled: bool = False
    """Compile the network: worth its minutes for large models on a GPU."""

    keep_photo: bool = True
    """Let the photo itself be the colour of the view that it shows (SV3D), and detail its
    basecolor."""

    photo_view_size: int = Field(default=256, ge=16, le=2048)
    """Image rows that the views of a smaller model are enlarged to, to hold the photo's detail."""

    photo_weight: float = Field(default=16.0, gt=0.0, le=1000.0)
    """How often the photo's own view counts: the others are drawn, it is known."""

    @model_validator(mode="after")
    def _list_ends_at_the_photo(self) -> Self:
        """A list of cameras and the choice of one belong together."""
        if (self.path == "list") != bool(self.angles):
            raise ValueError("path list and angles belong together: give both or neither")
        if self.angles and (len(self.angles) < 3 or self.angles[-1][1] % 360.0 != 0.0):
            raise ValueError(
                "wanted at least 3 cameras of which the last stands at azimuth 0, where the photo "
                f"was taken; got {self.angles}"
            )
        return self

    @model_validator(mode="after")
    def _interval_ascends(self) -> Self:
        if self.guidance_interval and self.guidance_interval[0] >= self.guidance_interval[1]:
            raise ValueError(
                "wanted guidance_interval as a smaller and a larger noise level, got "
                f"{list(self.guidance_interval)}"
            )
        return self


class MeshSettings(FileReadingConfig):
    """How a mesh or a scene is turned into views."""

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


class GenerationConfig(MeshSettings, PhotoSettings):
    """How views are made of a photo (`PhotoSettings`), or of a mesh or a scene (`MeshSettings`).

    An orbit folder is taken as it is.
    """
