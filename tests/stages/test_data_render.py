"""Folders of training data: resumed, refused, with files that cannot be read."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from fake_cycles import fake_interpreter

from stages import data_render
from stages.data_render import (
    SUMMARY,
    DataRequest,
    environment_files,
    mesh_files,
    render_data,
)
from stages.errors import InputError
from svim3d.io.cycles import Cycles
from svim3d.io.exr import write_rgb
from svim3d.io.training_data import read_example


@pytest.fixture(scope="module")
def cache(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("cache")


@pytest.fixture
def request_of(tmp_path, cache):
    return DataRequest(
        folder=tmp_path / "data",
        seed=5,
        size=16,
        views=3,
        lights=2,
        meshes=(),
        environments=(),
        cache=cache,
    )


def statuses(request, objects):
    return [outcome.status for outcome in render_data(request, objects, workers=1)]


def test_a_stopped_run_goes_on_where_it_was(request_of):
    assert statuses(request_of, 3) == ["made"] * 3
    files = sorted(request_of.folder.glob("*.safetensors"))
    content = [file.read_bytes() for file in files]
    times = [file.stat().st_mtime_ns for file in files]
    files[1].write_bytes(content[1][: len(content[1]) // 2])  # as a killed copy leaves it
    (request_of.folder / "000002.123.tmp").write_bytes(b"half")
    assert statuses(request_of, 4) == ["kept", "made", "kept", "made"]
    assert [file.read_bytes() for file in files] == content
    assert [files[i].stat().st_mtime_ns for i in (0, 2)] == [times[0], times[2]]


def test_the_summary_tells_what_is_there(request_of):
    statuses(request_of, 2)
    told = json.loads((request_of.folder / SUMMARY).read_text())
    assert told["objects"] == 2 and sum(told["quality"].values()) == 2
    assert (told["seed"], told["size"], told["views"], told["lights"]) == (5, 16, 3, 2)
    assert read_example(request_of.folder / "000001.safetensors").rgb.shape == (2, 3, 16, 16, 3)


def test_other_settings_are_refused(request_of):
    statuses(request_of, 1)
    with pytest.raises(InputError, match="holds data of other settings"):
        statuses(replace(request_of, seed=6), 1)


def test_meshes_and_environments_come_from_folders(request_of, tmp_path):
    meshes, lights = tmp_path / "meshes", tmp_path / "lights"
    meshes.mkdir()
    lights.mkdir()
    (meshes / "a_broken.glb").write_bytes(b"not a mesh")
    corners = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\n"
    (meshes / "b_good.obj").write_text(corners + "f 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n")
    write_rgb(lights / "sky.exr", torch.ones(16, 32, 3).numpy())
    request = replace(request_of, meshes=mesh_files(meshes), environments=environment_files(lights))
    outcomes = list(render_data(request, 4, workers=1))
    assert [o.status for o in outcomes] == ["skipped", "made", "skipped", "made"]
    assert "a_broken.glb was left out" in outcomes[0].message
    example = read_example(request.folder / "000001.safetensors")
    assert example.metadata["name"] == "b_good" and example.metadata["quality"] == "low"
    assert "sky turned" in example.metadata["environments"]
    assert json.loads((request.folder / SUMMARY).read_text())["skipped"] == 2


def test_a_mesh_that_cannot_be_rendered_is_left_out_and_a_full_disk_is_not(
    request_of, tmp_path, monkeypatch
):
    (tmp_path / "one.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\n")
    request = replace(request_of, meshes=mesh_files(tmp_path))

    def fail(*_args: object, **_settings: object) -> None:
        raise RuntimeError("no view shows it")

    with monkeypatch.context() as patched:
        patched.setattr(data_render, "render_example", fail)
        (outcome,) = render_data(request, 1, workers=1)
    assert outcome.status == "skipped" and "one.obj was left out: no view" in outcome.message

    def full(*_args: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(data_render, "write_example", full)
    with pytest.raises(OSError, match="No space"):
        list(render_data(request, 1, workers=1))


def test_empty_and_missing_folders_are_refused(tmp_path):
    assert mesh_files(None) == ()
    with pytest.raises(InputError, match="there is no folder"):
        mesh_files(tmp_path / "nowhere")
    with pytest.raises(InputError, match="wanted environments"):
        environment_files(tmp_path)


def test_cycles_replaces_the_rgb_pictures_and_nothing_else(request_of, tmp_path):
    statuses(request_of, 1)
    cycles = Cycles(fake_interpreter(tmp_path), 7, "cpu", 60.0)
    traced = replace(request_of, folder=tmp_path / "traced", cycles=cycles)
    assert statuses(traced, 1) == ["made"]
    ours = read_example(request_of.folder / "000000.safetensors")
    theirs = read_example(traced.folder / "000000.safetensors")
    assert (ours.metadata["backend"], theirs.metadata["backend"]) == ("raster", "cycles, 7 samples")
    for name in ("basecolor", "orm", "normal", "mask", "elevation_deg", "azimuth_deg"):
        assert torch.equal(getattr(ours, name), getattr(theirs, name))
    # All pictures of the player are even, the last view the brightest: 1 + light + 20. More than
    # a tenth of all pixels on the object are its, so exposure gives them the display value.
    whole = theirs.mask[..., 0] == 255
    for light in range(2):
        values = [theirs.rgb[light, view][whole[view]].unique() for view in range(3)]
        assert all(len(v) == 1 for v in values)
        assert int(values[0]) < int(values[1]) < int(values[2])
        assert 0.5 * 255 - 1 <= int(values[2]) <= 0.9 * 255 + 1


def test_a_folder_has_one_backend(request_of, tmp_path):
    statuses(request_of, 1)
    file = request_of.folder / SUMMARY
    told = json.loads(file.read_text())
    del told["backend"]  # as a folder has it that was begun before there were two
    file.write_text(json.dumps(told))
    assert statuses(request_of, 1) == ["kept"]
    cycles = Cycles(tmp_path / "nowhere", 7, "cpu", 60.0)
    with pytest.raises(InputError, match="other settings"):
        statuses(replace(request_of, cycles=cycles), 1)
    with pytest.raises(InputError, match="cannot be started"):
        statuses(replace(request_of, folder=tmp_path / "other", cycles=cycles), 1)


@pytest.mark.slow
def test_several_processes_write_the_same_bytes(request_of, tmp_path):
    assert statuses(request_of, 3) == ["made"] * 3
    other = replace(request_of, folder=tmp_path / "other")
    assert [o.status for o in render_data(other, 3, workers=2)] == ["made"] * 3
    for file in request_of.folder.glob("*.safetensors"):
        assert file.read_bytes() == (other.folder / file.name).read_bytes()
