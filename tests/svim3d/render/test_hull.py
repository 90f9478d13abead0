"""Visual hull of exact sphere masks, votes against plain torch, wrong masks outvoted."""

import math

import pytest
import torch

from svim3d.cameras import orbit_angles, orbit_cameras
from svim3d.fields.sdf_grid import node_positions
from svim3d.render.hull import (
    coverage_votes,
    coverage_votes_reference,
    lone_carving,
    missed_shares,
)

NODES, HALF_EXTENT, RADIUS = 40, 0.55, 0.4


@pytest.fixture(scope="module")
def orbit():
    """Cameras all around and the exact masks of a sphere."""
    angles = orbit_angles(12, 0.0, 50.0)
    cameras = orbit_cameras(angles, radius=2.5, fov_y_deg=33.8, size=64)
    masks = []
    for view in range(len(cameras)):
        origins, directions = cameras.rays(view)
        along = -(origins * directions).sum(-1)
        gap = origins.square().sum(-1) - along.square()
        masks.append((gap < RADIUS**2).float().view(64, 64))
    return torch.stack(masks), cameras.clip_from_world()


def votes(masks, matrices, rejections=0):
    return coverage_votes(
        masks, matrices, nodes=NODES, half_extent=HALF_EXTENT, rejections=rejections
    )


def test_hull_of_a_sphere_contains_it_and_little_more(orbit):
    hull = votes(*orbit) >= 0.5
    radius = node_positions(NODES, HALF_EXTENT, like=orbit[0]).norm(dim=-1)
    pixel = 2.5 / (32 / math.tan(math.radians(16.9)))
    assert bool(hull[radius < RADIUS - 0.5 * pixel].all())
    assert not bool(hull[radius > 1.25 * RADIUS].any())
    cell = (2 * HALF_EXTENT / (NODES - 1)) ** 3
    volume = float(hull.sum()) * cell
    # Twelve tangent cones enclose a little more, pixels of a twentieth of the radius a little less.
    assert 0.97 < volume / (4 / 3 * math.pi * RADIUS**3) < 1.08


@pytest.mark.parametrize("rejections", [0, 2])
def test_kernel_equals_plain_torch(orbit, rejections):
    masks = torch.rand(orbit[0].shape, generator=torch.Generator().manual_seed(0))
    got = votes(masks, orbit[1], rejections)
    want = coverage_votes_reference(masks, orbit[1], NODES, HALF_EXTENT, rejections)
    torch.testing.assert_close(got, want, atol=1e-4, rtol=0)


def test_rejections_outvote_wrong_masks(orbit):
    masks, matrices = orbit
    broken = masks.clone()
    broken[3], broken[7] = 0.0, 0.0
    assert not bool((votes(broken, matrices, 1) >= 0.5).any())
    outvoted = votes(broken, matrices, 2) >= 0.5
    assert bool(outvoted[votes(masks, matrices) >= 0.5].all())


def test_object_cut_off_by_a_picture_goes_on_beyond_its_border(orbit):
    masks, matrices = orbit
    cropped = matrices.clone()
    cropped[0, :2] *= 4.0  # a close-up sees the middle only
    middle = torch.ones_like(masks)
    middle[1:] = masks[1:]
    assert bool((votes(middle, cropped) >= 0.5)[votes(masks, matrices) >= 0.5].all())


def test_impossible_number_of_rejections_is_refused(orbit):
    with pytest.raises(ValueError, match="rejections must lie in"):
        votes(*orbit, rejections=9)


def test_a_hull_of_masks_that_agree_misses_nothing(orbit):
    masks, matrices = orbit
    missed = missed_shares(votes(masks, matrices) >= 0.5, masks, matrices, HALF_EXTENT)
    assert float(missed.max()) < 0.01


def test_a_hull_that_is_too_small_misses_the_rest_of_each_silhouette(orbit):
    masks, matrices = orbit
    radius = node_positions(96, HALF_EXTENT, like=masks).norm(dim=-1)
    missed = missed_shares(radius < 0.5 * RADIUS, masks, matrices, HALF_EXTENT)
    # Silhouettes go as the square of the radius, and a pixel is a tenth of the small one's.
    torch.testing.assert_close(missed, torch.full_like(missed, 0.75), rtol=0, atol=0.06)


def test_no_mask_and_no_hull_miss_nothing_and_all(orbit):
    masks, matrices = orbit
    nothing = torch.zeros(NODES, NODES, NODES, dtype=torch.bool)
    assert bool((missed_shares(nothing, masks, matrices, HALF_EXTENT) == 1.0).all())
    empty = missed_shares(nothing, torch.zeros_like(masks), matrices, HALF_EXTENT)
    assert not bool(empty.any())


def test_a_mask_that_is_wrong_carves_alone(orbit):
    masks, matrices = orbit
    given = {"nodes": NODES, "half_extent": HALF_EXTENT}
    true = lone_carving(masks, matrices, **given)
    wrong = masks.clone()
    wrong[3, :, 32:] = 0.0
    carved = lone_carving(wrong, matrices, **given)
    # Views all around a sphere leave each other next to nothing; half of it is on that side.
    assert float(true.max()) < 0.02
    assert float(carved[3]) == pytest.approx(0.5, abs=0.05)
    others = torch.arange(len(masks)) != 3
    assert float(carved[others].max()) < 0.03
    nothing = lone_carving(torch.ones_like(masks), matrices, **given)
    assert torch.equal(nothing, torch.zeros(len(masks)))
