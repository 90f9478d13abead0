"""Boxes, specks and resampling into the square, against closed forms."""

import pytest
import torch

from svim3d.color import linear_from_srgb
from svim3d.placement import Box, bounding_box, centred_square, drop_specks, resampling_matrix


def rectangle(height, width, box):
    mask = torch.zeros(height, width, 1)
    mask[box.top : box.bottom, box.left : box.right] = 1.0
    return mask


def test_equal_scale_copies_pixels():
    box = Box(3, 5, 57, 35)  # 54 long: 0.9 of 60
    colour = (torch.rand(70, 50, 3) * 255).round() / 255
    mask = rectangle(70, 50, box) * (torch.rand(70, 50, 1) * 255).round() / 255
    rgb, placed = centred_square(linear_from_srgb(colour), mask, box, size=60, fill=0.9)
    inner = (slice(3, 57), slice(15, 45))
    assert torch.equal(placed[inner], mask[3:57, 5:35])
    seen = placed[inner] > 0
    difference = (rgb[inner] - colour[3:57, 5:35]).abs() * seen
    assert float(difference.max()) < 0.5 / 255
    placed[inner] = 0
    assert not placed.any()


@pytest.mark.parametrize("scale", [0.03, 0.4, 0.99, 1.0, 1.7, 30.0])
def test_weights_sum_to_one_inside_and_centre_on_the_middle(scale):
    matrix = resampling_matrix(900, 64, scale, 410.25).double()
    assert float(matrix.min()) >= 0.0
    centre = (torch.arange(64) + 0.5 - 32) / scale + 410.25
    reach = max(1.0, 1.0 / scale)
    inside = (centre > reach + 1) & (centre < 899 - reach)
    torch.testing.assert_close(
        matrix.sum(1)[inside], torch.ones(int(inside.sum())).double(), rtol=0, atol=1e-6
    )
    # A tent keeps straight lines straight; averages keep them to a hair.
    ramp = matrix @ (torch.arange(900).double() + 0.5)
    torch.testing.assert_close(ramp[inside], centre[inside].double(), rtol=0, atol=0.2 / scale)
    assert not matrix[(centre < -reach) | (centre > 900 + reach)].any()


def test_fine_stripes_average_to_grey():
    colour = torch.zeros(400, 400, 3)
    colour[:, ::2] = 1.0
    box = Box(0, 0, 400, 400)
    rgb, mask = centred_square(colour, torch.ones(400, 400, 1), box, size=40, fill=1.0)
    inner = rgb[2:-2, 2:-2]
    # Half the light, sRGB-encoded, with no pattern left.
    assert float((inner - 0.735).abs().max()) < 0.01
    assert float(mask[2:-2, 2:-2].min()) == 1.0


@pytest.mark.parametrize("size", [16, 64, 576])
def test_no_fringe_from_what_lies_outside(size):
    box = Box(20, 30, 120, 90)
    mask = rectangle(140, 120, box)
    colour = torch.where(mask > 0, torch.tensor([0.2, 0.4, 0.6]), torch.tensor([1.0, 0.0, 1.0]))
    rgb, placed = centred_square(colour, mask, box, size=size, fill=0.9)
    seen = rgb[placed[..., 0] > 0]
    assert float((linear_from_srgb(seen) - torch.tensor([0.2, 0.4, 0.6])).abs().max()) < 0.006


@pytest.mark.parametrize(
    ("height", "width", "box"),
    [
        (8, 12, Box(2, 2, 6, 10)),
        (3, 2000, Box(1, 0, 2, 2000)),
        (2000, 1, Box(0, 0, 2000, 1)),
        (50, 80, Box(7, 11, 40, 80)),
        (300, 200, Box(0, 0, 300, 200)),
    ],
)
def test_box_is_centred_and_fills_its_share(height, width, box):
    size, fill = 64, 0.9
    mask = rectangle(height, width, box)
    _, placed = centred_square(torch.ones(height, width, 3), mask, box, size=size, fill=fill)
    # Coverage summed along an axis is the box's length in the square, to the rounding of 8 bits.
    scale = fill * size / box.longest
    sides = scale * (box.bottom - box.top), scale * (box.right - box.left)
    covered = float(placed.sum())
    assert covered == pytest.approx(sides[0] * sides[1], rel=0.02, abs=3.0)
    weight = placed[..., 0] / placed.sum()
    middle = torch.arange(size) + 0.5
    assert float((weight.sum(1) * middle).sum()) == pytest.approx(size / 2, abs=0.2)
    assert float((weight.sum(0) * middle).sum()) == pytest.approx(size / 2, abs=0.2)


def test_specks_go_with_their_soft_rims():
    mask = rectangle(100, 100, Box(10, 10, 60, 60))
    mask[80, 80] = 1.0
    mask[79:82, 79:82] = mask[79:82, 79:82].clamp_min(0.3)
    mask[9, 10:60] = 0.4
    clean, sizes, dropped = drop_specks(mask)
    assert sizes == [2500] and dropped == 1
    assert not clean[70:].any()
    assert torch.equal(clean[:70], mask[:70])


def test_objects_of_like_size_stay():
    mask = rectangle(100, 100, Box(10, 10, 30, 60)) + rectangle(100, 100, Box(50, 10, 60, 60))
    clean, sizes, dropped = drop_specks(mask)
    assert torch.equal(clean, mask) and sizes == [1000, 500] and dropped == 0


def test_box_of_covered_pixels():
    mask = rectangle(40, 30, Box(4, 7, 33, 9))
    mask[0, 0] = 0.5
    assert bounding_box(mask) == Box(4, 7, 33, 9)
    assert Box(0, 2, 40, 9).sides_touched(40, 30) == ["top", "bottom"]
    with pytest.raises(ValueError, match="no pixel"):
        bounding_box(torch.zeros(4, 4, 1))
