import json
from dataclasses import replace

import pytest

from flows.cli import main
from flows.commands import Request
from flows.export import again, settings_of
from flows.options import export_options
from flows.processes import Process
from flows.run_records import RunIndex, RunRecord
from stages.errors import InputError

ASKED = Request(
    source="example",
    out=None,
    preset="preview",
    overrides=("nerf.steps=7", "export.lods=1"),
    skip=frozenset({"dmtet"}),
    start="nerf",
    until="export",
    only=None,
    force=frozenset({"nerf"}),
    seed=5,
    device="cpu",
    store=None,
)


@pytest.fixture
def record(tmp_path):
    request = replace(ASKED, out=tmp_path / "out", store=tmp_path / "store")
    return RunRecord(
        id="out-1",
        command=request.command,
        cwd=str(tmp_path),
        pipeline="image-to-asset",
        source="example.json",
        preset="preview",
        folder=str(tmp_path / "out"),
        process=Process.this(),
        state="done",
        stages={},
        stage="",
        step=0,
        total=0,
        started=1.0,
        changed=1.0,
        ended=1.0,
        error="",
    )


def parsed(*arguments):
    return export_options().parse_args(["out", *arguments])


def test_options_become_settings():
    given = parsed("--formats", "usdz, obj,glb", "--lods", "3", "--compression", "draco")
    assert settings_of(given) == (
        'export.formats=["glb", "usdz", "obj"]',
        "export.lods=3",
        'export.compression="draco"',
    )
    with pytest.raises(InputError, match="wanted --formats"):
        settings_of(parsed())


def test_a_run_is_asked_for_whole_with_other_settings(record, tmp_path):
    request = again(record, ("export.lods=3",))
    assert request.overrides == ("nerf.steps=7", "export.lods=1", "export.lods=3")
    assert (request.start, request.until, request.only, request.force) == (None,) * 3 + (
        frozenset(),
    )
    assert request.skip == {"dmtet"}
    assert (request.seed, request.preset, request.source) == (5, "preview", "example")
    assert request.run_folder == tmp_path / "out"


def test_other_runs_are_refused(record):
    with pytest.raises(InputError, match="makes an asset"):
        again(replace(record, pipeline="relight"), ())
    with pytest.raises(InputError, match="makes an asset"):
        again(replace(record, command=()), ())


def test_what_is_not_finished_is_not_computed(record, tmp_path, capsys):
    store = tmp_path / "store"
    store.mkdir()
    RunIndex(store).write(record)
    code = main(["export", "out", "--formats", "obj", "--store", str(store)])
    told = capsys.readouterr().err
    assert code == 2
    assert "generation" in told
    # The same command again would stop as early again.
    assert "without --until, --only: svim3d run example" in told
    assert not (tmp_path / "out" / "run.json").exists()


def test_unknown_formats_name_the_known_ones(record, tmp_path, capsys):
    store = tmp_path / "store"
    store.mkdir()
    RunIndex(store).write(record)
    assert main(["export", "out", "--formats", "fbx", "--store", str(store)]) == 2
    told = capsys.readouterr().err
    assert "usdz" in told
    assert json.loads((store / "runs" / "out-1.json").read_text())["id"] == "out-1"
