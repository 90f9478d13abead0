"""Radiance pictures: every coding, every orientation, and what is none refused by name."""

import numpy as np
import pytest

from svim3d.io.hdr import read_hdr, write_hdr


def picture(height: int, width: int) -> np.ndarray:
    rng = np.random.default_rng(0)
    values = rng.random((height, width, 3)) * 2.0 ** rng.integers(-20, 20, (height, width, 1))
    values[height // 2 :, : width // 2] = 0.25  # long runs
    values[-1, -1] = 0.0
    return values.astype(np.float32)


def packed(pixels: np.ndarray, size: str, header: str = "") -> bytes:
    """A file of flat pixels."""
    return f"#?RGBE\n{header}\n{size}\n".encode() + pixels.astype(np.uint8).tobytes()


@pytest.mark.parametrize(
    ("height", "width"), [(1, 1), (1, 2), (3, 7), (5, 8), (2, 131), (4, 300), (1, 40000)]
)
def test_round_trip_is_as_precise_as_the_format(tmp_path, height, width):
    values = picture(height, width)
    write_hdr(tmp_path / "a.hdr", values)
    back = read_hdr(tmp_path / "a.hdr")
    # The mantissa of the brightest channel lies in 128..255, its step is below 1/128 of it.
    step = values.max(-1, keepdims=True) / 128.0
    assert np.all(np.abs(back - values) <= 0.5 * step * (1 + 1e-5))
    assert np.all(back[-1, -1] == 0.0)
    write_hdr(tmp_path / "b.hdr", back)
    assert (tmp_path / "a.hdr").read_bytes() == (tmp_path / "b.hdr").read_bytes()


def test_runs_make_the_file_smaller(tmp_path):
    write_hdr(tmp_path / "a.hdr", np.full((64, 128, 3), 0.7, np.float32))
    assert (tmp_path / "a.hdr").stat().st_size < 64 * (4 + 4 * 2 * 2) + 100


def test_known_bytes_give_known_light(tmp_path):
    # (m + 0.5) 2^(e - 136)
    (tmp_path / "a.hdr").write_bytes(packed(np.array([[128, 64, 0, 129]]), "-Y 1 +X 1"))
    expected = [[[128.5 / 128, 64.5 / 128, 0.5 / 128]]]
    assert read_hdr(tmp_path / "a.hdr").tolist() == expected


def test_exposure_and_colour_correction_are_divided_out(tmp_path):
    header = "EXPOSURE=2\nEXPOSURE= 4\nCOLORCORR= 1 2 0.5\nFORMAT=32-bit_rle_rgbe\n"
    file = tmp_path / "a.pic"
    file.write_bytes(packed(np.array([[128, 128, 128, 129]]), "-Y 1 +X 1", header))
    one = 128.5 / 128 / 8
    assert read_hdr(file)[0, 0].tolist() == [one, one / 2, one * 2]


def test_old_runs_repeat_the_last_pixel(tmp_path):
    first, second, mark = [200, 100, 50, 130], [10, 20, 130, 128], [1, 1, 1, 3]
    width = 1 + 3 + 1 + (3 + 3 * 256)
    content = packed(np.array([first, mark, second, mark, mark]), f"-Y 1 +X {width}")
    (tmp_path / "a.hdr").write_bytes(content)
    flat = np.array([first] * 4 + [second] * (width - 4))
    (tmp_path / "b.hdr").write_bytes(packed(flat, f"-Y 1 +X {width}"))
    assert np.array_equal(read_hdr(tmp_path / "a.hdr"), read_hdr(tmp_path / "b.hdr"))


@pytest.mark.parametrize("y", "-+")
@pytest.mark.parametrize("x", "-+")
@pytest.mark.parametrize("columns_first", [False, True])
def test_all_eight_orientations(tmp_path, y, x, columns_first):
    upright = picture(3, 5)
    write_hdr(tmp_path / "a.hdr", upright)
    pixels = np.frombuffer((tmp_path / "a.hdr").read_bytes()[-60:], np.uint8).reshape(3, 5, 4)
    stored = pixels[:: -1 if y == "+" else 1, :: -1 if x == "-" else 1]
    axes = [f"{y}Y 3", f"{x}X 5"]
    if columns_first:
        stored, axes = stored.transpose(1, 0, 2), axes[::-1]
    (tmp_path / "b.hdr").write_bytes(packed(stored, " ".join(axes)))
    assert np.array_equal(read_hdr(tmp_path / "b.hdr"), read_hdr(tmp_path / "a.hdr"))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "is empty"),
        (b"dear diary\n\n-Y 1 +X 1\n", "something else"),
        (b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n", "does not end"),
        (b"#?RADIANCE\nFORMAT=32-bit_rle_xyze\n\n-Y 1 +X 1\nabcd", "xyze"),
        (b"#?RADIANCE\n\nwide\nabcd", "wanted a size"),
        (b"#?RADIANCE\n\n-Y 1 +Y 1\nabcd", "wanted a size"),
        (b"#?RADIANCE\n\n-Y 0 +X 8\n", "0 x 8"),
        (b"#?RADIANCE\n\n-Y 1000000000 +X 1000000000\nabcd", "at most"),
        (b"#?RADIANCE\nEXPOSURE=0\n\n-Y 1 +X 1\nabcd", "EXPOSURE"),
        (b"#?RADIANCE\nEXPOSURE=bright\n\n-Y 1 +X 1\nabcd", "EXPOSURE"),
        (b"#?RADIANCE\nCOLORCORR=1 2\n\n-Y 1 +X 1\nabcd", "COLORCORR"),
        (b"#?RADIANCE\n\n-Y 1 +X 2\nabcdabc", "truncated"),
        (b"#?RADIANCE\n\n-Y 1 +X 8\n\x02\x02\x00\x09", "own width"),
        (b"#?RADIANCE\n\n-Y 1 +X 8\n\x02\x02\x00\x08\x88", "truncated"),
        (b"#?RADIANCE\n\n-Y 1 +X 8\n\x02\x02\x00\x08\x00\x01", "damaged"),
        (b"#?RADIANCE\n\n-Y 1 +X 8\n\x02\x02\x00\x08\x89\x01", "leaves its scanline"),
        (b"#?RADIANCE\n\n-Y 1 +X 8\n\x01\x01\x01\x02", "leaves its scanline"),
    ],
)
def test_what_is_no_whole_picture_is_refused_by_name(tmp_path, content, message):
    (tmp_path / "bad.hdr").write_bytes(content)
    with pytest.raises(ValueError, match=rf"bad\.hdr.*{message}"):
        read_hdr(tmp_path / "bad.hdr")


@pytest.mark.parametrize("share", [0.3, 0.6, 0.99])
def test_every_truncation_is_refused(tmp_path, share):
    write_hdr(tmp_path / "a.hdr", picture(16, 32))
    content = (tmp_path / "a.hdr").read_bytes()
    (tmp_path / "b.hdr").write_bytes(content[: int(share * len(content))])
    with pytest.raises(ValueError, match=r"b\.hdr: truncated"):
        read_hdr(tmp_path / "b.hdr")


def test_what_the_format_cannot_hold_is_not_written(tmp_path):
    for value in (-1.0, np.nan, np.inf):
        with pytest.raises(ValueError, match="finite values >= 0"):
            write_hdr(tmp_path / "a.hdr", np.full((1, 1, 3), value, np.float32))
    with pytest.raises(ValueError, match=r"2\^127"):
        write_hdr(tmp_path / "a.hdr", np.full((1, 1, 3), 3e38, np.float32))
    with pytest.raises(ValueError, match="wanted a picture"):
        write_hdr(tmp_path / "a.hdr", np.zeros((0, 4, 3), np.float32))
