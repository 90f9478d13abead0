"""The OpenEXR door: multi-channel scene-linear images."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import OpenEXR
from numpy.typing import NDArray

Plane = NDArray[np.float32]


def write_exr(file: Path, channels: Mapping[str, Plane], *, half: bool = True) -> None:
    """Write planes [H, W], all of one size, as a ZIP-compressed scanline EXR.

    Args:
        file: where to; replaced if it exists.
        channels: name (`R`, `normal.X`, ...) -> plane.
        half: 16-bit float (max 65504; values above are clipped), else 32-bit. `depth.Z` is
            always 32-bit.
    """
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    packed = {
        name: np.ascontiguousarray(
            np.clip(plane, -65504.0, 65504.0) if half and name != "depth.Z" else plane,
            np.float16 if half and name != "depth.Z" else np.float32,
        )
        for name, plane in channels.items()
    }
    with OpenEXR.File(header, packed) as image:
        image.write(str(file))


def read_exr(file: Path) -> dict[str, Plane]:
    """Read every channel as float32 planes [H, W].

    Raises:
        ValueError: the file is missing, truncated or no EXR.
    """
    try:
        with OpenEXR.File(str(file), separate_channels=True) as image:
            return {
                name: np.asarray(channel.pixels, np.float32)
                for name, channel in image.channels().items()
            }
    except Exception as error:
        raise ValueError(f"cannot read {file} as OpenEXR: {error}") from error


def write_rgb(file: Path, rgb: NDArray[np.float32], *, half: bool = True) -> None:
    """Write an [H, W, 3] image as channels R, G, B."""
    write_exr(file, {name: rgb[..., i] for i, name in enumerate("RGB")}, half=half)


def read_rgb(file: Path) -> NDArray[np.float32]:
    """Read channels R, G, B as an [H, W, 3] image."""
    channels = read_exr(file)
    missing = [name for name in "RGB" if name not in channels]
    if missing:
        raise ValueError(f"{file} has no channel {missing}, only {sorted(channels)}")
    return np.stack([channels[name] for name in "RGB"], -1)
