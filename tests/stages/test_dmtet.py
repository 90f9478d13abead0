"""Phase 2 on an analytic sphere: mends a wrong start, resumes to the byte, refuses no surface."""

import dataclasses
import math

import pytest
import torch
from sphere_orbit import RADIUS, sphere_cameras, sphere_images
from spoilt_views import spoilt, trusted, warned

from stages.artifacts import FittedField, MaterialViews, RefinedSurface
from stages.base import Stage
from stages.capacity_plan import CapacityPlan
from stages.dmtet import DMTET
from stages.errors import DivergenceError, InputError
from stages.settings.dmtet import DmtetConfig
from svim3d.fields.material_field import MaterialField, MaterialFieldSpec
from svim3d.fields.sdf_grid import node_positions
from svim3d.mesh.mesh import face_adjacency, signed_volume
from svim3d.render.view_warps import ViewCorrections

CONFIG = DmtetConfig(
    steps=60,
    cells=20,
    image_size=64,
    views_per_step=2,
    sdf_rate=0.1,
    field_rate=2e-2,
    network_rate=1e-2,
)
QUICK = CONFIG.model_copy(update={"steps": 4})
HALF_EXTENT = 0.6
SPEC = MaterialFieldSpec(
    levels=3, log2_entries=12, coarsest=4, finest=16, hidden=16, half_extent=HALF_EXTENT
)


@pytest.fixture(scope="module")
def views() -> MaterialViews:
    cameras = sphere_cameras(views=6, size=64)
    return MaterialViews(cameras=cameras, reference=5, **sphere_images(cameras))


@pytest.fixture(scope="module")
def field() -> FittedField:
    """A sphere that is too small and dented, with untrained materials."""
    p = node_positions(33, HALF_EXTENT, like=torch.zeros(()))
    dents = 0.012 * torch.sin(12 * p).sum(-1)
    materials = MaterialField(SPEC)
    materials.reset(torch.Generator().manual_seed(0))
    return FittedField(
        sdf=RADIUS - 0.03 + dents - p.norm(dim=-1),
        half_extent=HALF_EXTENT,
        material_spec=SPEC,
        material_state=dict(materials.state_dict()),
        environment=torch.full((16, 16, 3), 0.5),
    )


def error(surface: RefinedSurface) -> float:
    return float((surface.vertices.norm(dim=1) - RADIUS).abs().mean())


def equal(a: RefinedSurface, b: RefinedSurface) -> bool:
    same = all(
        torch.equal(getattr(a, name), getattr(b, name))
        for name in ("vertices", "faces", "environment")
    )
    return same and all(
        torch.equal(value, b.material_state[name]) for name, value in a.material_state.items()
    )


def test_a_perturbed_sphere_is_mended(views, field, make_context):
    frozen = {"steps": 1, "sdf_rate": 0.0, "offset_rate": 0.0}
    start = DMTET.run(
        views, field, config=CONFIG.model_copy(update=frozen), ctx=make_context("start")
    )
    refined = DMTET.run(views, field, config=CONFIG, ctx=make_context("dmtet"))
    assert error(start) > 0.025
    assert error(refined) < 0.3 * error(start)
    assert bool((face_adjacency(refined.faces) >= 0).all())
    volume = float(signed_volume(refined.vertices, refined.faces))
    assert volume == pytest.approx(4 / 3 * math.pi * RADIUS**3, rel=0.05)
    materials = MaterialField(SPEC)
    materials.load_state_dict(refined.material_state)
    learned = materials(torch.tensor([[0.3, 0.3, math.sqrt(RADIUS**2 - 0.18)]])).basecolor
    assert float((learned.detach() - 0.75 * torch.tensor([1.0, 0.5, 0.25])).abs().max()) < 0.1


def test_the_same_seed_gives_the_same_bytes(views, field, make_context):
    first = DMTET.run(views, field, config=QUICK, ctx=make_context("dmtet"))
    again = DMTET.run(views, field, config=QUICK, ctx=make_context("dmtet"))
    other = DMTET.run(views, field, config=QUICK, ctx=make_context("dmtet", seed=1))
    assert equal(first, again)
    assert not equal(first, other)


@pytest.mark.parametrize("perceptual", ["none", "dssim"])
def test_sure_pixels_change_no_bit_and_doubtful_ones_teach_nothing(
    views, field, make_context, perceptual
):
    config = QUICK.model_copy(update={"perceptual": perceptual})

    def refined(shown: MaterialViews) -> RefinedSurface:
        return DMTET.run(shown, field, config=config, ctx=make_context("dmtet"))

    assert equal(refined(trusted(views)), refined(views))
    assert equal(refined(spoilt(views)), refined(warned(views)))
    blind = MaterialViews(**vars(spoilt(views)) | {"confidence": None})
    assert not equal(refined(blind), refined(warned(views)))


def shifted(views: MaterialViews, view: int, columns: int) -> MaterialViews:
    """The same views, one of them moved to the right by whole pixels."""
    names = ("radiance", "mask", "basecolor", "roughness", "metallic", "normal_world")
    images = {name: getattr(views, name).clone() for name in names}
    for image in images.values():
        image[view] = image[view].roll(columns, dims=1)
    return MaterialViews(**vars(views) | images)


def test_a_moved_view_is_found_and_read_where_it_is(views, field, make_context):
    first = DMTET.run(views, field, config=CONFIG, ctx=make_context("first"))
    p = node_positions(33, HALF_EXTENT, like=torch.zeros(()))
    good = dataclasses.replace(
        field, sdf=RADIUS - p.norm(dim=-1), material_state=first.material_state
    )
    config = CONFIG.model_copy(update={"steps": 30})
    moved = shifted(views, 2, 2)
    refined = DMTET.run(moved, good, config=config, ctx=make_context("dmtet"))
    assert refined.corrections is not None
    across = refined.corrections.shifts[..., 0].mean(1) * 64 / 2
    # Of six views one has much in common with all: they share in its way back.
    others = across[[0, 1, 3, 4, 5]]
    assert float(across[2] - others.mean()) == pytest.approx(2.0, abs=0.8)
    off = config.model_copy(update={"warp_start": 1.0})
    assert DMTET.run(views, field, config=off, ctx=make_context("dmtet")).corrections is None


def test_a_warp_that_never_fits_begins_anew_and_is_told(views, field, make_context):
    """Phase 1 was wrong about one view: its albedo fits better as it is."""
    shifts = torch.zeros(6, 4, 2)
    shifts[2, :, 0] = 0.11
    wrong = dataclasses.replace(field, corrections=ViewCorrections(shifts, torch.ones(6)))
    config = CONFIG.model_copy(update={"steps": 12, "warp_patience": 2, "warp_gain": 0.01})
    ctx = make_context("dmtet")
    refined = DMTET.run(views, wrong, config=config, ctx=ctx)
    assert {event["kind"] for event in ctx.events} == {"warp_reset"}
    told = [event["message"] for event in ctx.events]
    assert any("view 2 fits better without its homography" in message for message in told)
    assert float(refined.corrections.shifts[2].abs().max()) < 0.05


@pytest.mark.parametrize("perceptual", ["none", "dssim"])
def test_a_killed_run_resumes_to_the_same_bytes(
    views, field, make_context, monkeypatch, perceptual
):
    config = QUICK.model_copy(update={"perceptual": perceptual})
    whole = DMTET.run(views, field, config=config, ctx=make_context("dmtet"))
    killed = make_context("dmtet")
    killed.checkpoints._every_s = 0.0
    report = killed.report

    def report_and_die(step, total, terms):
        report(step, total, terms)
        if step == 3:
            raise KeyboardInterrupt

    monkeypatch.setattr(killed, "report", report_and_die)
    with pytest.raises(KeyboardInterrupt):
        DMTET.run(views, field, config=config, ctx=killed)
    resumed = make_context("dmtet")
    saved = resumed.checkpoints.load()
    assert saved is not None
    assert saved[0] == 2
    assert equal(DMTET.run(views, field, config=config, ctx=resumed), whole)


def test_pictures_are_compared_if_asked(views, field, make_context):
    told = []
    config = QUICK.model_copy(update={"perceptual": "dssim", "perceptual_every": 2})
    ctx = make_context("dmtet")
    ctx.report = lambda step, _, terms: told.append("perceptual" in terms)
    refined = DMTET.run(views, field, config=config, ctx=ctx)
    assert told == [True, False, True, False]
    assert not equal(refined, DMTET.run(views, field, config=QUICK, ctx=make_context("dmtet")))


def test_a_field_without_a_surface_is_refused_with_advice(views, field, make_context):
    empty = FittedField(**{**vars(field), "sdf": torch.full((9, 9, 9), -0.1)})
    with pytest.raises(InputError, match=r"never changes sign.*nerf more steps"):
        DMTET.run(views, empty, config=QUICK, ctx=make_context("dmtet"))


def test_a_field_that_fills_its_cube_still_gives_a_closed_surface(views, field, make_context):
    full = FittedField(**{**vars(field), "sdf": torch.full((9, 9, 9), 0.1)})
    surface = DMTET.run(
        views, full, config=QUICK.model_copy(update={"steps": 1}), ctx=make_context("dmtet")
    )
    assert bool((face_adjacency(surface.faces) >= 0).all())


def test_views_with_nan_end_with_the_name_of_the_term(views, field, make_context):
    broken = MaterialViews(**{**vars(views), "basecolor": views.basecolor * math.nan})
    long = QUICK.model_copy(update={"steps": 30})
    with pytest.raises(DivergenceError, match="basecolor"):
        DMTET.run(broken, field, config=long, ctx=make_context("dmtet"))


def test_the_stage_declares_what_it_reads_and_writes():
    assert isinstance(DMTET, Stage)
    wanted = {"views": MaterialViews, "field": FittedField, "plan": CapacityPlan}
    assert DMTET.inputs == wanted
    assert DMTET.output is RefinedSurface
