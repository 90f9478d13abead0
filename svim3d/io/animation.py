"""Moving pictures: GIF, MP4 and folders of PNG, written frame by frame.

Frames are display-encoded [H, W, 3] in [0, 1], all of one size; no format here holds HDR.
"""

import shutil
import subprocess
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import IO

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from svim3d.io.image import MAX_8BIT, PALETTE_BITS, palette_of_histogram, write_gif, write_png

Frame = Float[Tensor, "_ _ 3"]
Pixels = NDArray[np.uint8]

VIDEO_SUFFIXES = (".mp4", ".mov")
CONSTANT_RATE_FACTOR = "16"  # of H.264; the eye sees no loss, edges stay above 30 dB
MAX_MESSAGE = 500  # characters of what ffmpeg says when it fails
FRAME_NAME = "{:04d}.png"


def write_animation(file: Path, frames: Iterable[Frame], *, fps: float) -> int:
    """Write frames as they come; the number of frames is returned.

    Only one frame is held in memory (a GIF also keeps its packed frames). A file is replaced if it
    exists; nothing is left behind if the frames fail on the way.

    Args:
        file: `.gif` (256 colours shared by all frames, loops), `.mp4` or `.mov` (H.264, needs
            ffmpeg; odd sides are padded by one pixel), or a folder for a numbered PNG sequence.
        frames: display-encoded.
        fps: frames per second; a GIF rounds the time of a frame to 1/100 s.

    Raises:
        ValueError: there are no frames, they differ in size, the suffix is unknown, or there is no
            ffmpeg for a video.
    """
    if not fps > 0:
        raise ValueError(f"wanted frames per second above 0, got {fps}")
    suffix = file.suffix.lower()
    if suffix == "" or file.is_dir():
        return _write_sequence(file, frames)
    if suffix != ".gif" and suffix not in VIDEO_SUFFIXES:
        raise ValueError(f"wanted .gif, .mp4, .mov or a folder, got {file.name}")
    partial = file.with_name(f".{file.stem}.partial{suffix}")
    try:
        write = _write_gif if suffix == ".gif" else _write_video
        count = write(partial, _pixels(frames), fps)
        partial.replace(file)
    finally:
        partial.unlink(missing_ok=True)
    return count


def _write_sequence(folder: Path, frames: Iterable[Frame]) -> int:
    """Numbered PNG files; those of an earlier, longer sequence are removed."""
    folder.mkdir(parents=True, exist_ok=True)
    count = 0
    for count, frame in enumerate(frames, 1):
        write_png(folder / FRAME_NAME.format(count - 1), frame)
    if not count:
        raise ValueError("wanted at least one frame, got none")
    index = count
    while (stale := folder / FRAME_NAME.format(index)).is_file():
        stale.unlink()
        index += 1
    return count


def _pixels(frames: Iterable[Frame]) -> Iterator[Pixels]:
    """8-bit frames, rounded to nearest, all of the first one's size."""
    shape = None
    for frame in frames:
        shape = shape or tuple(frame.shape)
        if tuple(frame.shape) != shape:
            raise ValueError(f"wanted frames of {shape}, got one of {tuple(frame.shape)}")
        pixels = (frame.detach().cpu().float().clamp(0.0, 1.0) * MAX_8BIT).round()
        yield pixels.to(torch.uint8).numpy()
    if shape is None:
        raise ValueError("wanted at least one frame, got none")


def _write_gif(file: Path, frames: Iterator[Pixels], fps: float) -> int:
    """One palette for all frames, so that what stands still does not flicker.

    The palette is known only after the last frame; until then the frames wait on the disk.
    """
    levels = 1 << PALETTE_BITS
    histogram = np.zeros(levels**3, np.int64)
    count = 0
    with tempfile.TemporaryFile() as waiting:
        for frame in frames:
            count += 1
            waiting.write(frame.tobytes())
            bins = (frame >> (8 - PALETTE_BITS)).astype(np.int64)
            index = (bins[..., 0] * levels + bins[..., 1]) * levels + bins[..., 2]
            histogram += np.bincount(index.ravel(), minlength=len(histogram))
            shape = frame.shape
        waiting.seek(0)
        palette = palette_of_histogram(histogram)
        write_gif(file, _waiting_frames(waiting, count, shape), palette, 1.0 / fps)
    return count


def _waiting_frames(
    waiting: IO[bytes], count: int, shape: tuple[int, ...]
) -> Iterator[NDArray[np.uint8]]:
    """Read the frames back, one by one."""
    size = int(np.prod(shape))
    for _ in range(count):
        yield np.frombuffer(waiting.read(size), np.uint8).reshape(shape)


def _write_video(file: Path, frames: Iterator[Pixels], fps: float) -> int:
    """H.264 in 4:2:0 with Rec.709 colours, as every browser plays it; equal frames, equal bytes."""
    ffmpeg = find_ffmpeg()
    first = _even(next(frames))
    height, width, _ = first.shape
    with tempfile.TemporaryFile() as said:  # a pipe would block once it is full
        process = subprocess.Popen(
            [ffmpeg, "-loglevel", "error", "-y", *_video_options(width, height, fps), str(file)],
            stdin=subprocess.PIPE,
            stderr=said,
        )
        assert process.stdin is not None  # asked for above
        count = 1
        try:
            process.stdin.write(first.tobytes())
            for frame in frames:
                process.stdin.write(_even(frame).tobytes())
                count += 1
        except BrokenPipeError:
            pass  # ffmpeg has given up; what it said is reported below
        except BaseException:
            process.kill()
            process.communicate()
            raise
        process.communicate()
        if process.returncode:
            said.seek(0)
            message = said.read().decode(errors="replace")[-MAX_MESSAGE:].strip()
            raise ValueError(f"ffmpeg could not write {file.name}: {message}")
    return count


def _video_options(width: int, height: int, fps: float) -> list[str]:
    """Arguments between `ffmpeg` and the file: raw frames from standard input to H.264."""
    source = f"-f rawvideo -pix_fmt rgb24 -s {width}x{height} -framerate {fps:g} -i -"
    colours = "-vf scale=out_color_matrix=bt709:out_range=tv -pix_fmt yuv420p"
    tags = "-color_primaries bt709 -color_trc bt709 -colorspace bt709 -color_range tv"
    # One thread and no version in the file make equal frames give equal bytes.
    codec = f"-c:v libx264 -preset medium -crf {CONSTANT_RATE_FACTOR} -threads 1"
    return f"{source} {colours} {tags} {codec} -fflags +bitexact -movflags +faststart".split()


def _even(frame: Pixels) -> Pixels:
    """Repeat the last row or column where a side is odd, as 4:2:0 halves both."""
    height, width, _ = frame.shape
    return np.pad(frame, ((0, height % 2), (0, width % 2), (0, 0)), "edge")


def find_ffmpeg() -> str:
    """The ffmpeg of the `video` extra, else the system's.

    Raises:
        ValueError: there is none; says how to get one.
    """
    try:
        import imageio_ffmpeg

        return str(imageio_ffmpeg.get_ffmpeg_exe())
    except (ImportError, RuntimeError):
        found = shutil.which("ffmpeg")
    if found is None:
        raise ValueError(
            "wanted ffmpeg to write a video, found none; install svim3d[video] or ffmpeg, "
            "or write a .gif or a folder of PNG"
        )
    return found
