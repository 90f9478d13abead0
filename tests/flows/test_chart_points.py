"""Every declared knob can be turned, and nothing is measured twice."""

import pytest

from flows.chart_knobs import KNOBS, PHOTO, VIEWS, quick
from flows.chart_points import Bench, Case, Point, points_of
from flows.config import PRESETS, load_config
from stages.errors import InputError


@pytest.mark.parametrize("photos", [False, True])
@pytest.mark.parametrize("base", PRESETS)
def test_every_turn_of_every_knob_is_a_valid_setting(base, photos):
    points = points_of(base, PRESETS, KNOBS, photos=photos)
    assert points[0].name == base
    assert len({point.name for point in points}) == len(points)
    for point in points:
        assert point.config is not None
    wanted = {knob.name for knob in KNOBS if knob.input in ("", PHOTO if photos else VIEWS)}
    assert {point.group for point in points} >= wanted - {"evidence", "remedies"}


def test_turns_change_what_they_say_and_nothing_else():
    points = {p.name: p.config for p in points_of("preview", (), KNOBS, scales=(2.0,))}
    base = points["preview"]
    assert points["rays 4096"] == base.model_copy(
        update={"nerf": base.nerf.model_copy(update={"rays_per_step": 4096})}
    )
    assert points["steps x2"].nerf.steps == 2 * base.nerf.steps
    assert points["steps x2"].env_preopt.steps == 2 * base.env_preopt.steps
    assert points["steps x2"].skip == base.skip
    faster = points["phase2-rates surface-x3"].dmtet
    default = load_config(type(base), "standard").dmtet
    assert faster.sdf_rate == pytest.approx(3 * default.sdf_rate)
    assert faster.offset_rate == pytest.approx(3 * default.offset_rate)
    slower = points["phase2-rates materials-x0.3"].dmtet
    assert slower.field_rate == pytest.approx(0.3 * default.field_rate)
    assert slower.network_rate == pytest.approx(0.3 * default.network_rate)


def test_a_stage_that_the_base_leaves_out_is_brought_back_for_its_knobs():
    points = {p.name: p.config for p in points_of("preview", (), KNOBS, scales=())}
    assert "dmtet" in points["preview"].skip
    assert points["phase2-steps 400"].skip == points["preview"].skip - {"dmtet"}
    assert (points["tets 64"].dmtet.cells, points["tets 64"].dmtet.steps) == (64, 150)
    kept = {p.name: p.config for p in points_of("paper", (), KNOBS, scales=())}
    assert kept["tets 64"].dmtet.steps == 1500


def test_what_computes_the_same_is_one_point():
    names = [p.name for p in points_of("preview", ("preview", "standard"), KNOBS)]
    # The base's own values, and what only stages that it skips would notice.
    assert not {"rays 2048", "grid 96", "phase1-steps 200", "phase0-steps 100"} & set(names)
    assert "image-size 256" not in names and "image-size 128" in names
    small = [p.name for p in points_of("preview", (), KNOBS, given_px=128)]
    assert not {"image-size 128", "size 128", "size 256"} & set(small)
    assert {"image-size 64", "size 64"} <= set(small)


def test_quick_keeps_the_ends_of_a_few_knobs():
    kept = {knob.name: [turn.label for turn in knob.turns] for knob in quick(KNOBS)}
    assert kept["phase1-steps"] == ["100", "1200"]
    assert "faces" not in kept


def test_wrong_settings_are_refused_before_anything_runs():
    with pytest.raises(InputError, match="no such setting"):
        points_of("preview", (), (), changes=("nerf.stops=3",))


def test_keys_name_what_a_result_depends_on(tmp_path):
    orbit = tmp_path / "thing"
    orbit.mkdir()
    (orbit / "orbit.json").write_text("{}")
    plain = Point("preview", "presets", "", "preview")
    same = Point("preview again", "presets", "", "preview", ("nerf.steps=200",))
    case = Case("preview", "thing", 0)

    def bench(**changed):
        given = {"orbits": {"thing": orbit}, "size": None, "photos": False, "store": tmp_path}
        return Bench(**(given | {"limit_s": 1.0, "code": "x"} | changed))

    key = bench().key(plain, case)
    assert bench().key(same, case) == key
    assert bench(store=tmp_path / "other").key(plain, case) == key
    others = [
        bench().key(Point("p", "g", "", "preview", ("nerf.steps=100",)), case),
        bench().key(Point("p", "g", "", "preview", (), views=8), case),
        bench(size=64).key(plain, case),
        bench(photos=True).key(plain, case),
        bench(code="y").key(plain, case),
        bench().key(plain, Case("preview", "thing", 1)),
    ]
    (orbit / "orbit.json").write_text("{ }")
    others.append(bench().key(plain, case))
    assert len({key, *others}) == 1 + len(others)
