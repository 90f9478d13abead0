"""Phase 1 through `run`: a painted sphere is found, repeatably to the bit; bad input is named."""

import dataclasses
import math

import pytest
import torch
from sphere_orbit import RADIUS, sphere_cameras, sphere_images
from spoilt_views import spoilt, trusted, warned

from stages.artifacts import EnvironmentLight, FittedField, MaterialViews
from stages.capacity_plan import CapacityPlan
from stages.errors import InputError
from stages.nerf import NERF, run
from stages.settings.nerf import NerfConfig
from svim3d.fields.material_field import MaterialField
from svim3d.fields.sdf_grid import node_positions, sample_sdf
from svim3d.numerics import normalize
from svim3d.render.view_warps import homographies

TINY = NerfConfig(
    steps=60,
    rays_per_step=512,
    grid_nodes=(24, 32),
    grid_shares=(0.0, 0.5),
    coarse_nodes=(8,),
    hash_levels=4,
    hash_log2_entries=11,
    hash_finest=48,
    hidden=16,
    environment_size=16,
)


@pytest.fixture(scope="module")
def views():
    cameras = sphere_cameras(views=9, size=48)
    images = sphere_images(cameras)
    return MaterialViews(cameras=cameras, reference=len(cameras) - 1, **images)


def surface_error(fitted):
    """Mean distance of near-zero nodes, moved along their gradient, from the sphere."""
    points = node_positions(len(fitted.sdf), fitted.half_extent, like=fitted.sdf).view(-1, 3)
    cell = 2 * fitted.half_extent / (len(fitted.sdf) - 1)
    near = points[fitted.sdf.view(-1).abs() < cell]
    value, gradient = sample_sdf(fitted.sdf, near, fitted.half_extent)
    on_surface = near - gradient * value / gradient.square().sum(-1, keepdim=True).clamp_min(0.1)
    return float((on_surface.norm(dim=-1) - RADIUS).abs().mean())


def basecolor_error(fitted):
    """Mean absolute difference on the sphere, away from the seam of its two colours."""
    field = MaterialField(fitted.material_spec)
    field.load_state_dict(fitted.material_state)
    points = normalize(torch.randn(500, 3, generator=torch.Generator().manual_seed(0))) * RADIUS
    seen = (points[:, 1].abs() < 0.3) & (points[:, 0].abs() > 0.05)
    want = torch.where(points[:, :1] > 0, 0.75, 0.25) * torch.tensor([1.0, 0.5, 0.25])
    with torch.no_grad():
        return float((field(points).basecolor - want)[seen].abs().mean())


def test_sphere_is_found_with_its_paint_and_a_light(views, make_context):
    fitted = run(views, None, config=TINY, ctx=make_context("nerf"))
    # A fifth of a pixel.
    assert surface_error(fitted) < 0.005
    assert basecolor_error(fitted) < 0.08
    assert fitted.sdf.shape == (32, 32, 32)
    assert fitted.environment.shape == (16, 16, 3)
    assert bool((fitted.environment > 0).all())
    assert bool((fitted.environment != TINY.environment_start).any())


def test_density_model_finds_it_too(views, make_context):
    config = TINY.model_copy(update={"density_model": "density", "steps": 100})
    fitted = run(views, None, config=config, ctx=make_context("nerf"))
    # About a pixel: a fog has no sharp surface.
    assert surface_error(fitted) < 0.04
    assert basecolor_error(fitted) < 0.12


def test_given_light_is_the_start_and_a_rate_of_zero_keeps_it(views, make_context):
    light = EnvironmentLight(
        torch.rand(16, 16, 3, generator=torch.Generator().manual_seed(0)) + 0.1
    )
    config = TINY.model_copy(update={"steps": 4, "environment_rate": 0.0})
    fitted = run(views, light, config=config, ctx=make_context("nerf"))
    torch.testing.assert_close(fitted.environment, light.radiance)


def equal(a, b):
    return (
        torch.equal(a.sdf, b.sdf)
        and torch.equal(a.environment, b.environment)
        and all(torch.equal(v, b.material_state[k]) for k, v in a.material_state.items())
    )


@pytest.mark.parametrize(
    ("model", "perceptual"), [("sdf", "none"), ("density", "none"), ("sdf", "dssim")]
)
def test_killed_and_resumed_run_ends_with_equal_bytes(
    views, make_context, tmp_path, model, perceptual
):
    config = TINY.model_copy(update={"steps": 24, "density_model": model, "perceptual": perceptual})
    whole = make_context("nerf")
    whole.checkpoints._every_s = 1e9
    want = run(views, None, config=config, ctx=whole)

    class Killed(Exception):
        pass

    def kill(step, *_):
        if step == 20:
            raise Killed

    killed = dataclasses.replace(whole, work=tmp_path / "second")
    killed.checkpoints._every_s = 0.0
    killed.report = kill
    with pytest.raises(Killed):
        run(views, None, config=config, ctx=killed)
    resumed = dataclasses.replace(whole, work=tmp_path / "second")
    assert resumed.checkpoints.load()[0] == 16
    assert equal(run(views, None, config=config, ctx=resumed), want)


def test_a_plateau_leaves_steps_out_and_a_resumed_run_leaves_out_the_same(
    views, make_context, tmp_path
):
    """No loss falls by nine tenths in eight steps: every part of the schedule is cut short."""
    config = TINY.model_copy(update={"steps": 96, "least_fall": 0.9})
    whole = make_context("nerf")
    made = []
    whole.report = lambda step, *_: made.append(step - 1)
    want = run(views, None, config=config, ctx=whole)
    assert made[0] == 0
    assert made[-1] == 95
    assert len(want.sdf) == TINY.grid_nodes[-1]
    notes = [event["kind"] for event in whole.events]
    assert notes.count("plateau") == 2
    assert whole.events[-1]["message"].startswith(f"steps {len(made)} of 96")
    assert len(made) < 90

    class Killed(Exception):
        pass

    def kill(step, *_):
        if step > 84:
            raise Killed

    killed = dataclasses.replace(whole, work=tmp_path / "second", events=[])
    killed.checkpoints._every_s = 0.0
    killed.report = kill
    with pytest.raises(Killed):
        run(views, None, config=config, ctx=killed)
    resumed = dataclasses.replace(whole, work=tmp_path / "second", events=[])
    assert resumed.checkpoints.load()[0] > 48
    assert equal(run(views, None, config=config, ctx=resumed), want)
    assert [e for e in resumed.events if e["kind"] == "capacity"] == whole.events[-1:]


def test_artifact_survives_the_disk(views, make_context, tmp_path):
    fitted = run(views, None, config=TINY.model_copy(update={"steps": 2}), ctx=make_context("nerf"))
    fitted.save(tmp_path)
    again = FittedField.load(tmp_path)
    assert equal(fitted, again)
    assert again.material_spec == fitted.material_spec


@pytest.mark.parametrize("perceptual", ["none", "dssim"])
def test_confidence_of_one_changes_no_bit_and_of_zero_hides_what_is_wrong(
    views, make_context, perceptual
):
    # The last steps fit the bump too.
    config = TINY.model_copy(update={"steps": 6, "perceptual": perceptual})

    def fitted(shown):
        return run(shown, None, config=config, ctx=make_context("nerf"))

    assert equal(fitted(trusted(views)), fitted(views))
    hidden = fitted(spoilt(views))
    assert equal(hidden, fitted(warned(views)))
    assert not equal(hidden, fitted(dataclasses.replace(spoilt(views), confidence=None)))


def test_a_mask_without_confidence_carves_nothing(views, make_context):
    """A bite out of one silhouette goes through the whole hull, unless nobody vouches for it."""
    config = TINY.model_copy(update={"steps": 1})
    mask, confidence = views.mask.clone(), torch.ones_like(views.mask)
    mask[8, 16:32, 16:32] = 0.0
    confidence[8, 16:32, 16:32] = 0.0
    bitten = dataclasses.replace(views, mask=mask)
    inside = [
        int((run(shown, None, config=config, ctx=make_context("nerf")).sdf > 0.0).sum())
        for shown in (views, bitten, dataclasses.replace(bitten, confidence=confidence))
    ]
    assert inside[1] < 0.8 * inside[0]
    # The one step moves a few nodes across the surface.
    assert abs(inside[2] - inside[0]) < 0.01 * inside[0]


def test_pictures_are_compared_as_often_as_asked_with_rising_weight(views, make_context):
    told = {}
    config = TINY.model_copy(
        update={"steps": 12, "perceptual": "dssim", "perceptual_size": 32, "perceptual_every": 3}
    )
    ctx = make_context("nerf")
    ctx.report = lambda step, _, terms: told.update({step - 1: terms.get("perceptual")})
    fitted = run(views, None, config=config, ctx=ctx)
    compared = {step: term for step, term in told.items() if term is not None}
    assert list(compared) == [0, 3, 6, 9]
    assert compared[0] == 0.0 < compared[3] < compared[9]
    plain = config.model_copy(update={"perceptual": "none"})
    assert not equal(fitted, run(views, None, config=plain, ctx=make_context("nerf")))


def test_views_larger_than_the_image_size_are_averaged_down(views, make_context):
    config = TINY.model_copy(update={"steps": 30, "image_size": 24})
    assert surface_error(run(views, None, config=config, ctx=make_context("nerf"))) < 0.02


def only(views, chosen):
    images = {
        f.name: getattr(views, f.name)[chosen]
        for f in dataclasses.fields(views)
        if f.name not in ("cameras", "reference", "depth", "confidence")
    }
    return MaterialViews(cameras=views.cameras[chosen], reference=0, **images)


def shifted(views, view, columns):
    """The same views, one of them moved to the right by whole pixels."""
    names = ("radiance", "mask", "basecolor", "roughness", "metallic", "normal_world")
    images = {name: getattr(views, name).clone() for name in names}
    for image in images.values():
        image[view] = image[view].roll(columns, dims=1)
    return dataclasses.replace(views, **images)


def test_a_moved_view_is_found_and_the_artifact_says_so(views, make_context, tmp_path):
    config = TINY.model_copy(update={"steps": 120})
    fitted = run(shifted(views, 2, 2), None, config=config, ctx=make_context("nerf"))
    across = fitted.corrections.shifts[..., 0].mean(1) * 48 / 2
    # Some of it moves the object: there are few views, and a sphere shows little.
    assert float(across[2]) == pytest.approx(1.2, abs=0.5)
    others = [view for view in range(9) if view != 2]
    assert float(across[others].abs().max()) < 0.7
    fitted.save(tmp_path)
    again = FittedField.load(tmp_path)
    assert torch.equal(again.corrections.shifts, fitted.corrections.shifts)
    assert torch.equal(again.corrections.weights, fitted.corrections.weights)
    assert again.own_surface().corrections is again.corrections
    off = TINY.model_copy(update={"steps": 2, "warp_start": 1.0})
    assert run(views, None, config=off, ctx=make_context("nerf")).corrections is None


def seen_from_elsewhere(views, view, azimuth_deg):
    """The same views, one of them showing what a camera that stands elsewhere sees."""
    turn = rotation_about_y(azimuth_deg)
    turned = dataclasses.replace(views.cameras, c2w=turn @ views.cameras.c2w)
    images = {name: getattr(views, name).clone() for name in sphere_images(views.cameras[[0]])}
    for name, image in sphere_images(turned).items():
        images[name][view] = image[view]
    return dataclasses.replace(views, **images)


def rotation_about_y(angle_deg):
    angle = math.radians(angle_deg)
    turn = torch.eye(4)
    turn[0, 0] = turn[2, 2] = math.cos(angle)
    turn[0, 2], turn[2, 0] = math.sin(angle), -math.sin(angle)
    return turn


def test_a_view_that_fights_all_others_is_told_and_does_little_harm(views, make_context):
    config = TINY.model_copy(update={"steps": 120})
    ctx = make_context("nerf")
    fitted = run(seen_from_elsewhere(views, 2, 30.0), None, config=config, ctx=ctx)
    assert [event["kind"] for event in ctx.events] == ["view_outvoted"]
    assert ctx.events[0]["message"].startswith("view 2 disagrees with the others")
    weights = fitted.corrections.weights
    assert float(weights[2]) < 0.5
    others = [view for view in range(9) if view != 2]
    assert bool((weights[others] == 1.0).all())
    left_out = dataclasses.replace(only(views, others), reference=7)
    without = run(left_out, None, config=config, ctx=make_context("nerf"))
    assert surface_error(fitted) < 1.25 * surface_error(without)
    assert basecolor_error(fitted) < 1.25 * basecolor_error(without)


def test_plain_views_do_not_drift(views, make_context):
    """Without any texture a warp could go anywhere; true views keep theirs within bounds."""
    plain = views.mask.expand(-1, -1, -1, 3) * 0.5
    bare = dataclasses.replace(views, basecolor=plain, radiance=plain)
    shifts = run(bare, None, config=TINY, ctx=make_context("nerf")).corrections.shifts
    # 5 % of the picture is a tenth of its half.
    assert float(shifts.norm(dim=-1).max()) < 0.1
    assert bool((torch.linalg.det(homographies(shifts)) > 0).all())


def test_trust_by_angle_changes_normals_alone(views, make_context):
    config = TINY.model_copy(update={"steps": 4})
    kept = run(views, None, config=config, ctx=make_context("nerf"))
    facing = config.model_copy(update={"facing_gamma": 1.0})
    assert not equal(run(views, None, config=facing, ctx=make_context("nerf")), kept)
    blind = {"normal_weight": 0.0, "normal_weight_end": 0.0}
    pair = [
        run(views, None, config=c.model_copy(update=blind), ctx=make_context("nerf"))
        for c in (config, facing)
    ]
    # Step 2 of 4 fits the bump, whose target is a normal too.
    assert not equal(*pair)
    pair = [
        run(
            views,
            None,
            config=c.model_copy(update=blind | {"bump_normal_weight": 0.0}),
            ctx=make_context("nerf"),
        )
        for c in (config, facing)
    ]
    assert equal(*pair)


def test_one_view_is_refused_with_advice(views, make_context):
    with pytest.raises(InputError, match=r"at least 3 views .* got 1; give an orbit"):
        run(only(views, [0]), None, config=TINY, ctx=make_context("nerf"))


def test_empty_mask_is_refused_by_number(views, make_context):
    broken = dataclasses.replace(views, mask=views.mask.clone())
    broken.mask[4] = 0.0
    with pytest.raises(InputError, match="mask of view 4 is empty"):
        run(broken, None, config=TINY, ctx=make_context("nerf"))


def test_contradicting_masks_are_refused(views, make_context):
    corners = torch.zeros_like(views.mask)
    for view in range(len(corners)):
        row, column = divmod(view, 3)
        corners[view, 20 * row : 20 * row + 4, 20 * column : 20 * column + 4] = 1.0
    broken = dataclasses.replace(views, mask=corners)
    with pytest.raises(InputError, match="views contradict each other"):
        run(broken, None, config=TINY, ctx=make_context("nerf"))


def test_one_wrong_mask_is_outvoted_and_reported(views, make_context):
    broken = dataclasses.replace(views, mask=views.mask.clone())
    broken.mask[2] = 0.0
    broken.mask[2, :4, :4] = 1.0
    # By the others at once or, where views are not weighed, once no hull is left.
    for weigh, told in ((True, "mask_outvoted"), (False, "inconsistent_masks")):
        ctx = make_context(f"nerf {weigh}")
        config = TINY.model_copy(update={"steps": 2, "weigh_views": weigh})
        run(broken, None, config=config, ctx=ctx)
        assert [event["kind"] for event in ctx.events] == [told]


def test_schedule_is_checked():
    with pytest.raises(ValueError, match="pair up"):
        NerfConfig(grid_nodes=(32,))
    with pytest.raises(ValueError, match="rise from 0"):
        NerfConfig(grid_nodes=(32, 64), grid_shares=(0.1, 0.5))


def test_stage_declares_its_inputs():
    assert list(NERF.inputs.values()) == [MaterialViews, EnvironmentLight, CapacityPlan]
    assert NERF.output is FittedField
