"""Animations come back as the frames that were written, as closely as each format allows."""

import re
import subprocess

import numpy as np
import pytest
import torch
from PIL import Image

from svim3d.io import animation
from svim3d.io.animation import find_ffmpeg, write_animation
from svim3d.io.image import read_png


def frames(count: int = 6, height: int = 40, width: int = 60) -> list[torch.Tensor]:
    """A still gradient and a bright disc that moves over it."""
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    still = torch.stack([x / width, y / height, 0.5 * torch.ones_like(x)], -1)
    made = []
    for i in range(count):
        distance = torch.hypot(x - width * (i + 0.5) / count, y - height / 2)
        disc = (6.0 - distance).clamp(0.0, 1.0)[..., None]
        made.append(still + disc * (1.0 - still))
    return made


def psnr_db(one: np.ndarray, other: np.ndarray) -> float:
    return -10.0 * float(np.log10(((one - other) ** 2).mean() + 1e-12))


def has_ffmpeg() -> bool:
    try:
        find_ffmpeg()
    except ValueError:
        return False
    return True


needs_ffmpeg = pytest.mark.skipif(not has_ffmpeg(), reason="no ffmpeg")


def decoded(file) -> bytes:
    options = ["-loglevel", "error", "-i", str(file), "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    return subprocess.run([find_ffmpeg(), *options], check=True, capture_output=True).stdout


def test_gif_keeps_frames_colours_time_and_loop(tmp_path):
    made = frames()
    assert write_animation(tmp_path / "a.gif", iter(made), fps=25.0) == len(made)
    with Image.open(tmp_path / "a.gif") as picture:
        assert picture.n_frames == len(made)
        assert picture.info["loop"] == 0
        assert picture.info["duration"] == 40
        for i, frame in enumerate(made):
            picture.seek(i)
            shown = np.asarray(picture.convert("RGB"), np.float32) / 255.0
            assert psnr_db(shown, frame.numpy()) > 30.0


def test_gif_does_not_flicker_where_nothing_moves(tmp_path):
    write_animation(tmp_path / "a.gif", iter(frames()), fps=10.0)
    shown = []
    with Image.open(tmp_path / "a.gif") as picture:
        for i in range(picture.n_frames):
            picture.seek(i)
            shown.append(np.asarray(picture.convert("RGB"))[:10])
    assert all(np.array_equal(shown[0], other) for other in shown[1:])


def test_gif_keeps_a_small_highlight(tmp_path):
    frame = torch.full((256, 256, 3), 0.2)
    frame[100, 100] = torch.tensor([1.0, 0.5, 0.0])
    write_animation(tmp_path / "a.gif", [frame, frame], fps=10.0)
    with Image.open(tmp_path / "a.gif") as picture:
        shown = np.asarray(picture.convert("RGB"))[100, 100] / 255.0
    assert (
        np.abs(shown - [1.0, 0.5, 0.0]).max() < 0.04
    )  # a colour's leading bits and its neighbours'


def test_equal_frames_give_equal_bytes(tmp_path):
    write_animation(tmp_path / "a.gif", iter(frames()), fps=10.0)
    write_animation(tmp_path / "b.gif", iter(frames()), fps=10.0)
    assert (tmp_path / "a.gif").read_bytes() == (tmp_path / "b.gif").read_bytes()


def test_png_sequence_replaces_a_longer_one(tmp_path):
    made = frames(4)
    write_animation(tmp_path / "turn", iter(frames(6)), fps=10.0)
    assert write_animation(tmp_path / "turn", iter(made), fps=10.0) == 4
    names = sorted(file.name for file in (tmp_path / "turn").iterdir())
    assert names == ["0000.png", "0001.png", "0002.png", "0003.png"]
    for name, frame in zip(names, made, strict=True):
        shown = read_png(tmp_path / "turn" / name)
        torch.testing.assert_close(shown, frame, rtol=0, atol=0.502 / 255)


@needs_ffmpeg
@pytest.mark.parametrize(("height", "width"), [(64, 96), (63, 95), (1, 1)])
def test_video_decodes_to_its_frames(tmp_path, height, width):
    made = frames(5, height, width)
    assert write_animation(tmp_path / "a.mp4", iter(made), fps=24.0) == 5
    even = (height + height % 2, width + width % 2)
    shown = np.frombuffer(decoded(tmp_path / "a.mp4"), np.uint8).reshape(5, *even, 3) / 255.0
    for one, frame in zip(shown, made, strict=True):
        assert psnr_db(one[:height, :width], frame.numpy()) > 30.0


@needs_ffmpeg
def test_video_starts_fast_and_is_reproducible(tmp_path):
    write_animation(tmp_path / "a.mp4", iter(frames()), fps=24.0)
    write_animation(tmp_path / "b.mp4", iter(frames()), fps=24.0)
    content = (tmp_path / "a.mp4").read_bytes()
    assert content == (tmp_path / "b.mp4").read_bytes()
    assert content.index(b"moov") < content.index(b"mdat")


@needs_ffmpeg
def test_failing_frames_leave_nothing_behind(tmp_path):
    def failing():
        yield from frames(2)
        raise RuntimeError("light went out")

    for name in ("a.mp4", "a.gif"):
        with pytest.raises(RuntimeError, match="light went out"):
            write_animation(tmp_path / name, failing(), fps=24.0)
    assert list(tmp_path.iterdir()) == []


@needs_ffmpeg
def test_what_ffmpeg_says_is_passed_on(tmp_path):
    with pytest.raises(ValueError, match=r"ffmpeg could not write .*[Nn]o such file"):
        write_animation(tmp_path / "none" / "a.mp4", iter(frames()), fps=24.0)


def test_frames_are_asked_for_one_by_one(tmp_path):
    alive = []

    def counted():
        for frame in frames(4):
            alive.append(len(list((tmp_path / "turn").iterdir())))
            yield frame

    write_animation(tmp_path / "turn", counted(), fps=10.0)
    assert alive == [0, 1, 2, 3]


def test_video_without_ffmpeg_names_the_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "imageio_ffmpeg", None)
    monkeypatch.setattr(animation.shutil, "which", lambda name: None)
    with pytest.raises(ValueError, match=re.escape("install svim3d[video] or ffmpeg")):
        write_animation(tmp_path / "a.mp4", iter(frames()), fps=24.0)


@pytest.mark.parametrize("name", ["a.gif", "a.mp4", "folder"])
def test_no_frames_are_refused(tmp_path, name):
    if name == "a.mp4" and not has_ffmpeg():
        pytest.skip("no ffmpeg")
    with pytest.raises(ValueError, match="at least one frame"):
        write_animation(tmp_path / name, iter([]), fps=10.0)


def test_uneven_frames_unknown_suffixes_and_rates_are_refused(tmp_path):
    with pytest.raises(ValueError, match="wanted frames of"):
        write_animation(tmp_path / "a.gif", [torch.zeros(4, 4, 3), torch.zeros(4, 6, 3)], fps=10.0)
    with pytest.raises(ValueError, match=r"got a\.avi"):
        write_animation(tmp_path / "a.avi", frames(), fps=10.0)
    with pytest.raises(ValueError, match="above 0"):
        write_animation(tmp_path / "a.gif", frames(), fps=0.0)
