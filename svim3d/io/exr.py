"""The OpenEXR door: multi-channel scene-linear images."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
from numpy.typing import NDArray

from svim3d.io.limits import check_size

Plane = NDArray[np.float32]

MAX_HALF = 65504.0  # the largest finite 16-bit float
BEAUTY = "beauty"  # the layer that viewers show first
COLOUR_LAYERS = ("beauty", "combined", "rgba", "rgb")  # names that renderers give it, lower case


def write_exr(
    file: Path,
    channels: Mapping[str, Plane],
    *,
    half: bool = True,
    attributes: Mapping[str, Any] | None = None,
) -> None:
    """Write planes [H, W], all of one size, as a ZIP-compressed scanline EXR.

    Args:
        file: where to; replaced if it exists.
        channels: name (`R`, `normal.X`, ...) -> plane.
        half: 16-bit float (max 65504; values above are clipped), else 32-bit. `depth.Z` is
            always 32-bit.
        attributes: what the header says besides: texts, numbers, matrices.
    """
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    header |= attributes or {}
    packed = {
        name: np.ascontiguousarray(
            np.clip(plane, -MAX_HALF, MAX_HALF) if half and name != "depth.Z" else plane,
            np.float16 if half and name != "depth.Z" else np.float32,
        )
        for name, plane in channels.items()
    }
    with OpenEXR.File(header, packed) as image:
        image.write(str(file))


def read_exr(file: Path) -> dict[str, Plane]:
    """Read every channel as float32 planes [H, W].

    Raises:
        ValueError: the file is missing, truncated, too large or no EXR.
    """
    # Without this look at the header, memory is set aside for whatever size it claims.
    height, width, _ = read_exr_header(file)
    try:
        check_size(height, width)
        with OpenEXR.File(str(file), separate_channels=True) as image:
            return {
                name: np.asarray(channel.pixels, np.float32)
                for name, channel in image.channels().items()
            }
    except Exception as error:
        raise ValueError(f"cannot read {file} as OpenEXR: {error}") from error


def read_exr_attributes(file: Path) -> dict[str, Any]:
    """What the header says: texts, numbers, matrices by name.

    Raises:
        ValueError: the file is missing, cut short within its header or no EXR.
    """
    try:
        with OpenEXR.File(str(file), header_only=True) as image:
            return dict(image.header())
    except Exception as error:
        raise ValueError(f"cannot read {file} as OpenEXR: {error}") from error


def read_exr_header(file: Path) -> tuple[int, int, int]:
    """Rows, columns and channels that an EXR claims: of several parts the most, the most, and all.

    Raises:
        ValueError: the file is missing, cut short within its header or no EXR.
    """
    try:
        with OpenEXR.File(str(file), header_only=True) as image:
            # Headers are emptied when the file is closed.
            headers = [image.header(part) for part in range(len(image.parts))]
            windows = [header["dataWindow"] for header in headers]
            sizes = [high.astype(np.int64) - low.astype(np.int64) + 1 for low, high in windows]
            width, height = np.max(sizes, 0).tolist()
            return height, width, sum(len(header["channels"]) for header in headers)
    except Exception as error:
        raise ValueError(f"cannot read {file} as OpenEXR: {error}") from error


def write_rgb(file: Path, rgb: NDArray[np.float32], *, half: bool = True) -> None:
    """Write an [H, W, 3] image as channels R, G, B."""
    write_exr(file, {name: rgb[..., i] for i, name in enumerate("RGB")}, half=half)


def read_rgb(file: Path) -> NDArray[np.float32]:
    """Read channels R, G, B as an [H, W, 3] image; others are ignored."""
    channels = read_exr(file)
    missing = [name for name in "RGB" if name not in channels]
    if missing:
        raise ValueError(f"{file} has no channel {missing}, only {sorted(channels)}")
    return np.stack([channels[name] for name in "RGB"], -1)


def read_colour(file: Path) -> NDArray[np.float32]:
    """Read the colour of any EXR as an [H, W, 3] image: R, G, B, else a layer's, else grey Y.

    Of several layers (`ViewLayer.Combined.R`, `diffuse.R`) the combined one is taken, else the
    first by name. Other channels are ignored.

    Raises:
        ValueError: the file cannot be read or holds no colour; says what it holds.
    """
    channels = read_exr(file)
    layers = [
        name.removesuffix("R")
        for name in channels
        if (name == "R" or name.endswith(".R"))
        and all(name.removesuffix("R") + c in channels for c in "GB")
    ]
    if layers:
        layer = min(layers, key=_layer_rank)
        return np.stack([channels[layer + name] for name in "RGB"], -1)
    if "Y" in channels and "RY" not in channels:
        return np.repeat(channels["Y"][..., None], 3, -1)
    raise ValueError(
        f"wanted channels R, G, B or Y in {file}, got {sorted(channels)}; convert it to RGB"
    )


def _layer_rank(prefix: str) -> tuple[bool, bool, str]:
    """Sort key: no layer name at all, then names of the combined picture, then by name."""
    last = prefix.rstrip(".").rpartition(".")[2].lower()
    return prefix != "", last not in COLOUR_LAYERS, prefix


def write_layers(
    file: Path,
    layers: Mapping[str, NDArray[np.float32]],
    *,
    notify: Callable[[str, str], None] | None = None,
) -> None:
    """Write colour layers as one single-part half-float EXR, as Blender, Nuke and DJV read it.

    `beauty` becomes the channels R, G, B (and A), any other layer `name.R`, `name.G`, `name.B`
    (and `name.A`), a layer of one channel `name.Y`.

    Args:
        file: where to; replaced if it exists.
        layers: name -> linear [H, W, 1, 3 or 4], all of one size. EXR wants colour that is
            already multiplied by coverage; values are written as given.
        notify: told (kind, message) of values beyond half floats, which are clipped.

    Raises:
        ValueError: a layer has another size or number of channels.
    """
    channels: dict[str, Plane] = {}
    clipped = 0
    for name, picture in layers.items():
        if picture.ndim != 3 or picture.shape[-1] not in (1, 3, 4):
            raise ValueError(f"wanted layer {name} as [H, W, 1, 3 or 4], got {picture.shape}")
        letters = "Y" if picture.shape[-1] == 1 else "RGBA"
        prefix = "" if name == BEAUTY else f"{name}."
        for i in range(picture.shape[-1]):
            channels[prefix + letters[i]] = picture[..., i]
        clipped += int((np.abs(picture) > MAX_HALF).any(-1).sum())
    sizes = {plane.shape for plane in channels.values()}
    if len(sizes) != 1:
        raise ValueError(f"wanted layers of one size, got {sorted(sizes)}")
    if clipped and notify is not None:
        notify("clipped", f"{file.name}: {clipped} pixels above {MAX_HALF:.0f} were clipped")
    write_exr(file, channels)
