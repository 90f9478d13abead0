"""Light from files: any picture of the surroundings, mended and its layout known."""

import logging
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from svim3d.io.exr import read_colour
from svim3d.io.hdr import read_hdr
from svim3d.io.image import read_png
from svim3d.shading.environment import physical_radiance
from svim3d.shading.light_layouts import Layout, detected_layout, octahedral_light

log = logging.getLogger(__name__)

RADIANCE_SUFFIXES = (".hdr", ".pic", ".rgbe")
DISPLAY_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff")
SUFFIXES = (".exr", *RADIANCE_SUFFIXES, *DISPLAY_SUFFIXES)
GREY_CHANNELS = (1, 2)

Notify = Callable[[str, str], None]


@dataclass(frozen=True)
class Light:
    """A picture of the surroundings.

    Attributes:
        radiance: linear, Rec.709 primaries, finite and >= 0; in the file's own pixels.
        layout: how the picture holds the sphere; see `svim3d.shading.light_layouts`.
    """

    radiance: Float[Tensor, "H W 3"]
    layout: Layout

    def octahedral(self, size: int | None = None) -> Float[Tensor, "size size 3"]:
        """The light as the renderer wants it; see `octahedral_light`."""
        return octahedral_light(self.radiance, self.layout, size)


def read_light(
    file: Path,
    notify: Notify | None = None,
    *,
    layout: Layout | Literal["auto"] = "auto",
) -> Light:
    """Read an environment from .exr, .hdr or .pic (Radiance), or a display-encoded picture.

    Args:
        file: its suffix names the format. Display-encoded pictures (.png, .jpg, .webp, .tif) are
            decoded from sRGB; 1.0 is their white.
        notify: told (kind, message) of everything taken on trust: `ldr_light` (highlights are
            clipped), `light_mended` (texels that were no light), `light_layout` (a shape that
            fits no layout), `light_dark` (nothing shines). None writes to the log.
        layout: `auto` goes by the picture's shape; see `detected_layout`.

    Raises:
        ValueError: the file is missing, empty, damaged, too large or of an unknown format; says
            what was wanted.
    """
    notify = _log if notify is None else notify
    if not file.is_file():
        raise ValueError(f"wanted a light, but {file} does not exist; check the path")
    radiance, mended = physical_radiance(_read_radiance(file, notify))
    if mended:
        notify("light_mended", f"{file.name}: {mended} texels were no light")
    if not float(radiance.max()) > 0.0:
        notify("light_dark", f"{file.name}: the light is black everywhere")
    height, width, _ = radiance.shape
    if layout != "auto":
        return Light(radiance, layout)
    detected, fits = detected_layout(height, width)
    if not fits:
        notify(
            "light_layout",
            f"{file.name}: {width} x {height} pixels fit no layout, taken as lat-long",
        )
    return Light(radiance, detected)


def _read_radiance(file: Path, notify: Notify) -> Float[Tensor, "H W 3"]:
    """Linear values of the file, whatever they are."""
    suffix = file.suffix.lower()
    if suffix == ".exr":
        return torch.from_numpy(read_colour(file))
    if suffix in RADIANCE_SUFFIXES:
        return torch.from_numpy(read_hdr(file))
    if suffix not in DISPLAY_SUFFIXES:
        raise ValueError(f"wanted a light as {', '.join(SUFFIXES)}, got {file.name}; convert it")
    picture = read_png(file, srgb=True)
    notify("ldr_light", f"{file.name} is no HDR picture: lamps are clipped at white")
    if picture.shape[-1] in GREY_CHANNELS:
        return picture[..., :1].expand(-1, -1, 3).contiguous()
    return picture[..., :3].contiguous()


def _log(kind: str, message: str) -> None:
    log.warning("%s: %s", kind, message)
