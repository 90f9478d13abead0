"""The capacity benchmark's own sums: what counts as kept, and what both presets are scaled to."""

import json

import pytest

from benchmarks.bench_capacity import foreseen, parse, row, scaled, table
from benchmarks.capacity_scenes import SIMPLE, scene_orbit
from flows.config import PipelineConfig, load_config
from stages.given_views import photo_of
from stages.invented_orbit import TEST_VIEWS, VIEWS
from svim3d.io.orbit import read_orbit


def result(seconds, kib, relight_db, distance, events=None):
    return {
        "cpu_seconds": {"generation": 100.0, "nerf": seconds - 1.0, "export": 1.0},
        "figures": {
            "file_mib": kib / 1024.0,
            "relight_db": relight_db,
            "distance": distance,
        },
        "events": events or {},
    }


@pytest.mark.parametrize(
    ("relight_db", "distance", "kept"),
    [(25.0, 0.001, True), (24.81, 0.00101, True), (24.79, 0.001, False), (26.0, 0.00103, False)],
)
def test_a_scene_is_kept_within_a_fifth_of_a_decibel_and_two_percent(relight_db, distance, kept):
    other = result(80.0, 4000.0, 25.0, 0.001)
    found = row("thing", result(20.0, 400.0, relight_db, distance), other)
    assert found["kept"] is kept
    assert (found["auto_s"], found["other_s"]) == (20.0, 80.0)
    text = table([found], "paper")
    assert "0.25 of the time, 0.10 of the size" in text
    assert f"Kept: {int(kept)} of 1" in text


def test_predictions_are_read_off_the_events():
    events = {
        "uv_bake": [
            {"kind": "capacity", "message": "max_faces 2227 of 8000: why"},
            {"kind": "faces", "message": "1112 of at most 2227 faces: against"},
            {"kind": "material", "message": "basecolor size: 128 of 512 px; 256 px are"},
            {"kind": "material", "message": "orm size: 256 of 512 px; 256 px are"},
        ],
        "nerf": [{"kind": "capacity", "message": "steps 410 of 1200: a loss"}],
    }
    found = foreseen(result(1.0, 1.0, 1.0, 1.0, events))
    assert found == {
        "faces": (2227.0, 1112.0),
        "texels per side": (512.0, 256.0),
        "steps of phase 1": (1200.0, 410.0),
    }
    assert foreseen(result(1.0, 1.0, 1.0, 1.0)) == {}


@pytest.mark.parametrize("preset", ["auto", "standard", "paper"])
def test_scaling_keeps_the_proportions_of_a_preset(preset):
    whole = load_config(PipelineConfig, preset)
    quarter = load_config(PipelineConfig, preset, scaled(preset, 128, 0.25))
    for stage in ("env_preopt", "nerf", "dmtet"):
        share = getattr(quarter, stage).steps / getattr(whole, stage).steps
        assert share == pytest.approx(0.25, abs=0.01)
    assert quarter.uv_bake.texture_size == whole.uv_bake.texture_size // 2
    assert quarter.nerf.rays_per_step == whole.nerf.rays_per_step // 4
    assert load_config(PipelineConfig, preset, scaled(preset, 256, 1.0)) == whole


def test_a_procedural_scene_is_an_orbit_with_all_that_figures_need(tmp_path):
    views, truth = scene_orbit("random-0", None, tmp_path, 16)
    assert views == truth
    assert scene_orbit("random-0", None, tmp_path, 16)[0] == views  # it is there already
    cameras, images, reference = read_orbit(truth)
    assert (len(cameras), reference) == (VIEWS, VIEWS - 1)
    assert float(images["mask"].max()) == 1.0
    for light in "ABC":
        tests, shown, _ = read_orbit(truth, f"test_{light}")
        assert len(tests) == TEST_VIEWS
        assert float(shown["radiance"].max()) > 0.0
    names = json.loads((truth / "orbit.json").read_text())["environments"]
    assert all((truth / entry["file"]).is_file() for entry in names.values())
    assert (truth / "mesh.ply").is_file()
    photo, (override,) = photo_of(truth)
    assert photo.is_file() and override.startswith("generation.elevation_deg=")


def test_scenes_without_a_data_folder_are_the_invented_ones(monkeypatch):
    monkeypatch.delenv("SVIM3D_DATA", raising=False)
    given = parse(["--invented", "2"])
    assert given.scenes == [*SIMPLE, "random-0", "random-1"]
    with pytest.raises(SystemExit, match="give --data"):
        scene_orbit("barrel", None, given.results, 16)
