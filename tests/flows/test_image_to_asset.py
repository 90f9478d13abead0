"""The real pipeline, tiny: from an orbit folder to files, from the store, and in part."""

import json
from pathlib import Path

import pytest
import trimesh
from sphere_orbit import RADIUS, sphere_cameras, sphere_images
from tiny_asset import TINY_ASSET, states

from flows import cli
from flows.pipeline import IMAGE_TO_ASSET
from svim3d.io.image import read_png
from svim3d.io.orbit import write_orbit

pytestmark = pytest.mark.flow


@pytest.fixture(scope="module")
def command(tmp_path_factory):
    """`command(out, ...)`: run the sphere's orbit into a folder; returns the exit code."""
    root = tmp_path_factory.mktemp("sphere")
    cameras = sphere_cameras(views=9, size=48)
    write_orbit(root / "orbit", cameras, sphere_images(cameras), reference=8)
    settings = [part for setting in TINY_ASSET for part in ("--set", setting)]

    def run(out: Path, *options: str) -> int:
        where = ["-o", str(out), "--store", str(root / "store"), "--device", "cpu"]
        return cli.main(["run", str(root / "orbit"), *where, *settings, *options])

    return run


def the_sphere(out: Path) -> trimesh.Trimesh:
    """The mesh of the finished GLB, which must be the sphere that the views show."""
    (mesh,) = trimesh.load(out / "asset.glb", process=False, force="scene").geometry.values()
    # The views have 48 pixels, of which the sphere takes about 36.
    assert abs(trimesh.util.row_norm(mesh.vertices).mean() - RADIUS) < 0.5 / 36
    return mesh


def test_orbit_becomes_an_asset_and_the_second_run_starts_no_engine(
    engine, command, tmp_path, capsys, monkeypatch
):
    out = tmp_path / "out"
    assert command(out) == cli.DONE
    # There is no photo to prepare, and only preset `auto` plans its capacity.
    idle = ("prepare", "capacity")
    worked = [name for name in IMAGE_TO_ASSET.names if name not in idle]
    assert states(out) == dict.fromkeys(idle, "skipped") | dict.fromkeys(worked, "computed")
    mesh = the_sphere(out)
    assert mesh.visual.material.baseColorTexture.size == (64, 64)
    assert mesh.visual.material.normalTexture is not None
    assert (out / "environment.exr").is_file()
    assert read_png(out / "preview.png").shape[-1] == 3
    assert read_png(out / "views.png").shape[-1] == 3
    assert all((out / name / "manifest.json").is_file() for name in worked)
    asset = (out / "asset.glb").read_bytes()

    monkeypatch.setattr("flows.job.Engine", None)  # whoever calls it fails
    capsys.readouterr()
    assert command(out) == cli.DONE
    assert capsys.readouterr().out.count(" cached ") == len(worked)
    assert (out / "asset.glb").read_bytes() == asset


@pytest.mark.parametrize("left_out", [["env_preopt"], ["dmtet"], ["env_preopt", "dmtet"]])
def test_without_a_phase_there_is_still_a_textured_asset(engine, command, tmp_path, left_out):
    assert command(tmp_path, *(f"--skip={name}" for name in left_out)) == cli.DONE
    assert {name for name, state in states(tmp_path).items() if state == "skipped"} == {
        "prepare",
        "capacity",
        *left_out,
    }
    assert the_sphere(tmp_path).visual.material.baseColorTexture is not None


def test_auto_takes_no_more_than_the_views_ask_for_and_says_so(engine, command, tmp_path, capsys):
    out = tmp_path / "out"
    assert command(out, "--preset", "auto") == cli.DONE
    assert {name for name, state in states(out).items() if state == "skipped"} == {"prepare"}
    said = " ".join(capsys.readouterr().out.split())
    # The closing table tells what is used of what the settings allow, stage by stage.
    assert "hash_finest 48 of 48" in said
    assert "of 64: " in said
    plan = json.loads((out / "capacity" / "files" / "capacity.json").read_text())
    assert {"room_normal_px", "thickness_px", "hull_overlap_0"} <= set(plan["evidence"])
    the_sphere(out)


def test_with_no_phase_but_the_first_vertices_carry_the_colour(engine, command, tmp_path):
    left_out = ["env_preopt", "dmtet", "uv_bake"]
    assert command(tmp_path, *(f"--skip={name}" for name in left_out)) == cli.DONE
    assert "color" in the_sphere(tmp_path).visual.vertex_attributes
    assert (tmp_path / "preview.png").is_file()
