import io
import zlib

import numpy as np
import pytest
import torch
from PIL import Image

from svim3d.color import linear_from_srgb
from svim3d.io.image import contact_sheet, decode_image, encode_png, read_png, write_png


@pytest.mark.parametrize("channels", [1, 2, 3, 4])
def test_every_8_bit_value_survives(tmp_path, channels):
    image = torch.arange(256).repeat_interleave(channels).view(16, 16, channels) / 255.0
    write_png(tmp_path / "x.png", image)
    assert torch.equal(read_png(tmp_path / "x.png"), image)


@pytest.mark.parametrize("channels", [1, 3, 4])
def test_every_srgb_value_survives_linear_light(tmp_path, channels):
    encoded = torch.arange(256).repeat_interleave(channels).view(16, 16, channels) / 255.0
    linear = linear_from_srgb(encoded)
    linear[..., 3:] = encoded[..., 3:]
    write_png(tmp_path / "x.png", linear, srgb=True)
    assert torch.equal(read_png(tmp_path / "x.png"), encoded)
    torch.testing.assert_close(read_png(tmp_path / "x.png", srgb=True), linear)


def test_values_outside_are_clamped_and_rounded_to_nearest():
    image = torch.tensor([-1.0, 0.0, 0.499 / 255, 0.501 / 255, 1.0, 7.0]).view(1, 6, 1)
    assert (decode_image(encode_png(image)).flatten() * 255).tolist() == [0, 0, 0, 1, 255, 255]


def test_sixteen_bit_grey_keeps_its_depth():
    values = np.array([[0, 1, 32768, 65535]], np.uint16)
    buffer = io.BytesIO()
    Image.fromarray(values).save(buffer, "PNG")
    read = decode_image(buffer.getvalue())
    assert read.shape == (1, 4, 1)
    assert (read.flatten() * 65535).round().int().tolist() == values.flatten().tolist()


def test_palette_with_transparency_is_expanded():
    picture = Image.new("RGBA", (2, 1), (255, 0, 0, 255))
    picture.putpixel((1, 0), (0, 0, 0, 0))
    buffer = io.BytesIO()
    picture.convert("P").save(buffer, "PNG", transparency=0)
    assert decode_image(buffer.getvalue()).shape == (1, 2, 4)


def test_equal_images_give_equal_bytes():
    image = torch.rand(32, 32, 3, generator=torch.Generator().manual_seed(0))
    assert encode_png(image) == encode_png(image.clone())


def test_what_is_no_picture_is_refused_by_name(tmp_path):
    file = tmp_path / "x.png"
    with pytest.raises(ValueError, match=r"x\.png does not exist"):
        read_png(file)
    file.write_bytes(encode_png(torch.rand(64, 64, 3))[:2000])
    with pytest.raises(ValueError, match=r"x\.png: .*truncated"):
        read_png(file)
    file.write_text("no picture")
    with pytest.raises(ValueError, match=r"x\.png: wanted a PNG"):
        read_png(file)
    with pytest.raises(ValueError, match="put channels last"):
        write_png(file, torch.zeros(3, 64, 64))


def test_contact_sheet_shows_every_picture_unchanged():
    generator = torch.Generator().manual_seed(0)
    sizes = [(32, 48), (32, 48), (20, 48), (32, 48), (16, 16)]
    pictures = [(torch.rand(*size, 3, generator=generator) * 255).round() / 255 for size in sizes]
    sheet = contact_sheet(pictures, [f"{30 * i} deg" for i in range(5)], columns=3)
    assert sheet.shape == (2 * (32 + 14 + 24), 3 * (48 + 8) + 8, 3)
    torch.testing.assert_close(sheet[30:62, 8:56], pictures[0])
    torch.testing.assert_close(sheet[36:56, 120:168], pictures[2])
    assert float(sheet[8:22, 8:56].max()) > 0.8  # its label
    with pytest.raises(ValueError, match="a label for each picture"):
        contact_sheet(pictures, ["one"], columns=3)


def test_huge_and_floating_point_pictures_are_refused(tmp_path):
    file = tmp_path / "x.png"
    header = encode_png(torch.zeros(1, 1, 1))
    content = bytearray(header)
    content[16:24] = (100_000).to_bytes(4, "big") * 2
    content[29:33] = zlib.crc32(content[12:29]).to_bytes(4, "big")
    file.write_bytes(content)
    with pytest.raises(ValueError, match=r"x\.png"):
        read_png(file)
    Image.fromarray(np.ones((4, 4), np.float32)).save(tmp_path / "x.tif")
    with pytest.raises(ValueError, match=r"x\.tif: floating-point"):
        read_png(tmp_path / "x.tif")
