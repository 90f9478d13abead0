"""Evidence against closed forms: waves, discs, rods, spheres, clusters."""

import math

import pytest
import torch
from sphere_orbit import RADIUS, sphere_cameras, sphere_images

from svim3d.render.view_evidence import (
    MOST_MODES,
    averaging_room,
    count_modes,
    frontal_pixels,
    hull_evidence,
    outline,
    read_back_error,
)

SIZE, VIEWS = 96, 2


def everywhere(size=SIZE):
    return torch.ones(VIEWS, size, size, 1, dtype=torch.bool)


def wave(period_px, amplitude=0.3, size=SIZE):
    """Columns of a cosine, area-averaged over each pixel as pictures are."""
    edge = torch.arange(size + 1, dtype=torch.float64) * (2.0 * math.pi / period_px)
    mean = torch.diff(torch.sin(edge)) * period_px / (2.0 * math.pi)
    return (0.5 + amplitude * mean.float()).expand(VIEWS, size, size)[..., None].contiguous()


def sinc(x):
    return math.sin(math.pi * x) / (math.pi * x)


@pytest.mark.parametrize(("period", "room"), [(64, 4), (48, 8), (35, 5), (27, 3)])
def test_error_of_a_wave_matches_the_closed_form(period, room):
    """Averages over f pixels damp a wave of P pixels by sinc(f / P), for pixels' sinc(1 / P).

    Between two averages, at a share u of the way, stands (1 - u) of the one and u of the other.
    """
    size = 8 * period * room  # whole periods and whole cells
    image = wave(period, 0.3, size)[:1, :1].expand(1, 2 * room, -1, -1)
    damping, turn = sinc(room / period) / sinc(1.0 / period), 2.0 * math.pi * room / period
    shares = [(j + 0.5 * (room % 2 == 0)) / room for j in range(room)]
    kept = [damping**2 * ((1 - u) ** 2 + u**2 + 2 * u * (1 - u) * math.cos(turn)) for u in shares]
    common = [
        damping * ((1 - u) * math.cos(turn * u) + u * math.cos(turn * (1 - u))) for u in shares
    ]
    lost = sum(1.0 - 2.0 * c + k for c, k in zip(common, kept, strict=True)) / room
    want = 0.5 * (0.3 * sinc(1.0 / period)) ** 2 * lost
    error = read_back_error(image, torch.ones_like(image, dtype=torch.bool), room)
    # At the picture's ends, crests of the wave, the last average is continued.
    assert error**2 == pytest.approx(want, rel=0.01)


def test_room_ends_where_the_wave_is_lost():
    tolerance = 10.0 ** (-40.0 / 20.0)
    rooms = [averaging_room(wave(p), everywhere(), tolerance) for p in (4.0, 16.0, 32.0, 96.0)]
    assert rooms == sorted(rooms)
    assert rooms[0] == 1
    assert rooms[-1] >= 6
    for period, room in zip((16.0, 32.0, 96.0), rooms[1:], strict=True):
        assert read_back_error(wave(period), everywhere(), room) <= tolerance or room == 1


def test_a_constant_has_all_the_room_up_to_any_outline():
    images = torch.rand(VIEWS, SIZE, SIZE, 3, generator=torch.Generator().manual_seed(0))
    row, column = torch.meshgrid(torch.arange(SIZE), torch.arange(SIZE), indexing="ij")
    disc = ((row - 40) ** 2 + (column - 50) ** 2 < 900).expand(VIEWS, -1, -1)[..., None]
    images = torch.where(disc, torch.tensor([0.2, 0.5, 0.7]), images)
    assert read_back_error(images, disc, 16) < 1e-5
    assert averaging_room(images, disc, 1e-5) == 16
    assert averaging_room(images, torch.zeros_like(disc), 1e-5) == 16
    # Without a mask the noise around it counts.
    assert averaging_room(images, everywhere(), 0.05) == 1


def test_modes_are_counted_to_a_tolerance():
    noise = 0.002 * torch.randn(5000, 1, generator=torch.Generator().manual_seed(0))
    place = torch.arange(5000)[:, None]
    for wanted in (1, 2, 3):
        values = 0.2 + 0.3 * (place % wanted) + noise
        assert count_modes(values, 0.005) == wanted
    assert count_modes(place / 5000.0, 0.005) == MOST_MODES + 1
    assert count_modes(torch.zeros(0, 1), 0.005) == 1


def soft_mask(signed_px):
    """Coverage of pixels from the distance to the outline at their centres, positive inside."""
    return (signed_px + 0.5).clamp(0.0, 1.0)[None, ..., None]


def grid(size):
    axis = torch.arange(size) + 0.5
    return torch.meshgrid(axis, axis, indexing="ij")


def test_a_disc_is_as_simple_and_as_thick_as_can_be():
    row, column = grid(128)
    radius = 40.0
    found = outline(soft_mask(radius - ((row - 64) ** 2 + (column - 61) ** 2).sqrt()))
    assert found.complexity == pytest.approx(4.0 * math.pi, rel=0.04)
    assert found.extent_px == pytest.approx(2 * radius, abs=1.0)
    assert found.thickness_px == pytest.approx(2 * radius, rel=0.1)


@pytest.mark.parametrize("width", [4, 7, 12])
def test_a_rod_is_as_thick_as_it_is(width):
    row, column = grid(128)
    disc = 30.0 - ((row - 40) ** 2 + (column - 64) ** 2).sqrt()
    rod = torch.minimum(width / 2 - (column - 64).abs(), 60.0 - (row - 60).abs())
    found = outline(soft_mask(torch.maximum(disc, rod)))
    assert abs(found.thickness_px - width) <= 1.0
    plain = outline(soft_mask(disc))
    assert found.complexity > 1.3 * plain.complexity


def test_an_empty_view_says_nothing():
    found = outline(torch.zeros(2, 32, 32, 1))
    assert (found.extent_px, found.thickness_px) == (0.0, 0.0)


def test_frontal_pixels_of_a_sphere_fill_the_disc_of_their_cosine():
    cameras = sphere_cameras(views=2, size=64)
    images = sphere_images(cameras)
    frontal = frontal_pixels(cameras, images["mask"], images["normal_world"])
    # Seen from afar a cosine of 1/2 lies at sqrt(3)/2 of the radius: 3/4 of the disc. From a
    # distance d the sphere shows less of its rim: cosine and place change together.
    share = float(frontal.sum() / images["mask"].sum())
    distance = 2.2
    # Ray at angle t from the axis meets the sphere at cosine c: R sqrt(1 - c^2) = d sin t.
    sines = [RADIUS * math.sqrt(1.0 - c * c) / distance for c in (0.5, 0.0)]
    inner, outer = (s / math.sqrt(1.0 - s * s) for s in sines)
    assert share == pytest.approx((inner / outer) ** 2, rel=0.03)


def test_exact_masks_want_the_strict_hull_and_shifted_ones_do_not():
    cameras = sphere_cameras(views=15, size=64)
    mask = sphere_images(cameras)["mask"]
    exact = hull_evidence(cameras, mask, 0.55)
    assert exact.rejections == 0
    assert exact.overlap[0] > 0.97
    assert exact.area == pytest.approx(4.0 * math.pi * RADIUS**2, rel=0.08)
    shifts = torch.randint(-2, 3, (15, 2), generator=torch.Generator().manual_seed(1)).tolist()
    moved = torch.stack([m.roll(tuple(s), (0, 1)) for m, s in zip(mask, shifts, strict=True)])
    found = hull_evidence(cameras, moved, 0.55)
    assert found.rejections >= 1
    assert found.overlap[found.rejections] > found.overlap[0]


def test_masks_that_share_nothing_have_no_hull_and_no_area():
    cameras = sphere_cameras(views=4, size=16)
    nothing = hull_evidence(cameras, torch.zeros(4, 16, 16, 1), 0.55)
    assert (nothing.rejections, nothing.area, nothing.overlap[0]) == (0, 0.0, 0.0)
