import math

import pytest
import torch

from svim3d.synthesis.dice import Dice
from svim3d.synthesis.displacements import (
    MIN_HALF_PX,
    homography_between,
    largest_displacement_px,
    nominal_px,
    object_box,
    pixel_centres,
    random_homography,
    resample,
    smooth_field,
    source_points,
    transformed,
)


def rectangle(size=64, rows=(20, 52), columns=(16, 40)):
    mask = torch.zeros(size, size, 1)
    mask[rows[0] : rows[1], columns[0] : columns[1]] = 1.0
    return mask


def test_box_is_a_square_about_covered_pixels_and_never_too_small():
    box = object_box(rectangle())
    # 24 columns from 16 on and 32 rows from 20 on: a square of 32 about column 28 and row 36.
    assert torch.allclose(box[0], torch.tensor([12 / 32 - 1, 20 / 32 - 1]))
    assert torch.allclose(box[2], torch.tensor([44 / 32 - 1, 52 / 32 - 1]))
    dot = object_box(rectangle(rows=(5, 6), columns=(60, 61)))
    assert torch.allclose(dot[2] - dot[0], torch.full((2,), 4 * MIN_HALF_PX / 256))
    assert torch.equal(object_box(torch.zeros(8, 8, 1))[2], torch.ones(2))
    # In a wide picture it is a square of pixels, not of shares of the picture.
    wide = torch.zeros(64, 128, 1)
    wide[10:50, 40:60] = 1.0
    low, _, high, _ = object_box(wide)
    sides = (high - low) * torch.tensor([128, 64]) / 2
    assert torch.allclose(sides, torch.full((2,), 40.0))


def test_homography_sends_corners_where_they_belong():
    source = torch.tensor([[-0.5, -0.4], [0.5, -0.3], [0.6, 0.5], [-0.4, 0.4]])
    target = source + torch.tensor([[0.05, 0.0], [0.0, 0.04], [-0.03, 0.02], [0.01, -0.06]])
    found = homography_between(source, target)
    assert torch.allclose(transformed(found, source.double()), target.double(), atol=1e-12)
    back = transformed(torch.linalg.inv(found), target.double())
    assert torch.allclose(back, source.double(), atol=1e-12)
    assert torch.allclose(homography_between(source, source), torch.eye(3).double(), atol=1e-12)


@pytest.mark.parametrize("size", [64, 256])
@pytest.mark.parametrize("shape", ["box", "dot"])
def test_random_homography_stays_within_its_reach(size, shape):
    scale = size // 64
    rows, columns = ((20, 52), (16, 40)) if shape == "box" else ((30, 31), (30, 31))
    mask = rectangle(size, tuple(scale * r for r in rows), tuple(scale * c for c in columns))
    corners = object_box(mask).double()
    place = torch.rand(500, 2, generator=torch.Generator().manual_seed(0)).double()
    inside = corners[0] + (corners[2] - corners[0]) * place
    for seed in range(30):
        homography = random_homography(mask, 8.0, Dice.of(seed, 0))
        moved_px = (transformed(homography, inside) - inside) / nominal_px((size, size))
        largest = float(torch.linalg.vector_norm(moved_px, dim=1).max())
        reach = largest_displacement_px(homography, mask)
        assert 3.96 <= reach <= 8.08
        assert 0.8 * reach <= largest <= 1.01 * reach
        assert float(torch.linalg.det(homography)) > 0.4


def test_displacement_is_proportional_to_its_reach():
    mask = rectangle()
    moved = [
        largest_displacement_px(random_homography(mask, px, Dice.of(3, 1)), mask)
        for px in (1.0, 2.0, 8.0)
    ]
    assert moved[1] == pytest.approx(2.0 * moved[0], rel=0.01)
    assert moved[2] == pytest.approx(8.0 * moved[0], rel=0.01)


def test_a_nominal_pixel_is_square_in_pictures_that_are_not():
    x, y = nominal_px((128, 256)).tolist()
    assert x * 256 / 2 == pytest.approx(y * 128 / 2) == pytest.approx(1.0)
    assert (nominal_px((512, 512)) * 256).tolist() == [2.0, 2.0]


def test_smooth_field_is_bounded_smooth_and_the_same_at_any_size():
    fine = smooth_field(Dice.of(0, 0), 2, 6, (128, 128))
    coarse = smooth_field(Dice.of(0, 0), 2, 6, (32, 32))
    assert float(torch.linalg.vector_norm(fine, dim=-1).max()) == pytest.approx(1.0)
    averaged = fine.view(32, 4, 32, 4, 2).mean((1, 3))
    assert float((averaged - coarse).abs().max()) < 0.06
    # A sine of one period per two cells and amplitude 1 changes by at most pi / cells a step.
    steps = torch.linalg.vector_norm(fine[1:] - fine[:-1], dim=-1)
    assert float(steps.max()) < 2.0 * math.pi * 6 / 128
    assert float(fine.std()) > 0.2


def test_resampling_at_the_pixels_changes_nothing_and_a_shift_by_pixels_is_exact():
    picture = torch.rand(12, 20, 3, generator=torch.Generator().manual_seed(0))
    centres = pixel_centres((12, 20), picture)
    assert torch.allclose(resample(picture, centres), picture, atol=1e-5)
    shifted = resample(picture, centres + torch.tensor([2.0 * 2 / 20, -2.0 * 1 / 12]))
    assert torch.allclose(shifted[1:, :-2], picture[:-1, 2:], atol=1e-5)
    assert float(shifted[0].abs().max()) < 1e-5


def test_source_points_undo_the_homography_and_add_the_flow():
    homography = random_homography(rectangle(), 8.0, Dice.of(1, 0))
    flow = 0.01 * smooth_field(Dice.of(0, 0), 2, 4, (64, 64))
    points = source_points(homography, flow)
    again = transformed(homography, (points - flow).double())
    assert torch.allclose(again.float(), pixel_centres((64, 64), flow), atol=1e-6)
