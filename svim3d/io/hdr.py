"""The Radiance door: shared-exponent pictures (.hdr, .pic), read and written.

A pixel is three mantissas and one exponent: value = (mantissa + 0.5) 2^(exponent - 136), and 0
where the exponent is 0. The half makes up for the writer, which cuts off.
Source: Ward 1991, "Real pixels", Graphics Gems II; Radiance, "picture file format".
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from svim3d.io.limits import check_size

Bytes = NDArray[np.uint8]

MAGIC = b"#?"
MAX_HEADER_BYTES = 1 << 16
FORMAT = "32-bit_rle_rgbe"
SIZE_LINE = re.compile(r"([-+])([XY])\s+(\d{1,12})\s+([-+])([XY])\s+(\d{1,12})\s*")
EXPONENT_BIAS = 128 + 8
RLE_WIDTHS = range(8, 1 << 15)  # scanlines of other widths are never run-length coded by component
MAX_LITERAL, MAX_RUN, MIN_RUN = 128, 127, 4
MAX_LOOK_AHEAD = 4096  # pixels searched for marks at a time, so that many marks stay cheap


@dataclass(frozen=True)
class _Header:
    """What the header says; `scale` divides the stored values to give radiance."""

    scale: NDArray[np.float64]
    scanlines: int
    width: int
    by_column: bool
    flip_rows: bool
    flip_columns: bool
    begin: int


def read_hdr(file: Path) -> NDArray[np.float32]:
    """Read a Radiance picture as linear [H, W, 3], top row first, whatever its orientation.

    EXPOSURE and COLORCORR are divided out, so that the values are the radiance that was recorded.

    Raises:
        ValueError: the file is missing, truncated, too large, in XYZ colour or no Radiance picture.
    """
    try:
        content = file.read_bytes()
    except OSError as error:
        raise ValueError(f"cannot read {file}: {error}") from error
    try:
        return _decode(content)
    except ValueError as error:
        raise ValueError(f"{file}: {error}") from error


def _decode(content: bytes) -> NDArray[np.float32]:
    header = _read_header(content)
    values = np.empty((header.scanlines, header.width, 3), np.float32)
    line = np.empty((header.width, 4), np.uint8)
    position = header.begin
    for radiance in values:
        position = _read_scanline(content, position, line)
        radiance[:] = _float_from_rgbe(line) / header.scale
    if header.by_column:
        values = values.transpose(1, 0, 2)
    rows = slice(None, None, -1 if header.flip_rows else 1)
    columns = slice(None, None, -1 if header.flip_columns else 1)
    return np.ascontiguousarray(values[rows, columns])


def _read_header(content: bytes) -> _Header:
    """Parse the lines up to and with the one that gives the size."""
    if not content.startswith(MAGIC):
        raise ValueError(
            "wanted a Radiance picture, which begins with '#?'; this file is "
            + ("empty" if not content else "something else")
        )
    blank = content.find(b"\n\n", 0, MAX_HEADER_BYTES)
    end = content.find(b"\n", blank + 2)
    if blank < 0 or end < 0:
        raise ValueError("the Radiance header does not end: the file is truncated or damaged")
    scale = np.ones(3)
    for line in content[:blank].decode("latin-1").splitlines()[1:]:
        name, _, value = (part.strip() for part in line.partition("="))
        if name == "FORMAT" and value != FORMAT:
            raise ValueError(f"wanted FORMAT={FORMAT}, got {value!r}; convert it to RGBE")
        if name in ("EXPOSURE", "COLORCORR"):
            scale = scale * _positive(name, value)
    size_line = content[blank + 2 : end].decode("latin-1")
    match = SIZE_LINE.fullmatch(size_line)
    if match is None or match[2] == match[5]:
        raise ValueError(f"wanted a size such as '-Y 512 +X 1024', got {size_line[:60]!r}")
    signs = {match[2]: match[1], match[5]: match[4]}
    scanlines, width = int(match[3]), int(match[6])
    check_size(scanlines, width)
    # +Y runs from the bottom up, -X from right to left.
    return _Header(
        scale, scanlines, width, match[2] == "X", signs["Y"] == "+", signs["X"] == "-", end + 1
    )


def _positive(name: str, value: str) -> NDArray[np.float64]:
    """One or three factors, all above zero."""
    try:
        factors = np.array([float(part) for part in value.split()])
        usable = factors.size in (1, 3) and bool(np.all(np.isfinite(factors) & (factors > 0)))
    except ValueError:
        usable = False
    if not usable:
        raise ValueError(f"wanted positive numbers after {name}=, got {value[:60]!r}")
    return factors


def _read_scanline(content: bytes, position: int, line: Bytes) -> int:
    """Fill `line` [W, 4] from the bytes at `position`; return where the next one begins."""
    width = len(line)
    begin = content[position : position + 4]
    if width in RLE_WIDTHS and begin[:2] == b"\x02\x02" and len(begin) == 4 and begin[2] < 128:
        if begin[2] << 8 | begin[3] != width:
            raise ValueError("damaged: a scanline's own width is not that of the picture")
        position += 4
        for component in range(4):
            position = _read_component(content, position, line[:, component])
        return position
    return _read_old_scanline(content, position, line)


def _read_component(content: bytes, position: int, values: Bytes) -> int:
    """One component of a scanline: runs (count > 128, one value) and literals."""
    width, x = len(values), 0
    unpacked = bytearray(width)
    while x < width:
        if position + 1 >= len(content):
            raise ValueError("truncated: the file ends inside a scanline")
        count = content[position]
        if count > MAX_LITERAL:
            count -= MAX_LITERAL
            run = content[position + 1 : position + 2] * count
            position += 2
        else:
            run = content[position + 1 : position + 1 + count]
            position += 1 + count
        if count == 0 or len(run) != count or x + count > width:
            raise ValueError("truncated or damaged: a run leaves its scanline")
        unpacked[x : x + count] = run
        x += count
    values[:] = unpacked
    return position


def _read_old_scanline(content: bytes, position: int, line: Bytes) -> int:
    """A scanline of whole pixels; (1, 1, 1, n) repeats the last one n times.

    Marks that follow each other directly give the digits of one count, base 256, lowest first.
    """
    width, x, shift = len(line), 0, 0
    while x < width:
        count = min(width - x, (len(content) - position) // 4, MAX_LOOK_AHEAD)
        if count == 0:
            raise ValueError("truncated: the file ends inside a scanline")
        pixels = np.frombuffer(content, np.uint8, 4 * count, position).reshape(-1, 4)
        marks = np.flatnonzero((pixels[:, :3] == 1).all(1))
        plain = int(marks[0]) if len(marks) else count
        if plain:
            line[x : x + plain] = pixels[:plain]
            x, position, shift = x + plain, position + 4 * plain, 0
            continue
        repeats = int(pixels[0, 3]) << shift
        if x == 0 or repeats > width - x:
            raise ValueError("damaged: a run leaves its scanline")
        line[x : x + repeats] = line[x - 1]
        x, position, shift = x + repeats, position + 4, shift + 8
    return position


def _float_from_rgbe(packed: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Values of packed pixels [..., 4]."""
    exponent = packed[..., 3:].astype(np.int32)
    half = np.where(exponent > 0, np.float32(0.5), np.float32(0.0))
    mantissa = np.where(exponent > 0, packed[..., :3].astype(np.float32), np.float32(0.0)) + half
    return np.ldexp(mantissa, exponent - EXPONENT_BIAS)


def _rgbe_from_float(rgb: NDArray[np.float32]) -> Bytes:
    """Pack finite values >= 0 [..., 3]; below 2^-128 they become zero."""
    brightest = rgb.max(-1, keepdims=True)
    _, exponent = np.frexp(brightest)
    stored = np.where(brightest > 0, exponent + 128, 0)
    if int(stored.max(initial=0)) > 255:
        raise ValueError("wanted values below 2^127, got larger ones; scale the picture")
    mantissa = np.ldexp(rgb.astype(np.float64), 8 - exponent)
    pixels = np.concatenate([mantissa, stored], -1)
    return np.where(stored > 0, pixels, 0).astype(np.uint8)


def write_hdr(file: Path, rgb: NDArray[np.float32]) -> None:
    """Write linear [H, W, 3] as run-length coded RGBE; replaced if it exists.

    Relative precision is 1/256 of the brightest channel. Reading gives what writing again keeps
    bit for bit.

    Raises:
        ValueError: the picture is empty or holds negative, infinite or NaN values.
    """
    if rgb.ndim != 3 or rgb.shape[-1] != 3 or not rgb.size:
        raise ValueError(f"wanted a picture [H, W, 3], got {list(rgb.shape)}")
    if not np.all(np.isfinite(rgb) & (rgb >= 0)):
        raise ValueError("wanted finite values >= 0; mend the picture before writing it")
    height, width, _ = rgb.shape
    header = f"#?RADIANCE\nFORMAT={FORMAT}\n\n-Y {height} +X {width}\n".encode()
    with file.open("wb") as out:
        out.write(header)
        for line in _rgbe_from_float(rgb):
            out.write(_packed_scanline(line))


def _packed_scanline(line: Bytes) -> bytes:
    """One scanline [W, 4], by component where the format allows it."""
    width = len(line)
    if width not in RLE_WIDTHS:
        return line.tobytes()
    begin = bytes((2, 2, width >> 8, width & 255))
    return begin + b"".join(b"".join(_runs(line[:, component])) for component in range(4))


def _runs(values: Bytes) -> Iterator[bytes]:
    """Cut one component into runs of equal bytes and literals between them."""
    content = values.tobytes()
    edges = np.flatnonzero(np.diff(values)) + 1
    starts, ends = np.r_[0, edges], np.r_[edges, len(values)]
    long = ends - starts >= MIN_RUN
    literal = 0
    for start, end in zip(starts[long].tolist(), ends[long].tolist(), strict=True):
        yield from _literals(content[literal:start])
        for first in range(start, end, MAX_RUN):
            yield bytes((MAX_LITERAL + min(MAX_RUN, end - first), content[start]))
        literal = end
    yield from _literals(content[literal:])


def _literals(content: bytes) -> Iterator[bytes]:
    for first in range(0, len(content), MAX_LITERAL):
        part = content[first : first + MAX_LITERAL]
        yield bytes((len(part),)) + part
