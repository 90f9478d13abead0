"""Heads of pictures: format and size without a pixel, refusals in words."""

import io

import numpy as np
import OpenEXR
import pytest
from PIL import Image

from svim3d.io.exr import read_exr_header
from svim3d.io.photo_header import FORMATS, read_photo_header


@pytest.mark.parametrize("kind", FORMATS)
def test_formats_and_sizes_are_told(kind):
    buffer = io.BytesIO()
    Image.new("RGB", (5, 3)).save(buffer, kind)
    buffer.seek(0)
    header = read_photo_header(buffer)
    assert (header.suffix, header.height, header.width) == (FORMATS[kind], 3, 5)


@pytest.mark.parametrize("content", [b"", b"GIF89a", b"%!PS-Adobe", b"<svg/>", b"\0" * 100])
def test_what_is_no_picture_is_refused(content):
    with pytest.raises(ValueError, match="picture"):
        read_photo_header(io.BytesIO(content))


def test_an_exr_header_counts_all_its_parts(tmp_path):
    plane = np.zeros((3, 5), np.float32)
    parts = [
        OpenEXR.Part({"type": OpenEXR.scanlineimage}, {name: plane for name in names}, name=names)
        for names in ("RG", "B")
    ]
    OpenEXR.File(parts).write(str(tmp_path / "two.exr"))
    assert read_exr_header(tmp_path / "two.exr") == (3, 5, 3)
