"""Views read through their warps: which one is taken, when a warp is forgotten, who is outvoted."""

from dataclasses import replace

import pytest
import torch
from sphere_orbit import sphere_cameras, sphere_images

from svim3d.render.aligned_views import AlignedViews
from svim3d.render.view_warps import ViewCorrections

VIEWS, SIZE = 6, 24
CAMERAS = sphere_cameras(views=VIEWS, size=SIZE)


def planes():
    images = sphere_images(CAMERAS)
    straight = ("basecolor", "roughness", "metallic", "normal_world")
    return {n: i * images["mask"] if n in straight else i for n, i in images.items()}


def views_of(start=None, shown=None, weigh=True):
    return AlignedViews(
        CAMERAS,
        planes() if shown is None else shown,
        reference=VIEWS - 1,
        limit=0.2,
        weigh=weigh,
        start=start,
    )


def moved(view, shift):
    shifts = torch.zeros(VIEWS, 4, 2)
    shifts[view] = torch.tensor(shift)
    return ViewCorrections(shifts, torch.ones(VIEWS))


def test_without_warps_targets_are_the_planes_to_the_bit():
    shown = planes()
    pixels = torch.arange(VIEWS * SIZE * SIZE).view(-1, 4)
    targets = views_of().targets(pixels)
    assert set(targets) == {*shown, "confidence"}
    for name, plane in shown.items():
        assert torch.equal(targets[name], plane.flatten(0, 2)[pixels])
    assert bool((targets["confidence"] == 1.0).all())


def test_confidence_comes_through_the_warp_and_times_the_views_weight():
    shown = planes() | {"confidence": torch.full((VIEWS, SIZE, SIZE, 1), 0.5)}
    start = moved(1, (2.0 / SIZE * 3, 0.0))
    start = replace(start, weights=torch.tensor([1.0, 0.5, 1.0, 1.0, 1.0, 1.0]))
    targets = views_of(start, shown).targets(torch.arange(VIEWS * SIZE * SIZE))
    confidence = targets["confidence"].view(VIEWS, SIZE, SIZE)
    assert bool((confidence[0] == 0.5).all())
    assert bool((confidence[1, :, :-3] == 0.25).all())
    assert not bool(confidence[1, :, -3:].any())
    # Three whole pixels: what was read lies three columns to the right.
    want = shown["basecolor"][1, :, 3:]
    got = targets["basecolor"].view(VIEWS, SIZE, SIZE, 3)[1, :, :-3]
    torch.testing.assert_close(got, want)


def test_a_warp_is_taken_where_it_fits_and_forgotten_where_it_never_does():
    shown = planes()
    good = views_of(moved(2, (2.0 / SIZE * 2, 0.0)))
    rendered = torch.zeros_like(shown["basecolor"][2])
    rendered[:, :-2] = shown["basecolor"][2, :, 2:]
    target, forgotten = good.chosen_targets(2, rendered, patience=3)
    assert not forgotten
    torch.testing.assert_close(target["basecolor"][:, :-2], rendered[:, :-2])

    bad = views_of(moved(2, (2.0 / SIZE * 2, 0.0)))
    seen = []
    for _ in range(3):
        target, forgotten = bad.chosen_targets(2, shown["basecolor"][2], patience=3)
        assert torch.equal(target["basecolor"], shown["basecolor"][2])
        seen.append(forgotten)
    assert seen == [False, False, True]
    assert not bool(bad.corrections.shifts.any())


def test_rejections_must_come_in_a_row():
    shown, views = planes(), views_of(moved(2, (2.0 / SIZE * 2, 0.0)))
    fitting = torch.zeros_like(shown["basecolor"][2])
    fitting[:, :-2] = shown["basecolor"][2, :, 2:]
    for rendered in (shown["basecolor"][2], fitting, shown["basecolor"][2]):
        assert not views.chosen_targets(2, rendered, patience=2)[1]
    assert bool(views.corrections.shifts[2].any())


def observed(views, rounds=3):
    """Every view compared with what it should have been."""
    truth = {name: plane.flatten(0, 2) for name, plane in planes().items()}
    pixels = torch.arange(VIEWS * SIZE * SIZE)
    for _ in range(rounds):
        views.observe(pixels, truth, views.targets(pixels))
        views.update(0.5)
    return views


def recoloured(view):
    shown = planes()
    shown["basecolor"][view] = (1.0 - shown["basecolor"][view]) * shown["mask"][view]
    return shown


def test_a_view_of_something_else_is_outvoted_but_never_the_reference():
    weights = observed(views_of(shown=recoloured(1))).corrections.weights
    assert float(weights[1]) < 0.1
    assert bool((weights[[0, 2, 3, 4, 5]] == 1.0).all())
    assert bool((observed(views_of(shown=recoloured(VIEWS - 1))).weights == 1.0).all())
    assert bool((observed(views_of(shown=recoloured(1), weigh=False)).weights == 1.0).all())


def test_true_views_keep_the_identity():
    assert not bool(observed(views_of()).corrections.shifts.any())


def test_its_state_is_all_that_it_goes_on_with():
    first = observed(views_of(shown=recoloured(1)))
    again = views_of(shown=recoloured(1))
    again.load_state(first.state())
    for views in (first, again):
        observed(views)
    for name, value in first.state().items():
        assert torch.equal(value, again.state()[name])


def test_a_whole_view_teaches_by_its_pixels_on_an_object():
    shown = planes()
    views = views_of()
    rendered = {name: plane[3] for name, plane in shown.items()}
    own = views.targets(3 * SIZE * SIZE + torch.arange(SIZE * SIZE).view(SIZE, SIZE))
    views.observe_view(3, rendered, own, every=2)
    count = float(views.alignment._count[3])
    assert count == pytest.approx(float((shown["mask"][3] > 0).sum()) / 2, abs=1)
    assert float(views.alignment._count.sum()) == count


def test_what_has_no_confidence_leaves_no_trace_between_pixels():
    start = moved(1, (2.0 / SIZE * 0.5, 0.0))
    start.shifts[2:5] = 0.01
    confidence = torch.ones(VIEWS, SIZE, SIZE, 1)
    confidence[1:3, 8:14, 8:14] = 0.0
    learnt = []
    for nonsense in (0.0, 7.0):
        shown = {n: torch.where(confidence > 0.0, p, nonsense) for n, p in planes().items()}
        views = views_of(start, shown | {"confidence": confidence})
        targets = views.targets(torch.arange(VIEWS * SIZE * SIZE))
        weighted = targets["basecolor"] * targets["confidence"]
        assert float(weighted.max()) <= 0.75
        learnt.append([weighted, *observed(views).state().values()])
    assert all(torch.equal(a, b) for a, b in zip(*learnt, strict=True))
