"""Warps found again: known homographies, what is not determined, what all views have in common."""

import math

import pytest
import torch

from svim3d.cameras import look_at_origin, orbit_angles, orbit_cameras
from svim3d.render.registration import (
    FEATURES,
    CommonMotion,
    ViewAlignment,
    determined_step,
    features,
)
from svim3d.render.view_warps import CORNERS, homographies, pixel_positions, pixel_shifts

SIZE, VIEWS = 48, 12
CAMERAS = orbit_cameras(orbit_angles(VIEWS, 10.0, 10.0), radius=2.2, fov_y_deg=33.8, size=SIZE)
PIXELS = torch.arange(VIEWS * SIZE * SIZE)
VIEW = PIXELS // SIZE**2
WIDTHS = {"basecolor": 3, "mask": 1, "normal_world": 3, "roughness": 1, "metallic": 1}


def pictures_at(position, colour):
    """A soft disc of some colour pattern, at any positions: exact wherever it is looked at."""
    x, y = position.unbind(-1)
    mask = torch.sigmoid(20 * (0.7 - (x * x + y * y).sqrt()))
    planes = {name: torch.zeros(*position.shape[:-1], width) for name, width in WIDTHS.items()}
    planes["mask"] = mask[..., None]
    planes["basecolor"] = colour(x, y)[..., None].expand(*position.shape[:-1], 3) * mask[..., None]
    return planes


def checks(x, y):
    return 0.5 + 0.3 * torch.sin(9 * x + 2) * torch.sin(7 * y) + 0.1 * torch.sin(13 * (x + y))


def plain(x, y):
    return torch.full_like(x, 0.5)


def drawn(shifts, colour):
    """Pictures of V views whose content lies where the warps put it."""
    position = pixel_positions(PIXELS, SIZE, SIZE)
    # A view shows at p what belongs at the inverse warp of p; fixed-point iteration finds it.
    found = position.clone()
    for _ in range(30):
        found = position - pixel_shifts(shifts, VIEW, found)
    images = pictures_at(found, colour)
    return {name: image.view(VIEWS, SIZE, SIZE, -1) for name, image in images.items()}


def true_shifts(size=0.05, seed=0):
    shifts = size * torch.randn(VIEWS, 4, 2, generator=torch.Generator().manual_seed(seed))
    shifts[-1] = 0.0
    return shifts


def aligned(shifts, colour, *, rounds=25, limit=0.3):
    """An alignment that has met the true object so often."""
    alignment = ViewAlignment(CAMERAS, drawn(shifts, colour), reference=VIEWS - 1, limit=limit)
    truth = features(pictures_at(pixel_positions(PIXELS, SIZE, SIZE), colour))
    for round_ in range(rounds):
        alignment.reach_px = max(1.0, 2.0 - 0.2 * round_)
        alignment.observe(PIXELS, truth)
        alignment.update(0.7)
    return alignment


def test_known_homographies_come_back_to_a_twentieth_of_a_pixel():
    shifts = true_shifts()
    found = aligned(shifts, checks).shifts
    position = pixel_positions(PIXELS, SIZE, SIZE)
    on_object = position.norm(dim=1) < 0.7
    # A motion of the object would explain some of what is left: it is here no warp by design.
    left = CommonMotion.of(CAMERAS, VIEWS - 1).without((found - shifts).flatten(1))
    start, end = (
        float(pixel_shifts(s, VIEW, position)[on_object].norm(dim=1).mean()) * SIZE / 2
        for s in (shifts, left.view_as(shifts))
    )
    assert start > 0.8
    assert end < 0.05


def test_the_reference_is_never_warped():
    shifts = true_shifts()
    shifts[-1] = 0.03
    assert not bool(aligned(shifts, checks, rounds=3).shifts[-1].any())


def test_shifts_keep_their_bound_and_views_their_orientation():
    found = aligned(true_shifts(size=0.3), checks, limit=0.08).shifts
    assert float(found.norm(dim=-1).max()) == pytest.approx(0.08, rel=1e-5)
    assert bool((torch.linalg.det(homographies(found)) > 0).all())


def test_what_the_outline_of_a_plain_disc_cannot_tell_stays_as_it_is():
    """A roll of a plain disc shows nowhere; a shift does, and is found."""
    position = torch.tensor(CORNERS)
    roll = 0.1 * torch.stack([-position[:, 1], position[:, 0]], 1)
    shifts = torch.zeros(VIEWS, 4, 2)
    shifts[0], shifts[1] = roll, torch.tensor([0.04, -0.02])
    found = aligned(shifts, plain).shifts
    assert float((found[0] * roll).sum() / roll.square().sum()) == pytest.approx(0.0, abs=0.05)
    torch.testing.assert_close(found[1].mean(0), torch.tensor([0.04, -0.02]), atol=0.012, rtol=0)


def test_a_picture_of_nothing_keeps_the_identity_under_noise():
    empty = {name: torch.zeros(VIEWS, SIZE, SIZE, width) for name, width in WIDTHS.items()}
    alignment = ViewAlignment(CAMERAS, empty, reference=0, limit=0.3)
    generator = torch.Generator().manual_seed(0)
    for _ in range(5):
        alignment.observe(PIXELS, 0.1 * torch.randn(len(PIXELS), 9, generator=generator))
        alignment.update(1.0)
    assert not bool(alignment.shifts.any())


def test_undetermined_directions_go_back_to_the_identity():
    """Structure along one corner coordinate only: it takes its step, the others are undone."""
    structure = torch.zeros(1, 8, 8)
    structure[0, 2, 2] = 4.0
    structure[0, 5, 5] = 1e-3
    shifts = torch.arange(8.0)[None]
    step = determined_step(structure, torch.full((1, 8), 2.0), shifts)
    want = -shifts
    want[0, 2] = 0.5
    torch.testing.assert_close(step, want)


def test_renders_that_are_not_finite_teach_nothing():
    alignment = ViewAlignment(CAMERAS, drawn(true_shifts(), checks), reference=0, limit=0.3)
    alignment.observe(PIXELS, torch.full((len(PIXELS), 9), math.nan))
    alignment.update(1.0)
    assert not bool(alignment.shifts.any())


def test_motions_of_the_object_are_no_warps():
    """Seven motions of the object, and eight warps that all views share, leave no step."""
    common = CommonMotion.of(CAMERAS, VIEWS - 1)
    assert common.motions.shape == (VIEWS, 8, 7 + 8)
    for motion in common.motions.unbind(2):
        assert float(common.without(motion).norm()) < 2e-3 * float(motion.norm())


def test_a_translation_moves_the_corners_as_projection_does():
    camera = orbit_cameras([(20.0, 30.0)], radius=2.2, fov_y_deg=33.8, size=SIZE)
    common = CommonMotion.of(
        orbit_cameras([(20.0, 30.0), (20.0, 0.0)], radius=2.2, fov_y_deg=33.8, size=SIZE), 1
    )
    pose = look_at_origin(20.0, 30.0, 2.2)
    half = math.tan(math.radians(33.8) / 2) * (2.2 - 0.25)
    for axis in range(3):
        for corner, (x, y) in enumerate(CORNERS):
            local = torch.tensor([x * half, -y * half, -(2.2 - 0.25)])
            point = pose[:3, :3] @ local + pose[:3, 3]
            moved = point + 1e-3 * torch.eye(3)[axis]
            clip = camera.project(torch.stack([point, moved]))[0].double()
            seen = clip[:, :2] / clip[:, 3:] * torch.tensor([1.0, -1.0])
            want = (seen[1] - seen[0]) / 1e-3
            got = common.motions[0].view(4, 2, 15)[corner, :, axis].double()
            torch.testing.assert_close(got, want, atol=2e-3, rtol=1e-2)


def test_a_step_of_the_reference_moves_all_others_back():
    """Where the reference would have to rise, the object has sunk: the others follow it down."""
    common = CommonMotion.of(CAMERAS, VIEWS - 1)
    steps = torch.zeros(VIEWS, 8)
    steps[-1, 1::2] = 0.02
    moved = common.without(steps)[:-1].view(-1, 4, 2)
    assert bool((moved[..., 1].mean(1) < -0.003).all())


def test_features_hold_what_views_are_aligned_by():
    planes = pictures_at(torch.zeros(1, 2), checks)
    assert list(WIDTHS) == list(FEATURES)
    assert features(planes).shape == (1, 9)


def test_forgetting_begins_anew():
    alignment = aligned(true_shifts(), checks, rounds=2)
    alignment.forget(1)
    assert not bool(alignment.shifts[1].any())
    assert not bool(alignment.structure[1].any())
    assert bool(alignment.shifts[0].any())
