"""Batches on Dask and Ray, where they are installed, and what is said where they are not."""

import importlib.util
import os
import sys

import pytest
import tiny_batch
from tiny_batch import states

from flows import batch, cli

pytestmark = pytest.mark.flow


@pytest.mark.parametrize("runner", ["dask", "ray"])
def test_missing_package_is_named(tmp_path, runner, capsys, monkeypatch):
    monkeypatch.setattr(batch.importlib.util, "find_spec", lambda name: None)
    given = [tmp_path, "-o", tmp_path / "out", "--runner", runner, "--store", tmp_path / "store"]
    assert tiny_batch.main(given) == cli.BAD_INPUT
    assert f"pip install 'svim3d[{runner}]'" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
@pytest.mark.parametrize("runner", ["dask", "ray"])
def test_clusters_do_the_same(engine, tmp_path, runner, monkeypatch):
    if importlib.util.find_spec(f"prefect_{runner}") is None:
        pytest.skip(f"needs prefect-{runner}")
    # Processes that a cluster starts know the tiny pipeline only so.
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, sys.path)))
    (tmp_path / "in").mkdir()
    for name, text in {"a": "1", "b": "2", "broken": "one"}.items():
        (tmp_path / "in" / f"{name}.txt").write_text(text)
    command = [tmp_path / "in", "-o", tmp_path / "out", "--store", tmp_path / "store"]
    options = ["--jobs", 2, "--runner", runner, "--set", "walk.steps=3"]
    assert tiny_batch.main([*command, *options]) == cli.FAILED
    assert states(tmp_path / "out") == {"a": "computed", "b": "computed", "broken": "failed"}
    broken = tiny_batch.rows(tmp_path / "out")["broken"]
    assert broken["stage"] == "digits" and "write numbers" in broken["error"]
    (tmp_path / "in" / "broken.txt").write_text("3")
    assert tiny_batch.main([*command, "--set", "walk.steps=3"]) == cli.DONE
    assert states(tmp_path / "out") == {"a": "cached", "b": "cached", "broken": "computed"}
