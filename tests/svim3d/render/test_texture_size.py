import math

import pytest
import torch

from svim3d.mesh.texels import rasterize_uv
from svim3d.render.texture_size import size_for_pixels, sufficient_texels

SIZE = 64
# A quad over most of the texture.
UV = torch.tensor([[0.1, 0.1], [0.9, 0.1], [0.9, 0.9], [0.1, 0.9]])
TEXELS = rasterize_uv(UV, torch.tensor([[0, 1, 2], [0, 2, 3]]), SIZE)


def painted(periods):
    """A sine across the texture."""
    u = (TEXELS.pixel % SIZE + 0.5) / SIZE
    return 0.5 + 0.4 * torch.sin(2 * math.pi * periods * u)[:, None].expand(-1, 3)


def size_of(values, most=SIZE):
    return sufficient_texels(values, TEXELS, most=most).texels.size


def test_detail_decides_the_size():
    sizes = [size_of(painted(periods)) for periods in (0.2, 1, 8)]
    assert sizes[2] == SIZE
    assert sizes == sorted(sizes)
    assert sizes[0] < sizes[1] < sizes[2]
    assert size_of(torch.full((len(TEXELS.pixel), 3), 0.3)) == 4  # no smaller one is made


def test_what_is_lost_is_what_is_told():
    found = sufficient_texels(painted(1), TEXELS, most=SIZE)
    assert found.error_db >= 45.0
    # One size less would have been too small.
    stricter = sufficient_texels(painted(1), TEXELS, most=SIZE, wanted_db=found.error_db + 0.1)
    assert stricter.texels.size == 2 * found.texels.size
    assert sufficient_texels(painted(8), TEXELS, most=SIZE).error_db == math.inf


def test_pixels_bound_the_size_whatever_is_lost():
    found = sufficient_texels(painted(8), TEXELS, most=16)
    assert found.texels.size == 16
    assert found.error_db < 30.0


@pytest.mark.parametrize(
    ("pixels", "seen", "size"),
    [
        (1000.0, 1000, 64),  # a pixel for each texel
        (4000.0, 1000, 64),  # more pixels than texels: no larger than it is
        (251.0, 1000, 64),  # a size that would do is not quite half
        (250.0, 1000, 32),
        (1.0, 1000, 4),
        (0.0, 0, 64),  # nothing is seen: nothing is known
    ],
)
def test_as_many_texels_as_pixels(pixels, seen, size):
    assert size_for_pixels(pixels, seen, 64) == size
