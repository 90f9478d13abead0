"""Settings of the capacity stage."""

from typing import Annotated

from pydantic import Field, PositiveFloat, PositiveInt

from stages.settings.base import StageConfig


class CapacityConfig(StageConfig):
    """How much model the views ask for, read off them before any work."""

    views: PositiveInt = 8
    """Views that pictures are averaged in, spread over the orbit; silhouettes are read in all."""
    half_extent: PositiveFloat = 0.55
    """Half the side of the cube that holds the object, world units; as `nerf.half_extent`."""
    lost_db: Annotated[float, Field(ge=20.0, le=60.0)] = 45.0
    """Materials may be averaged for as long as that changes them by no more, PSNR."""
    lost_normal_deg: Annotated[float, Field(gt=0.0, le=10.0)] = 1.25
    """The same for normals: RMS angle, degrees. Source: `uv_bake` tells no smaller ones apart."""
    lost_radiance_db: Annotated[float, Field(ge=20.0, le=60.0)] = 35.0
    """The same for pictures as displayed: they lead the light, which is smoother than they are."""
    least_grid: Annotated[int, Field(ge=8, le=512)] = 64
    """Nodes per side that every signed-distance grid has at least."""
    least_image: Annotated[int, Field(ge=16, le=1024)] = 64
    """Longest side that pictures keep at least, pixels."""
