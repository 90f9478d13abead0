"""The hull of phase 1: no more masks are overruled than contradict the others."""

import pytest
import torch
from sphere_orbit import sphere_images

from stages.errors import InputError
from stages.nerf_hull import start_hull
from stages.settings.nerf import NerfConfig
from svim3d.cameras import orbit_angles, orbit_cameras
from svim3d.fields.sdf_grid import node_positions

CAMERAS = orbit_cameras(orbit_angles(9, 10.0, 20.0), radius=2.2, fov_y_deg=33.8, size=48)
REFERENCE = 8


@pytest.fixture
def masks():
    return sphere_images(CAMERAS)["mask"]


@pytest.fixture
def hull(make_context):
    """`hull(masks, confidence, **settings)`: signed distances and the events."""

    def hull(masks, confidence=None, **settings):
        context = make_context("nerf")
        context.events.clear()  # those of calls before
        planes = {"mask": masks} | ({} if confidence is None else {"confidence": confidence})
        sdf = start_hull(planes, CAMERAS, REFERENCE, NerfConfig(**settings), context)
        return sdf, [event["kind"] for event in context.events]

    return hull


def halved(masks, *views):
    """Masks of which some show the left half of the object alone."""
    masks = masks.clone()
    for view in views:
        masks[view, :, 24:] = 0.0
    return masks


def test_masks_that_agree_are_all_believed(hull, masks):
    sdf, events = hull(masks)
    assert torch.equal(sdf, hull(masks, hull_rejections=0)[0])
    assert events == []


def test_as_many_masks_are_overruled_as_cut_the_object_off(hull, masks):
    whole, _ = hull(masks)
    sdf, events = hull(halved(masks, 2, 5), weigh_views=False)
    assert events == ["inconsistent_masks"]
    # What one of them cuts off alone is back; what both do is missed by less than the limit.
    assert float((sdf > 0.0).sum()) > 0.8 * float((whole > 0.0).sum())
    both, _ = hull(halved(masks, 2, 5), hull_rejections=2)
    assert bool((both > 0.0)[whole > 0.02].all())
    strict, events = hull(halved(masks, 2), hull_rejections=0, weigh_views=False)
    assert float((strict > 0.0).sum()) < 0.6 * float((whole > 0.0).sum())
    assert events == []


def test_the_reference_view_is_never_overruled(hull, masks):
    sdf, _ = hull(halved(masks, REFERENCE))
    right = CAMERAS.c2w[REFERENCE, :3, 0]
    across = node_positions(len(sdf), 0.55, like=sdf) @ right
    assert not bool((sdf > 0.0)[across > 0.03].any())


def test_what_is_not_trusted_carves_nothing(hull, masks):
    doubted = torch.ones_like(masks)
    doubted[[2, 5]] = 0.0
    sdf, _ = hull(halved(masks, 2, 5), doubted, hull_rejections=0)
    assert bool((sdf > 0.0)[hull(masks)[0] > 0.02].all())
    # More than wholly is wholly.
    doubted[REFERENCE] = 16.0
    assert torch.equal(hull(halved(masks, 2, 5), doubted, hull_rejections=0)[0], sdf)


@pytest.mark.parametrize("rejections", [0, "auto"])
def test_masks_without_a_common_point_are_refused(hull, masks, rejections):
    apart = masks.clone()
    apart[:4] = 0.0
    apart[:4, :4, :4] = 1.0
    apart[4:8] = 0.0
    apart[4:8, -4:, -4:] = 1.0
    with pytest.raises(InputError, match="contradict each other"):
        hull(apart, hull_rejections=rejections)
