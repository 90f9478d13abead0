"""Pictures of artifacts become small without becoming something else."""

import io
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from stages.artifacts import EnvironmentLight
from stages.thumbnails import LIGHT, MOST_PICTURES, thumbnails
from svim3d.io.image import write_png
from svim3d.io.thumbnail import BACKGROUND, encode_thumbnail


def decoded(content: bytes) -> np.ndarray:
    with Image.open(io.BytesIO(content)) as picture:
        assert picture.format == "JPEG"
        return np.asarray(picture, np.float32) / 255.0


@pytest.mark.parametrize("most_bytes", [40_000, 4000])
def test_noise_is_made_as_small_as_it_has_to_be(most_bytes):
    noise = torch.rand(300, 500, 3, generator=torch.Generator().manual_seed(0))
    content = encode_thumbnail(noise, longest_px=400, most_bytes=most_bytes)
    height, width, _ = decoded(content).shape
    assert most_bytes / 3 < len(content) <= most_bytes
    assert width <= 400 and abs(width / height - 5 / 3) < 0.05


def test_colours_stay_and_what_is_transparent_is_grey():
    picture = torch.zeros(40, 80, 4)
    picture[:, :40] = torch.tensor([0.8, 0.4, 0.2, 1.0])
    shown = decoded(encode_thumbnail(picture, longest_px=80, most_bytes=9000))
    assert shown.shape == (40, 80, 3)
    assert np.abs(shown[:, 4:36] - [0.8, 0.4, 0.2]).max() < 0.03
    assert np.abs(shown[:, 44:76] - BACKGROUND).max() < 0.03


def test_small_pictures_are_not_blown_up_and_grey_ones_are_shown():
    assert decoded(encode_thumbnail(torch.rand(9, 7, 1), longest_px=99, most_bytes=9000)).shape == (
        9,
        7,
        3,
    )


def test_payload_shows_its_pictures_and_its_light_within_the_bound(tmp_path: Path):
    for number in range(MOST_PICTURES + 2):
        write_png(tmp_path / f"{number}.png", torch.rand(200, 200, 3))
    found = thumbnails(tmp_path, most_bytes=20_000)
    assert list(found) == [f"{number}.png" for number in range(MOST_PICTURES)]
    assert sum(map(len, found.values())) <= 20_000
    assert thumbnails(tmp_path / "missing", most_bytes=20_000) == {}


def test_light_is_shown_as_it_is_displayed(tmp_path: Path):
    # AgX brings middle grey, 0.18, out at one half.
    EnvironmentLight(torch.full((16, 16, 3), 0.18)).save(tmp_path)
    [(name, content)] = thumbnails(tmp_path, most_bytes=20_000).items()
    assert name == LIGHT and np.abs(decoded(content) - 0.5).max() < 0.02
    assert decoded(content).shape == (128, 256, 3)
