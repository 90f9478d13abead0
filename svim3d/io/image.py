"""The Pillow door: 8-bit pictures in and out, 16-bit grey in, GIF and labelled sheets out."""

import io
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont, UnidentifiedImageError
from torch import Tensor

from svim3d.color import linear_from_srgb, srgb_from_linear
from svim3d.io.limits import check_size

MODES = {1: "L", 2: "LA", 3: "RGB", 4: "RGBA"}
CHANNELS_WITH_OPACITY = (2, 4)  # their last channel is never gamma encoded
MAX_8BIT, MAX_16BIT = 255.0, 65535.0
PALETTE_BITS = 6  # per channel, of the colour counts behind a palette
PALETTE_SIZE = 256
GIF_SHORTEST_MS = 20  # browsers slow down what asks for less
PAPER, INK = 0.11, 0.86  # display-encoded greys of a sheet's background and text
SHEET_MARGIN_PX, SHEET_TEXT_PX = 8, 14
PALETTE_SAMPLES = 1 << 16  # pixels that stand for all of an animation
JPEG_QUALITY, FULL_COLOUR = 90, 0  # 4:4:4
COMPRESSION_LEVEL = 6  # fixed, so that equal pictures give equal bytes


def decode_image(content: bytes, *, srgb: bool = False) -> Float[Tensor, "H W C"]:
    """Decode PNG or JPEG bytes to [0, 1]; C is 1, 2, 3 or 4 as stored, palettes are expanded.

    Args:
        content: the file's bytes. 16-bit grey keeps its depth; 16-bit colour is read as 8-bit.
        srgb: decode the sRGB curve of the colour channels (opacity stays), giving linear light.

    Raises:
        ValueError: the bytes are no picture, or a truncated one.
    """
    try:
        with Image.open(io.BytesIO(content)) as picture:
            check_size(picture.height, picture.width)
            values = _plain_array(picture)
    except (UnidentifiedImageError, OSError, SyntaxError, Image.DecompressionBombError) as error:
        raise ValueError(f"wanted a PNG or JPEG picture, cannot decode it: {error}") from error
    image = torch.from_numpy(values)
    return _on_colour(image, linear_from_srgb) if srgb else image


def _plain_array(picture: Image.Image) -> NDArray[np.float32]:
    """Pixels of any mode as float32 [H, W, C] in [0, 1]."""
    if picture.mode == "F":
        raise ValueError("floating-point pictures are read as .exr only; convert it")
    if picture.mode.startswith("I"):
        return np.asarray(picture, np.float32)[..., None] / np.float32(MAX_16BIT)
    if picture.mode not in MODES.values():
        transparent = "transparency" in picture.info or picture.mode in ("PA", "RGBa")
        picture = picture.convert("RGBA" if transparent else "RGB")
    values = np.asarray(picture, np.float32) / np.float32(MAX_8BIT)
    return np.atleast_3d(values)


def _on_colour(
    image: Float[Tensor, "H W C"], curve: Callable[[Tensor], Tensor]
) -> Float[Tensor, "H W C"]:
    """Apply a transfer curve to all channels but opacity."""
    if image.shape[-1] in CHANNELS_WITH_OPACITY:
        return torch.cat([curve(image[..., :-1]), image[..., -1:]], -1)
    return curve(image)


def encode_png(image: Float[Tensor, "H W C"], *, srgb: bool = False) -> bytes:
    """8-bit PNG of an image in [0, 1] (clamped), rounded to nearest; equal images, equal bytes.

    Args:
        image: 1 (grey), 2 (grey, opacity), 3 (colour) or 4 (colour, opacity) channels.
        srgb: encode the colour channels, given in linear light, by the sRGB curve.
    """
    picture = _picture(image, srgb=srgb)
    return _png(picture)


def encode_small_png(image: Float[Tensor, "H W C"], *, srgb: bool = False) -> bytes:
    """The same pixels as `encode_png` stores, of at most 256 colours as indices into a palette."""
    picture = _picture(image, srgb=srgb)
    pixels = np.atleast_3d(np.asarray(picture))
    if pixels.shape[-1] == 3:
        # One number per colour: to sort rows of three takes ten times as long.
        packed = pixels.astype(np.uint32) @ np.array([1 << 16, 1 << 8, 1], np.uint32)
        colours, index = np.unique(packed, return_inverse=True)
        if len(colours) <= PALETTE_SIZE:
            indices = index.reshape(pixels.shape[:2]).astype(np.uint8)
            picture = Image.fromarray(indices, "P")
            picture.putpalette(colours[:, None].astype(">u4").view(np.uint8)[:, 1:].tobytes())
    return _png(picture)


def encode_smallest(image: Float[Tensor, "H W C"], *, srgb: bool = False) -> bytes:
    """The shorter of `encode_small_png` and a JPEG of 1 or 3 channels; equal images, equal bytes.

    The JPEG keeps colour at full resolution: where channels are roughness and metallic, halving it
    as photos have it cost 12 dB of them.
    """
    png, buffer = encode_small_png(image, srgb=srgb), io.BytesIO()
    picture = _picture(image, srgb=srgb)
    picture.save(buffer, "JPEG", quality=JPEG_QUALITY, subsampling=FULL_COLOUR)
    return min(png, buffer.getvalue(), key=len)


def _picture(image: Float[Tensor, "H W C"], *, srgb: bool) -> Image.Image:
    """Eight bits of an image in [0, 1]."""
    if image.ndim != 3 or image.shape[-1] not in MODES:
        raise ValueError(
            f"wanted an image [H, W, 1 to 4], got {list(image.shape)}; put channels last"
        )
    image = image.detach().cpu().float()
    values = _on_colour(image, srgb_from_linear) if srgb else image
    pixels = (values.clamp(0.0, 1.0) * MAX_8BIT).round().to(torch.uint8).numpy()
    grey = pixels.shape[-1] == 1
    return Image.fromarray(pixels[..., 0] if grey else pixels, MODES[pixels.shape[-1]])


def _png(picture: Image.Image) -> bytes:
    buffer = io.BytesIO()
    picture.save(buffer, "PNG", compress_level=COMPRESSION_LEVEL)
    return buffer.getvalue()


def read_png(file: Path, *, srgb: bool = False) -> Float[Tensor, "H W C"]:
    """Read a picture as `decode_image` does.

    Raises:
        ValueError: the file is missing, truncated or no picture.
    """
    if not file.is_file():
        raise ValueError(f"wanted a picture, but {file} does not exist; check the path")
    try:
        return decode_image(file.read_bytes(), srgb=srgb)
    except ValueError as error:
        raise ValueError(f"{file}: {error}") from error


def write_png(file: Path, image: Float[Tensor, "H W C"], *, srgb: bool = False) -> None:
    """Write an 8-bit PNG as `encode_png` does; replaced if it exists."""
    file.write_bytes(encode_png(image, srgb=srgb))


@dataclass(frozen=True)
class Label:
    """A line of text on a picture; (x, y) is the left end of its middle line, pixels."""

    x: int
    y: int
    text: str
    size_px: int


def with_labels(
    image: Float[Tensor, "H W 3"], labels: Sequence[Label], *, ink: float
) -> Float[Tensor, "H W 3"]:
    """A display-encoded picture with text of grey value `ink` on it, rounded to 8 bit."""
    picture = Image.open(io.BytesIO(encode_png(image)))
    draw = ImageDraw.Draw(picture)
    grey = (round(ink * MAX_8BIT),) * 3
    for label in labels:
        font = ImageFont.load_default(label.size_px)
        draw.text((label.x, label.y), label.text, fill=grey, font=font, anchor="lm")
    return torch.from_numpy(_plain_array(picture))


def contact_sheet(
    pictures: Sequence[Float[Tensor, "_ _ 3"]], labels: Sequence[str], *, columns: int
) -> Float[Tensor, "_ _ 3"]:
    """Display-encoded pictures of any size side by side, a line of text above each.

    Cells are as large as the largest picture; smaller ones are centred.
    """
    if not pictures or len(pictures) != len(labels):
        raise ValueError(f"wanted a label for each picture, got {len(labels)}, {len(pictures)}")
    columns = min(columns, len(pictures))
    height = max(picture.shape[0] for picture in pictures)
    width = max(picture.shape[1] for picture in pictures)
    step_y, step_x = height + SHEET_TEXT_PX + 3 * SHEET_MARGIN_PX, width + SHEET_MARGIN_PX
    rows = -(-len(pictures) // columns)
    sheet = torch.full((rows * step_y, columns * step_x + SHEET_MARGIN_PX, 3), PAPER)
    marks = []
    for i, (picture, text) in enumerate(zip(pictures, labels, strict=True)):
        x = SHEET_MARGIN_PX + i % columns * step_x
        y = i // columns * step_y
        marks.append(Label(x, y + SHEET_MARGIN_PX + SHEET_TEXT_PX // 2, text, SHEET_TEXT_PX))
        top = y + SHEET_TEXT_PX + 2 * SHEET_MARGIN_PX + (height - picture.shape[0]) // 2
        left = x + (width - picture.shape[1]) // 2
        sheet[top : top + picture.shape[0], left : left + picture.shape[1]] = picture.cpu()
    return with_labels(sheet, marks, ink=INK)


def palette_of_histogram(counts: NDArray[np.int64]) -> NDArray[np.uint8]:
    """256 colours [256, 3] for pixels counted by their leading 6 bits, red first.

    Source: Heckbert 1982, "Color image quantization for frame buffer display" (median cut).
    """
    total = max(1, int(counts.sum()))
    # Rare colours, a small highlight, count as one pixel at least.
    shares = np.where(counts > 0, np.maximum(1, counts * PALETTE_SAMPLES // total), 0)
    index = np.repeat(np.arange(len(counts)), shares)
    levels = np.stack([index >> 2 * PALETTE_BITS, index >> PALETTE_BITS, index], -1)
    levels &= (1 << PALETTE_BITS) - 1
    # The middle of each bin, but black and white as they are.
    colours = (levels * MAX_8BIT / ((1 << PALETTE_BITS) - 1)).round().astype(np.uint8)
    picture = Image.fromarray(colours[None])
    quantised = picture.quantize(PALETTE_SIZE, Image.Quantize.MEDIANCUT)
    found = np.array(quantised.getpalette(), np.uint8).reshape(-1, 3)
    return np.pad(found, ((0, PALETTE_SIZE - len(found)), (0, 0)), "edge")


def write_gif(
    file: Path,
    frames: Iterable[NDArray[np.uint8]],
    palette: NDArray[np.uint8],
    seconds_per_frame: float,
) -> None:
    """Write 8-bit frames [H, W, 3] as a GIF that loops; every pixel takes its nearest colour.

    No dithering: its dots would crawl from frame to frame.
    """
    colours = Image.new("P", (1, 1))
    colours.putpalette(palette.tobytes())
    packed = (
        Image.fromarray(frame).quantize(palette=colours, dither=Image.Dither.NONE)
        for frame in frames
    )
    first = next(packed)
    duration_ms = max(GIF_SHORTEST_MS, round(100 * seconds_per_frame) * 10)
    first.save(
        file,
        "GIF",
        save_all=True,
        append_images=packed,
        duration=duration_ms,
        loop=0,
        optimize=False,
        disposal=1,
    )
