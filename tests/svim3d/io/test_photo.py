"""Photos of every format and mode that Pillow can write, and files that are none."""

import io
import struct
import zlib

import numpy as np
import pytest
import torch
from PIL import Image, ImageCms

from svim3d.io.photo import read_photo

HEIGHT, WIDTH = 24, 40
ORIENTATION = 0x0112
# What a camera stores so that the given EXIF orientation shows the picture upright.
STORED = {
    1: lambda a: a,
    2: lambda a: a[:, ::-1],
    3: lambda a: a[::-1, ::-1],
    4: lambda a: a[::-1],
    5: lambda a: a.swapaxes(0, 1),
    6: lambda a: a.swapaxes(0, 1)[::-1],
    7: lambda a: a.swapaxes(0, 1)[::-1, ::-1],
    8: lambda a: a.swapaxes(0, 1)[:, ::-1],
}


def smooth_colours():
    """An asymmetric picture without detail, so that lossy formats keep it."""
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    return np.stack([60 + 4 * x, 40 + 6 * y, 200 - 2 * x - 2 * y], -1).astype(np.uint8)


def disc():
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    return np.where((x - 15) ** 2 + (y - 12) ** 2 < 80, 255, 0).astype(np.uint8)


def read(file, longest_px=4096):
    events = []
    photo = read_photo(file, lambda kind, text: events.append((kind, text)), longest_px=longest_px)
    return photo, events


def saved(tmp_path, picture, suffix, **how):
    file = tmp_path / f"x.{suffix}"
    picture.save(file, **how)
    return file


def bytes_of(photo):
    return (photo.rgb * 255.0).round().to(torch.uint8).numpy()


def png_chunk(kind, body):
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


def png_16bit(values, colour_type):
    """A 16-bit PNG, which Pillow writes for grey alone."""
    height, width = values.shape[:2]
    rows = b"".join(b"\0" + row.astype(">u2").tobytes() for row in values)
    header = struct.pack(">IIBBBBB", width, height, 16, colour_type, 0, 0, 0)
    return b"".join(
        [
            b"\x89PNG\r\n\x1a\n",
            png_chunk(b"IHDR", header),
            png_chunk(b"IDAT", zlib.compress(rows)),
            png_chunk(b"IEND", b""),
        ]
    )


@pytest.mark.parametrize("suffix", ["png", "tiff", "bmp", "webp"])
def test_lossless_formats_keep_every_value(tmp_path, suffix):
    how = {"lossless": True} if suffix == "webp" else {}
    photo, events = read(saved(tmp_path, Image.fromarray(smooth_colours()), suffix, **how))
    assert np.array_equal(bytes_of(photo), smooth_colours())
    assert photo.mask is None and not events
    assert (photo.height, photo.width) == (HEIGHT, WIDTH)


@pytest.mark.parametrize(("suffix", "error"), [("jpg", 6), ("webp", 10), ("gif", 40)])
def test_lossy_formats_keep_what_they_can(tmp_path, suffix, error):
    picture = Image.fromarray(smooth_colours())
    photo, _ = read(saved(tmp_path, picture, suffix, quality=95, subsampling=0))
    assert np.abs(bytes_of(photo).astype(int) - smooth_colours()).max() <= error


@pytest.mark.parametrize("suffix", ["jpg", "png", "webp", "tiff"])
@pytest.mark.parametrize("orientation", STORED)
def test_every_exif_orientation_lands_on_the_same_pixels(tmp_path, suffix, orientation):
    exif = Image.Exif()
    exif[ORIENTATION] = orientation
    stored = Image.fromarray(np.ascontiguousarray(STORED[orientation](smooth_colours())))
    how = {"quality": 98, "subsampling": 0} if suffix == "jpg" else {}
    how |= {"lossless": True} if suffix == "webp" else {}
    photo, events = read(saved(tmp_path, stored, suffix, exif=exif, **how))
    difference = np.abs(bytes_of(photo).astype(int) - smooth_colours())
    assert difference.max() <= (4 if suffix == "jpg" else 0)
    assert (photo.height, photo.width) == (HEIGHT, WIDTH) and not events


def test_turned_opacity_stays_on_its_colours(tmp_path):
    exif = Image.Exif()
    exif[ORIENTATION] = 6
    rgba = np.dstack([smooth_colours(), disc()])
    stored = Image.fromarray(np.ascontiguousarray(STORED[6](rgba)))
    photo, _ = read(saved(tmp_path, stored, "png", exif=exif))
    assert np.array_equal(photo.mask[..., 0].numpy() * 255, disc())
    assert np.array_equal(bytes_of(photo), smooth_colours())


@pytest.mark.parametrize(
    ("block", "told"),
    [
        (b"Exif\0\0MM\0*\xff\xff\xff\xff", []),
        # An orientation that is a text.
        (
            b"Exif\0\0MM\0*\0\0\0\x08\0\x01\x01\x12\0\x02\0\0\0\x02ab\0\0\0\0\0\0",
            ["metadata_ignored"],
        ),
    ],
)
def test_damaged_exif_is_left_out(tmp_path, block, told):
    how = {"exif": block, "quality": 98, "subsampling": 0}
    photo, events = read(saved(tmp_path, Image.fromarray(smooth_colours()), "jpg", **how))
    assert np.abs(bytes_of(photo).astype(int) - smooth_colours()).max() <= 4
    assert [kind for kind, _ in events] == told


@pytest.mark.parametrize(("colour_type", "channels"), [(0, 1), (2, 3), (4, 2), (6, 4)])
def test_16_bit_is_kept_to_8(tmp_path, colour_type, channels):
    ramp = np.arange(HEIGHT * WIDTH * channels).reshape(HEIGHT, WIDTH, channels) % 256
    (tmp_path / "x.png").write_bytes(png_16bit(ramp * 257, colour_type))
    photo, _ = read(tmp_path / "x.png")
    colours = ramp[..., :-1] if channels in (2, 4) else ramp
    assert np.array_equal(bytes_of(photo), np.broadcast_to(colours, (HEIGHT, WIDTH, 3)))
    if channels in (2, 4):
        assert np.array_equal((photo.mask[..., 0] * 255).round().numpy(), ramp[..., -1])


def test_16_bit_grey_tiff(tmp_path):
    grey = np.arange(HEIGHT * WIDTH).reshape(HEIGHT, WIDTH) % 256
    picture = Image.fromarray((grey * 257).astype(np.uint16))
    photo, _ = read(saved(tmp_path, picture, "tiff"))
    assert np.array_equal(bytes_of(photo)[..., 1], grey)


def test_grey_is_repeated(tmp_path):
    photo, _ = read(saved(tmp_path, Image.fromarray(disc()), "png"))
    assert np.array_equal(bytes_of(photo), np.repeat(disc()[..., None], 3, -1))


def test_one_bit_pictures(tmp_path):
    picture = Image.fromarray(disc()).convert("1", dither=Image.Dither.NONE)
    photo, _ = read(saved(tmp_path, picture, "png"))
    assert np.array_equal(bytes_of(photo)[..., 2], disc())


@pytest.mark.parametrize("mode", ["RGBA", "LA"])
@pytest.mark.parametrize("suffix", ["png", "tiff", "webp"])
def test_opacity_is_coverage(tmp_path, mode, suffix):
    grey = Image.fromarray(smooth_colours()).convert("L")
    colour = Image.merge("RGB", [grey] * 3) if mode == "RGBA" else grey
    picture = Image.merge(mode, [*colour.split(), Image.fromarray(disc() // 2)])
    how = {"lossless": True, "exact": True} if suffix == "webp" else {}
    photo, _ = read(saved(tmp_path, picture, suffix, **how))
    assert np.array_equal((photo.mask[..., 0] * 255).round().numpy(), disc() // 2)
    assert np.array_equal(bytes_of(photo)[..., 0], np.asarray(grey))


def test_all_opaque_is_no_opacity(tmp_path):
    rgba = np.dstack([smooth_colours(), np.full((HEIGHT, WIDTH), 255, np.uint8)])
    photo, _ = read(saved(tmp_path, Image.fromarray(rgba), "png"))
    assert photo.mask is None


@pytest.mark.parametrize("suffix", ["png", "gif"])
def test_transparent_palette_entry(tmp_path, suffix):
    index = (disc() > 0).astype(np.uint8)
    picture = Image.fromarray(index, "P")
    picture.putpalette([9, 9, 9, 200, 100, 50])
    photo, _ = read(saved(tmp_path, picture, suffix, transparency=0))
    assert np.array_equal(photo.mask[..., 0].numpy() > 0.5, index == 1)
    assert (bytes_of(photo)[index == 1] == [200, 100, 50]).all()


def test_transparent_colour_key(tmp_path):
    colours = np.where(disc()[..., None] > 0, [200, 100, 50], [0, 255, 0]).astype(np.uint8)
    picture = Image.fromarray(colours)
    photo, _ = read(saved(tmp_path, picture, "png", transparency=(0, 255, 0)))
    assert np.array_equal(photo.mask[..., 0].numpy() > 0.5, disc() > 0)


def test_cmyk_without_profile(tmp_path):
    picture = Image.fromarray(smooth_colours()).convert("CMYK")
    photo, _ = read(saved(tmp_path, picture, "tiff"))
    assert np.abs(bytes_of(photo).astype(int) - smooth_colours()).max() <= 1
    photo, _ = read(saved(tmp_path, picture, "jpg", quality=98))
    assert np.abs(bytes_of(photo).astype(int) - smooth_colours()).max() <= 8


def test_lab_is_converted(tmp_path):
    lab = ImageCms.createProfile("LAB")
    picture = ImageCms.profileToProfile(
        Image.fromarray(smooth_colours()), ImageCms.createProfile("sRGB"), lab, outputMode="LAB"
    )
    photo, _ = read(saved(tmp_path, picture, "tiff"))
    # 8-bit Lab has steps of about 2 in these colours.
    assert np.abs(bytes_of(photo).astype(int) - smooth_colours()).mean() < 2


def swapped_profile():
    """sRGB with red and green exchanged, under another name."""
    profile = bytearray(ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes())
    count = struct.unpack(">I", profile[128:132])[0]
    entries = {bytes(profile[132 + 12 * i : 136 + 12 * i]): 132 + 12 * i for i in range(count)}
    red, green = entries[b"rXYZ"] + 4, entries[b"gXYZ"] + 4
    profile[red : red + 8], profile[green : green + 8] = (
        profile[green : green + 8],
        profile[red : red + 8],
    )
    # Another name, for sRGB by name is not converted.
    return bytes(profile).replace("sRGB".encode("utf-16-be"), "swap".encode("utf-16-be"))


@pytest.mark.parametrize("suffix", ["png", "tiff", "webp"])
def test_other_profiles_are_converted(tmp_path, suffix):
    rgba = np.dstack([smooth_colours(), disc()])
    how = {"lossless": True, "exact": True} if suffix == "webp" else {}
    file = saved(tmp_path, Image.fromarray(rgba), suffix, icc_profile=swapped_profile(), **how)
    photo, events = read(file)
    expected = smooth_colours()[..., [1, 0, 2]].astype(int)
    assert np.abs(bytes_of(photo).astype(int) - expected).max() <= 2
    assert np.array_equal(photo.mask[..., 0].numpy() * 255, disc())
    assert not events


def test_srgb_profile_changes_nothing(tmp_path):
    profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    file = saved(tmp_path, Image.fromarray(smooth_colours()), "png", icc_profile=profile)
    assert np.array_equal(bytes_of(read(file)[0]), smooth_colours())


@pytest.mark.parametrize("damage", ["nonsense", "for colour"])
def test_unusable_profile_is_told_and_left_out(tmp_path, damage):
    profile = b"no profile at all" if damage == "nonsense" else swapped_profile()
    file = saved(tmp_path, Image.fromarray(disc()), "png", icc_profile=profile)
    photo, events = read(file)
    assert np.array_equal(bytes_of(photo)[..., 0], disc())
    assert [kind for kind, _ in events] == ["profile_ignored"]


@pytest.mark.parametrize("suffix", ["gif", "webp", "png", "tiff"])
def test_first_of_several_pictures(tmp_path, suffix):
    first, second = np.full((8, 8, 3), 250, np.uint8), np.full((8, 8, 3), 5, np.uint8)
    how = {"save_all": True, "append_images": [Image.fromarray(second)]}
    how |= {"lossless": True} if suffix == "webp" else {}
    photo, events = read(saved(tmp_path, Image.fromarray(first), suffix, **how))
    assert (bytes_of(photo) == 250).all()
    assert events == [("first_picture", "the file holds 2 pictures: the first is used")]


@pytest.mark.parametrize("suffix", ["png", "jpg"])
def test_large_pictures_are_averaged_down(tmp_path, suffix):
    y, x = np.mgrid[:512, :1024]
    large = np.stack([x // 5, y // 3, 255 - x // 5], -1).astype(np.uint8)
    how = {"quality": 95, "subsampling": 0} if suffix == "jpg" else {}
    photo, _ = read(saved(tmp_path, Image.fromarray(large), suffix, **how), longest_px=300)
    assert photo.rgb.shape == (128, 256, 3)
    assert (photo.height, photo.width) == (512, 1024)
    means = large.reshape(128, 4, 256, 4, 3).mean((1, 3))
    assert np.abs(bytes_of(photo) - means).max() < (1.0 if suffix == "png" else 4.0)


def test_averaging_is_weighted_by_opacity(tmp_path):
    rgba = np.zeros((8, 8, 4), np.uint8)
    rgba[:, ::2] = [200, 100, 40, 255]  # every other column, transparent black between
    photo, _ = read(saved(tmp_path, Image.fromarray(rgba), "png"), longest_px=4)
    assert np.abs(bytes_of(photo).astype(int) - [200, 100, 40]).max() <= 1
    assert np.abs(photo.mask.numpy() - 0.5).max() < 0.01


def test_one_pixel(tmp_path):
    photo, _ = read(saved(tmp_path, Image.new("RGB", (1, 1), (1, 2, 3)), "png"))
    assert bytes_of(photo).tolist() == [[[1, 2, 3]]]


@pytest.mark.parametrize("content", [b"no picture", b"\x89PNG\r\n\x1a\n", b"GIF89a", b"%!PS-Adobe"])
def test_what_is_no_picture_is_refused(tmp_path, content):
    (tmp_path / "x.png").write_bytes(content)
    with pytest.raises(ValueError, match=r"wanted a photo .* x\.png is"):
        read(tmp_path / "x.png")


@pytest.mark.parametrize("suffix", ["png", "jpg", "webp", "tiff", "bmp", "gif"])
@pytest.mark.parametrize("share", [0.05, 0.5, 0.9])
def test_truncated_files_are_refused(tmp_path, suffix, share):
    noise = np.random.default_rng(0).integers(0, 256, (64, 64, 3), np.uint8)
    buffer = io.BytesIO()
    kind = {"jpg": "jpeg"}.get(suffix, suffix)
    Image.fromarray(noise).save(buffer, kind)
    content = buffer.getvalue()
    (tmp_path / f"x.{suffix}").write_bytes(content[: int(share * len(content))])
    with pytest.raises(ValueError, match=rf"wanted a photo .* x\.{suffix} is"):
        read(tmp_path / f"x.{suffix}")


def test_empty_and_missing_files_are_refused(tmp_path):
    (tmp_path / "x.png").touch()
    with pytest.raises(ValueError, match=r"x\.png is empty"):
        read(tmp_path / "x.png")
    for missing in (tmp_path / "none.png", tmp_path):
        with pytest.raises(ValueError, match="does not exist"):
            read(missing)


def test_claims_of_size_are_not_believed(tmp_path):
    header = struct.pack(">IIBBBBB", 60000, 60000, 8, 2, 0, 0, 0)
    content = b"\x89PNG\r\n\x1a\n" + png_chunk(b"IHDR", header) + png_chunk(b"IDAT", b"")
    (tmp_path / "x.png").write_bytes(content)
    with pytest.raises(ValueError, match="60000"):
        read(tmp_path / "x.png")


@pytest.mark.parametrize("depth", [np.float32, np.int32])
def test_pixels_of_unknown_range_are_refused(tmp_path, depth):
    picture = Image.fromarray(np.full((8, 8), 1 << 20, depth))
    with pytest.raises(ValueError, match=r"x\.tiff: wanted 8 or 16 bits per channel"):
        read(saved(tmp_path, picture, "tiff"))


@pytest.mark.parametrize("suffix", ["png", "jpg", "webp", "tiff", "bmp", "gif"])
def test_damaged_bytes_give_a_picture_or_a_clear_error(tmp_path, suffix):
    buffer = io.BytesIO()
    picture = Image.fromarray(smooth_colours())
    picture.save(buffer, {"jpg": "jpeg"}.get(suffix, suffix))
    sound = buffer.getvalue()
    random = np.random.default_rng(1)
    for _ in range(60):
        content = bytearray(sound)
        for place in random.integers(0, min(len(sound), 400), 4):
            content[place] = random.integers(256)
        (tmp_path / f"x.{suffix}").write_bytes(content)
        try:
            photo, _ = read(tmp_path / f"x.{suffix}", longest_px=64)
        except ValueError as error:
            assert f"x.{suffix}" in str(error)
        else:
            assert bool(photo.rgb.isfinite().all())
