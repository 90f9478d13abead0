"""Homographies from corner shifts: closed forms, inverse, bounds; reading and its gradient."""

import math

import pytest
import torch

from svim3d.render.view_warps import (
    CORNERS,
    MAX_SHIFT,
    ViewCorrections,
    apply,
    bounded,
    corner_basis,
    homographies,
    inverse_shifts,
    is_inside,
    pixel_positions,
    pixel_shifts,
    read,
    read_through,
)

CORNER = torch.tensor(CORNERS, dtype=torch.float64)


def random_shifts(views=5, size=0.1, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return size * torch.randn(views, 4, 2, generator=generator, dtype=torch.float64)


def random_points(count=40, seed=1):
    generator = torch.Generator().manual_seed(seed)
    return 2 * torch.rand(count, 2, generator=generator, dtype=torch.float64) - 1


def test_corners_go_where_their_shifts_say():
    shifts = random_shifts()
    moved = apply(homographies(shifts)[:, None], CORNER.expand(5, 4, 2))
    torch.testing.assert_close(moved, CORNER + shifts)


def test_no_shift_is_the_identity_exactly():
    assert torch.equal(homographies(torch.zeros(3, 4, 2)), torch.eye(3).expand(3, 3, 3))


def test_translation_and_scale_have_their_matrices():
    shift = torch.tensor([0.1, -0.2], dtype=torch.float64)
    want = torch.eye(3, dtype=torch.float64)
    want[:2, 2] = shift
    torch.testing.assert_close(homographies(shift.expand(1, 4, 2))[0], want)
    grown = homographies(0.25 * CORNER[None])[0]
    torch.testing.assert_close(grown, torch.diag(grown.new_tensor([1.25, 1.25, 1.0])))


def test_a_known_projective_matrix_comes_back_from_its_corners():
    matrix = torch.tensor(
        [[1.03, 0.02, 0.05], [-0.04, 0.97, 0.01], [0.03, -0.02, 1.0]], dtype=torch.float64
    )
    shifts = apply(matrix, CORNER) - CORNER
    torch.testing.assert_close(homographies(shifts[None])[0], matrix)


def test_inverse_undoes_a_warp_at_every_point():
    shifts, points = random_shifts(), random_points()
    there = apply(homographies(shifts)[:, None], points.expand(5, 40, 2))
    back = apply(homographies(inverse_shifts(shifts))[:, None], there)
    torch.testing.assert_close(back, points.expand(5, 40, 2))


def test_bounded_warps_keep_their_kind_and_a_positive_determinant():
    shifts = random_shifts(200, size=3.0)
    limited = bounded(shifts, MAX_SHIFT * 0.99)
    assert float(limited.norm(dim=-1).max()) <= MAX_SHIFT
    assert bool((torch.linalg.det(homographies(limited)) > 0).all())
    ratio = limited / shifts
    torch.testing.assert_close(ratio, ratio[:, :1, :1].expand_as(ratio))
    small = random_shifts(size=0.01)
    assert torch.equal(bounded(small, 0.2), small)


def test_corner_basis_is_the_derivative_at_the_identity():
    points = random_points(7)

    def moved(shifts):
        return apply(homographies(shifts.view(1, 4, 2)), points)

    want = torch.autograd.functional.jacobian(moved, torch.zeros(8, dtype=torch.float64))
    torch.testing.assert_close(corner_basis(points), want)


def test_pixel_shifts_are_those_of_the_homography_of_their_view():
    shifts, points = random_shifts(), random_points()
    view = torch.arange(40) % 5
    want = apply(homographies(shifts)[view], points) - points
    torch.testing.assert_close(pixel_shifts(shifts, view, points), want)
    still = pixel_shifts(torch.zeros_like(shifts), view, points)
    assert not bool(still.any())


def test_positions_of_pixels_are_centres():
    want = torch.tensor([[-0.75, -0.5], [0.75, -0.5], [-0.75, 0.5], [-0.75, -0.5]])
    assert torch.equal(pixel_positions(torch.tensor([0, 3, 4, 8]), 2, 4), want)


def a_ramp(height=6, width=8):
    """Two views whose values are linear in the position: bilinear reading is exact on them."""
    position = pixel_positions(torch.arange(2 * height * width), height, width).double()
    x, y = position.unbind(1)
    view = torch.arange(2).repeat_interleave(height * width)
    return torch.stack([3 * x + view, 2 * y - x], 1), view, position


def test_reading_is_exact_on_ramps_and_repeats_the_border():
    pictures, view, position = a_ramp()
    pixels = torch.arange(96)
    shift = torch.tensor([0.1, -0.13], dtype=torch.float64).expand(96, 2)
    found = read(pictures, pixels, shift, 6, 8)
    x, y = (position + shift).unbind(1)
    x, y = x.clamp(-1 + 1 / 8, 1 - 1 / 8), y.clamp(-1 + 1 / 6, 1 - 1 / 6)
    torch.testing.assert_close(found, torch.stack([3 * x + view, 2 * y - x], 1))


def test_reading_without_a_shift_changes_no_bit():
    pictures = torch.rand(2 * 30, 4, generator=torch.Generator().manual_seed(0))
    assert torch.equal(read(pictures, torch.arange(60), torch.zeros(60, 2), 5, 6), pictures)


def test_gradients_agree_with_finite_differences():
    generator = torch.Generator().manual_seed(0)
    pictures = torch.rand(2 * 42, 3, generator=generator, dtype=torch.float64, requires_grad=True)
    shifts = random_shifts(2, size=0.05).requires_grad_()
    pixels = torch.tensor([8, 16, 20, 50, 65, 70])

    def shown(shifts, pictures):
        position = pixel_positions(pixels, 6, 7).double()
        return read(pictures, pixels, pixel_shifts(shifts, pixels // 42, position), 6, 7)

    assert torch.autograd.gradcheck(shown, (shifts, pictures))


def test_what_leaves_the_picture_has_no_weight_and_views_have_their_own():
    pictures = torch.ones(2 * 16, 1)
    # Half a pixel to the right: the last column's centres come to lie on the border, then beyond.
    for pixels_right, kept in ((0.4, 16), (0.6, 12)):
        shifts = torch.zeros(2, 4, 2)
        shifts[1, :, 0] = pixels_right * 2 / 4
        seen = ViewCorrections(shifts, torch.tensor([1.0, 0.25]))
        _, weight = read_through(seen, pictures, torch.arange(32), 4, 4)
        assert weight[:16].tolist() == [[1.0]] * 16
        assert float(weight[16:].sum()) == pytest.approx(0.25 * kept)
    assert is_inside(torch.tensor([[1.0, -1.0], [1.01, 0.0]])).tolist() == [True, False]


def test_a_roll_keeps_distances():
    angle = math.radians(3)
    turn = torch.tensor(
        [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]],
        dtype=torch.float64,
    )
    points = random_points()
    moved = apply(homographies((CORNER @ turn.T - CORNER)[None]), points)
    torch.testing.assert_close(torch.cdist(moved, moved), torch.cdist(points, points))
