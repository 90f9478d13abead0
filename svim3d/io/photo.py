"""Photographs in: any common file and pixel format, as 8-bit sRGB colour with opacity beside it.

PNG, JPEG, WebP, TIFF, BMP and GIF; grey, palette, CMYK, Lab, 16 bit (kept to 8), EXIF orientation,
colour profiles. What is damaged or no picture is refused in words.
"""

import io
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image, ImageCms, UnidentifiedImageError
from torch import Tensor

from svim3d.io.limits import check_size
from svim3d.io.photo_header import FORMATS

Notify = Callable[[str, str], None]

WANTED = "wanted a photo (PNG, JPEG, WebP, TIFF, BMP or GIF)"
MAX_8BIT, MAX_16BIT = 255.0, 65535
OPACITY_MODES = ("LA", "La", "PA", "RGBA", "RGBa")
ORIENTATION_TAG = 0x0112
# What undoes each EXIF orientation but 1, which is upright. Source: CIPA DC-008 (Exif 2.32).
TURNS = {
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_270,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_90,
}
LYING = (5, 6, 7, 8)  # orientations that swap rows and columns
PROFILE_MODES = {"RGB ": "RGB", "GRAY": "L", "CMYK": "CMYK", "Lab ": "LAB"}


@dataclass(frozen=True)
class Photo:
    """A picture as it is meant to be looked at, the right way up.

    Attributes:
        rgb: sRGB-encoded, straight (not premultiplied), in [0, 1].
        mask: coverage told by the file; None without transparency, or where all is opaque.
        height: rows of the picture in the file, which may be a multiple of those kept.
        width: its columns.
    """

    rgb: Float[Tensor, "H W 3"]
    mask: Float[Tensor, "H W 1"] | None
    height: int
    width: int


def read_photo(file: Path, notify: Notify, *, longest_px: int) -> Photo:
    """Decode a photo, averaged down so that no side exceeds `longest_px`.

    Args:
        file: the first picture is taken where it holds several.
        notify: told (kind, message) of what was left out or mended.
        longest_px: pixels are averaged by a whole factor, opacity-weighted.

    Raises:
        ValueError: there is no file, no picture in it, or a truncated or oversized one.
    """
    if not file.is_file():
        raise ValueError(f"{WANTED}, but {file} does not exist; check the path")
    if file.stat().st_size == 0:
        raise ValueError(f"{WANTED}, but {file.name} is empty; copy it anew")
    try:
        with warnings.catch_warnings():
            # Sizes are judged by our own limit; damaged metadata is told where it matters.
            warnings.simplefilter("ignore")
            with Image.open(file, formats=tuple(FORMATS)) as picture:
                return _decode(picture, notify, longest_px)
    except UnidentifiedImageError as error:
        raise ValueError(f"{WANTED}, but {file.name} is none; convert it to PNG") from error
    except ValueError as error:
        raise ValueError(f"{file.name}: {error}") from error
    except Exception as error:  # of any kind: decoders raise whatever damaged bytes lead them to
        raise ValueError(
            f"{WANTED}, but {file.name} is damaged or cut short ({error}); copy it anew"
        ) from error


def _decode(picture: Image.Image, notify: Notify, longest_px: int) -> Photo:
    """Pixels of an opened file: decoded, reduced, converted to sRGB, turned upright."""
    check_size(picture.height, picture.width)
    width, height = picture.size
    count = getattr(picture, "n_frames", 1)
    if count > 1:
        notify("first_picture", f"the file holds {count} pictures: the first is used")
        picture.seek(0)
    factor = -(-max(width, height) // longest_px)
    if factor > 1:
        # JPEG alone can leave out detail while it decodes.
        picture.draft(None, (width // factor, height // factor))
    picture.load()
    orientation = _orientation(picture, notify)
    profile = picture.info.get("icc_profile")
    colour, opacity = _reduced(_plain_mode(picture), longest_px)
    colour = _upright(_to_srgb(colour, profile, notify), orientation)
    mask = None
    if orientation in LYING:
        width, height = height, width
    if opacity is not None:
        values = np.asarray(_upright(opacity, orientation))
        if int(values.min()) < MAX_8BIT:
            mask = torch.from_numpy(values.astype(np.float32) / np.float32(MAX_8BIT))[..., None]
    rgb = torch.from_numpy(np.asarray(colour, np.float32) / np.float32(MAX_8BIT))
    return Photo(rgb=rgb, mask=mask, height=height, width=width)


def _orientation(picture: Image.Image, notify: Notify) -> int:
    """EXIF orientation, 1 to 8; 1 where there is none or its block is damaged."""
    try:
        value = int(picture.getexif().get(ORIENTATION_TAG, 1))
    except Exception as error:  # of any kind, see above; the pixels are good without it
        notify("metadata_ignored", f"the EXIF block is damaged ({error}): taken as upright")
        return 1
    return value if 1 <= value <= 8 else 1


def _upright(picture: Image.Image, orientation: int) -> Image.Image:
    """Undo a camera's turn."""
    turn = TURNS.get(orientation)
    return picture if turn is None else picture.transpose(turn)


def _plain_mode(picture: Image.Image) -> Image.Image:
    """Grey, colour, CMYK or Lab with 8 bits per channel, opacity as a last channel.

    Raises:
        ValueError: floating-point or 32-bit pixels, whose range is unknown.
    """
    if picture.mode == "F":
        raise ValueError("wanted 8 or 16 bits per channel, got floating point; convert it to PNG")
    if picture.mode.startswith("I"):
        values = np.asarray(picture).astype(np.int64)
        if values.min() < 0 or values.max() > MAX_16BIT:
            raise ValueError("wanted 8 or 16 bits per channel, got 32; convert it to PNG")
        # The upper byte, as Pillow reads 16-bit colour.
        grey = Image.fromarray((values >> 8).astype(np.uint8))
        key = picture.info.get("transparency")
        if not isinstance(key, int):
            return grey
        opacity = Image.fromarray(np.where(values == key, 0, 255).astype(np.uint8))
        return Image.merge("LA", (grey, opacity))
    if picture.mode in OPACITY_MODES or "transparency" in picture.info:
        return picture.convert("LA" if picture.mode in ("LA", "La") else "RGBA")
    if picture.mode in ("L", "RGB", "CMYK", "LAB"):
        return picture
    return picture.convert("L" if picture.mode == "1" else "RGB")


def _reduced(picture: Image.Image, longest_px: int) -> tuple[Image.Image, Image.Image | None]:
    """Colour and opacity, averaged down; Pillow weights colour by opacity as it does so."""
    factor = -(-max(picture.size) // longest_px)
    if factor > 1:
        picture = picture.reduce(factor)
    if picture.mode == "LA":
        grey, opacity = picture.split()
        return grey, opacity
    if picture.mode == "RGBA":
        return picture.convert("RGB"), picture.getchannel("A")
    return picture, None


def _to_srgb(colour: Image.Image, profile: bytes | None, notify: Notify) -> Image.Image:
    """Convert to sRGB by the embedded profile; without one grey and colour are sRGB already."""
    source = (
        ImageCms.ImageCmsProfile(ImageCms.createProfile("LAB")) if colour.mode == "LAB" else None
    )
    if profile and source is None:
        try:
            source = ImageCms.ImageCmsProfile(io.BytesIO(profile))
            mode = PROFILE_MODES.get(source.profile.xcolor_space)
            if mode != colour.mode:
                raise ValueError(f"it is for {mode}, the pixels are {colour.mode}")
            if ImageCms.getProfileDescription(source).strip().startswith("sRGB"):
                source = None
        except (OSError, ImageCms.PyCMSError, ValueError) as error:
            notify("profile_ignored", f"the colour profile is not used: {error}")
            source = None
    if source is None:
        return colour.convert("RGB")
    try:
        target = ImageCms.createProfile("sRGB")
        converted = ImageCms.profileToProfile(colour, source, target, outputMode="RGB")
    except ImageCms.PyCMSError as error:
        notify("profile_ignored", f"the colour profile is not used: {error}")
        return colour.convert("RGB")
    if converted is None:
        raise ValueError("the colour profile gave no picture; convert the photo to sRGB")
    return converted
