"""The plan asks for little where views show little, and what it asks for binds the stages."""

import dataclasses
import math

import pytest
import torch
from sphere_views import of_one_material, sphere_views, with_a_pattern

from stages.artifacts import MaterialViews
from stages.capacity import CAPACITY, run
from stages.capacity_plan import CapacityPlan, Choice, bounded, limited_schedule
from stages.nerf import run as nerf
from stages.settings.capacity import CapacityConfig
from stages.settings.dmtet import DmtetConfig
from stages.settings.env_preopt import EnvPreoptConfig
from stages.settings.nerf import NerfConfig
from stages.settings.uv_bake import UvBakeConfig

SIZES = ("nerf.hash_finest", "nerf.hash_levels", "nerf.hash_log2_entries", "uv_bake.texture_size")


@pytest.fixture(scope="module")
def plain():
    return sphere_views(of_one_material, views=9, size=96)


@pytest.fixture(scope="module")
def patterned():
    return sphere_views(with_a_pattern, views=9, size=96)


def planned(views, make_context, **settings):
    return run(views, config=CapacityConfig(**settings), ctx=make_context("capacity"))


def test_one_material_needs_less_of_everything_than_a_pattern(plain, patterned, make_context):
    little, much = (planned(views, make_context) for views in (plain, patterned))
    for setting in SIZES:
        assert little.value_of(setting) < much.value_of(setting)
    assert little.evidence["modes_roughness"] == little.evidence["modes_metallic"] == 1
    assert much.evidence["modes_roughness"] > 4
    assert little.evidence["room_basecolor_px"] == 16
    # The shape is the same.
    for setting in ("nerf.grid_nodes", "dmtet.cells", "uv_bake.max_faces"):
        assert little.value_of(setting) == much.value_of(setting)


@pytest.mark.parametrize(("roughness", "size"), [(1.0, 16), (0.5, 32), (0.3, 64), (0.1, 256)])
def test_light_has_the_rows_that_the_sharpest_lobe_shows(roughness, size, plain, make_context):
    """Rows = 2 * 2.15 / alpha with alpha = roughness^2, rounded up to a power of two."""
    even = dataclasses.replace(plain, roughness=torch.full_like(plain.roughness, roughness))
    found = planned(even, make_context)
    rows = 4.3 / roughness**2
    assert size == min(256, max(16, 2 ** math.ceil(math.log2(rows))))
    assert found.value_of("env_preopt.size") == found.value_of("nerf.environment_size") == size


def test_a_thin_part_asks_for_small_cells_and_whole_pictures(plain, make_context):
    mask = plain.mask.clone()
    mask[:, 4:40, 46:49] = 1.0  # a rod of three pixels on top
    thin = planned(dataclasses.replace(plain, mask=mask), make_context)
    thick = planned(plain, make_context)
    assert thin.evidence["thickness_px"] <= 4 < 40 < thick.evidence["thickness_px"]
    assert thin.value_of("nerf.grid_nodes") > thick.value_of("nerf.grid_nodes")
    assert thin.value_of("nerf.image_size") == 96 > thick.value_of("nerf.image_size")


def test_few_views_ask_for_few_steps_of_phase_2(plain, make_context):
    config = DmtetConfig(steps=600)
    for count, steps in ((9, 135), (3, 45)):
        images = {k: v[:count] for k, v in vars(plain).items() if isinstance(v, torch.Tensor)}
        few = dataclasses.replace(plain, cameras=plain.cameras[list(range(count))], **images)
        plan = planned(few, make_context)
        assert bounded(config, plan, make_context("dmtet")).steps == steps
    assert bounded(DmtetConfig(steps=40), plan, make_context("dmtet")).steps == 40


def test_an_untrusted_pattern_does_not_count(plain, patterned, make_context):
    half = torch.zeros_like(plain.mask)
    half[:, :, :48] = 1.0
    images = {
        name: torch.where(half > 0, getattr(plain, name), getattr(patterned, name))
        for name in ("radiance", "basecolor", "roughness", "metallic")
    }
    mixed = dataclasses.replace(plain, **images)
    trusted = dataclasses.replace(mixed, confidence=half)
    rooms = [planned(v, make_context).evidence["room_basecolor_px"] for v in (mixed, trusted)]
    assert rooms[0] < rooms[1] == 16


def test_every_choice_is_told_with_its_reason(plain, make_context):
    ctx = make_context("capacity")
    plan = run(plain, config=CapacityConfig(), ctx=ctx)
    told = [event["message"] for event in ctx.events if event["kind"] == "capacity"]
    assert len(told) == len(plan.choices)
    assert all(c.because in message for c, message in zip(plan.choices, told, strict=True))
    assert plan.headline().startswith("hash ")


def test_artifact_survives_the_disk(plain, make_context, tmp_path):
    plan = planned(plain, make_context)
    plan.save(tmp_path)
    assert CapacityPlan.load(tmp_path) == plan


def test_a_plan_binds_only_from_above(make_context):
    plan = CapacityPlan(
        (
            Choice("nerf.hash_finest", 96, "of this"),
            Choice("nerf.hidden", 4096, "of that"),
            Choice("nerf.grid_nodes", 112, "cells"),
            Choice("dmtet.cells", 48, "for another stage"),
        ),
        {},
    )
    config, ctx = NerfConfig(), make_context("nerf")
    found = bounded(config, plan, ctx)
    assert (found.hash_finest, found.hidden) == (96, config.hidden)
    assert found.grid_nodes == (64, 96, 112)
    assert found.grid_shares == config.grid_shares[:3]
    told = [event["message"] for event in ctx.events]
    assert told[0] == "hash_finest 96 of 384: of this"
    assert told[2] == "grid_nodes 112 of 192: cells"
    # Levels of 17^3 to 97^3 nodes, of which a table holds 2^17 at most; and the distances.
    sizes = [min((round(16 * 6 ** (level / 7)) + 1) ** 3, 2**17) for level in range(8)]
    assert told[3].startswith(f"parameters {2 * sum(sizes) + 112**3:,} of ")
    assert len(told) == 4
    untouched = {"hash_finest", "grid_nodes", "grid_shares"}
    assert found.model_dump(exclude=untouched) == config.model_dump(exclude=untouched)
    assert bounded(config, None, ctx) is config


@pytest.mark.parametrize(
    ("limit", "nodes", "shares"),
    [
        (192, (64, 96, 192), (0.0, 0.4, 0.8)),
        (300, (64, 96, 192), (0.0, 0.4, 0.8)),
        (128, (64, 96, 128), (0.0, 0.4, 0.8)),
        (96, (64, 96), (0.0, 0.4)),
        (80, (64, 80), (0.0, 0.4)),
        (48, (48,), (0.0,)),
    ],
)
def test_a_schedule_ends_where_it_is_told_to(limit, nodes, shares):
    assert limited_schedule((64, 96, 192), (0.0, 0.4, 0.8), limit) == (nodes, shares)


def test_every_choice_names_a_setting_that_takes_it(plain, make_context):
    plan = planned(plain, make_context)
    stages = {
        "nerf": NerfConfig(),
        "env_preopt": EnvPreoptConfig(size=256),
        "dmtet": DmtetConfig(),
        "uv_bake": UvBakeConfig(),
    }
    named = {choice.setting.partition(".")[0] for choice in plan.choices}
    assert named == set(stages)
    for stage, config in stages.items():
        assert bounded(config, plan, make_context(stage)) != config


def test_phase_1_is_no_larger_than_its_plan(plain, make_context):
    config = NerfConfig(
        steps=2,
        rays_per_step=512,
        grid_nodes=(24, 32),
        grid_shares=(0.0, 0.5),
        coarse_nodes=(8,),
        environment_size=32,
    )
    plan = CapacityPlan(
        tuple(
            Choice(f"nerf.{name}", value, "a test")
            for name, value in (
                ("grid_nodes", 24),
                ("hash_finest", 40),
                ("hash_levels", 3),
                ("hash_log2_entries", 10),
                ("environment_size", 16),
            )
        ),
        {},
    )
    fitted = nerf(plain, None, plan, config=config, ctx=make_context("nerf"))
    spec = fitted.material_spec
    assert (spec.finest, spec.levels, spec.log2_entries) == (40, 3, 10)
    assert (len(fitted.sdf), len(fitted.environment)) == (24, 16)


def test_views_without_a_solid_pixel_still_have_a_plan(make_context):
    empty = sphere_views(of_one_material, views=4, size=16)
    faint = dataclasses.replace(empty, mask=0.6 * empty.mask)
    plan = planned(faint, make_context)
    assert plan.evidence["modes_roughness"] == 1
    assert all(math.isfinite(choice.value) for choice in plan.choices)


def test_stage_declares_its_inputs():
    assert list(CAPACITY.inputs.values()) == [MaterialViews]
    assert CAPACITY.output is CapacityPlan
