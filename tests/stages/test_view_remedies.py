"""What is told of views: who was outvoted, whose warp ran into its bound, figures in pixels."""

import pytest
import torch
from sphere_orbit import sphere_cameras, sphere_images

from stages import view_remedies
from stages.artifacts import MaterialViews
from stages.settings.dmtet import DmtetConfig
from stages.settings.nerf import NerfConfig
from svim3d.render.view_warps import ViewCorrections

CAMERAS = sphere_cameras(views=4, size=16)
VIEWS = MaterialViews(cameras=CAMERAS, reference=3, **sphere_images(CAMERAS))
_, PLANES = VIEWS.premultiplied(16)


def aligned(shifts, weights, config=None):
    start = ViewCorrections(shifts, weights)
    return view_remedies.align_views(CAMERAS, PLANES, 3, config or NerfConfig(), start)


def test_outvoted_views_and_bound_warps_are_named(make_context):
    shifts = torch.zeros(4, 4, 2)
    shifts[1, 2, 0] = NerfConfig().warp_limit
    ctx = make_context("nerf")
    view_remedies.tell_of_views(aligned(shifts, torch.tensor([1.0, 1.0, 0.25, 1.0])), ctx)
    told = {event["kind"]: event["message"] for event in ctx.events}
    assert told == {
        "view_outvoted": "view 2 disagrees with the others: it counts 0.25",
        "warp_bound": "the homographies of views [1] have reached their bound",
    }


def test_views_that_agree_are_not_mentioned(make_context):
    ctx = make_context("nerf")
    view_remedies.tell_of_views(aligned(torch.zeros(4, 4, 2), torch.ones(4)), ctx)
    assert ctx.events == []


def test_views_that_had_to_be_moved_far_are_told(make_context):
    shifts = torch.zeros(4, 4, 2)
    shifts[0, :, 0] = 0.08
    ctx = make_context("nerf")
    view_remedies.tell_of_views(aligned(shifts, torch.ones(4)), ctx)
    ((kind, message),) = (tuple(event.values()) for event in ctx.events)
    assert kind == "views_bent"
    # 0.08 half pictures in one view of four.
    assert "moved by 1.0% of the picture on average, by 4.0% at most" in message


def test_figures_are_in_pixels():
    shifts = torch.zeros(4, 4, 2)
    shifts[0] = torch.tensor([3.0, 4.0]) / 100
    terms = view_remedies.view_terms(aligned(shifts, torch.tensor([1.0, 0.5, 1.0, 1.0])))
    # Five hundredths of half of 16 pixels, of one view in four.
    assert terms == pytest.approx(
        {"warp_px": 0.1, "largest_warp_px": 0.4, "least_view_weight": 0.5}
    )


def many_views():
    """Cameras of nine views of a sphere and their planes."""
    cameras = sphere_cameras(views=9, size=24)
    views = MaterialViews(cameras=cameras, reference=8, **sphere_images(cameras))
    return views.premultiplied(24)


def test_a_mask_that_takes_what_no_other_does_carves_nothing(make_context):
    cameras, planes = many_views()
    planes["mask"][2, :, 12:] = 0.0
    ctx = make_context("nerf")
    carving = view_remedies.silhouettes(cameras, planes, 8, NerfConfig(), ctx)
    others = [view for view in range(9) if view != 2]
    assert torch.equal(carving[others], planes["mask"][others])
    assert bool((carving[2] == 1.0).all())
    assert [event["kind"] for event in ctx.events] == ["mask_outvoted"]
    # The reference is what the asset was asked for by, and few views leave each other much to do.
    for kept in (
        view_remedies.silhouettes(cameras, planes, 2, NerfConfig(), ctx),
        view_remedies.silhouettes(cameras, planes, 8, NerfConfig(weigh_views=False), ctx),
        view_remedies.silhouettes(cameras, planes, 8, NerfConfig(hull_rejections=1), ctx),
        view_remedies.silhouettes(cameras[:7], {"mask": planes["mask"][:7]}, 6, NerfConfig(), ctx),
    ):
        assert torch.equal(kept, planes["mask"][: len(kept)])


def test_true_masks_carve_as_they_are(make_context):
    cameras, planes = many_views()
    ctx = make_context("nerf")
    carving = view_remedies.silhouettes(cameras, planes, 8, NerfConfig(), ctx)
    assert torch.equal(carving, planes["mask"])
    assert ctx.events == []


@pytest.mark.parametrize("kind", [NerfConfig, DmtetConfig])
def test_switched_off_they_leave_everything_as_it_is(kind):
    config = kind(warp_start=1.0, facing_gamma=0.0)
    assert aligned(torch.zeros(4, 4, 2), torch.ones(4), config) is None
    assert view_remedies.with_facing_trust(CAMERAS, PLANES, config) is PLANES


def test_trust_by_angle_is_a_plane_beside_the_others():
    found = view_remedies.with_facing_trust(CAMERAS, PLANES, NerfConfig(facing_gamma=2.0))
    assert set(found) - set(PLANES) == {view_remedies.FACING}
    assert found[view_remedies.FACING].shape == VIEWS.mask.shape
    assert all(found[name] is plane for name, plane in PLANES.items())


def test_phase_1_aligns_in_ever_finer_steps():
    views = aligned(torch.zeros(4, 4, 2), torch.ones(4))
    config = NerfConfig(warp_reach=0.1)
    view_remedies.realign(views, 0.0, config)
    assert views.alignment.reach_px == pytest.approx(1.6)
    view_remedies.realign(views, 0.9, config)
    assert views.alignment.reach_px == 1.0
