"""Whatever the severity, a case ends with an asset or with an error that says what to do."""

import pytest
import torch
from sphere_orbit import sphere_cameras, sphere_images

from benchmarks import inconsistent_case
from benchmarks.inconsistent_case import outcome
from benchmarks.inconsistent_orbit import corrupted_orbit
from benchmarks.pipeline_case import plan_case, run_case
from stages.store import Store
from svim3d.io.orbit import write_orbit
from svim3d.synthesis.inconsistency import Strengths

TINY = [
    "env_preopt.size=16",
    "env_preopt.steps=5",
    "nerf.steps=24",
    "nerf.rays_per_step=512",
    "nerf.grid_nodes=[24]",
    "nerf.grid_shares=[0.0]",
    "nerf.hash_log2_entries=10",
    "dmtet.steps=3",
    "dmtet.cells=16",
    "uv_bake.texture_size=64",
    "uv_bake.max_faces=500",
    "uv_bake.fit_iterations=2",
    "uv_bake.atlas_timeout_s=0",
]


def sphere_orbit(folder, **changed):
    cameras = sphere_cameras(6, 48)
    write_orbit(folder, cameras, sphere_images(cameras) | changed, reference=5)
    return folder


def planned(orbit, store, *overrides):
    return plan_case(orbit, "standard", [*TINY, *overrides], [], store=store, seed=0)


def test_views_that_show_nothing_are_refused_in_words(tmp_path):
    empty = torch.zeros(6, 48, 48, 1)
    orbit = sphere_orbit(tmp_path / "sphere", mask=empty)
    store = Store(tmp_path / "store")
    result = outcome(planned(orbit, store), store, orbit)
    assert result["outcome"] == "refused"
    assert "InputError: wanted at least 3 views with an object" in result["error"]


def test_a_crash_is_told_from_a_refusal(tmp_path, monkeypatch):
    def fail(*arguments):
        raise ZeroDivisionError("by accident")

    monkeypatch.setattr(inconsistent_case, "measure", fail)
    result = outcome(None, None, tmp_path)
    assert result["outcome"] == "crashed"
    assert "ZeroDivisionError: by accident" in result["error"]


@pytest.mark.slow
@pytest.mark.parametrize("severity", [0.0, 5.0])
def test_every_severity_ends_with_an_asset(tmp_path, severity):
    orbit = corrupted_orbit(
        sphere_orbit(tmp_path / "sphere"),
        tmp_path / "made",
        size=48,
        strengths=Strengths.at(severity),
        seed=0,
    )
    store = Store(tmp_path / "store")
    done = run_case(planned(orbit, store, "env_preopt.light=spherical_gaussians"), store)
    assert (done["export"].folder / "asset.glb").stat().st_size > 1000
