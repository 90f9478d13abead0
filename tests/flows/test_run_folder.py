"""A run folder shows one run: its products, its artifacts, its page."""

import json
import shutil
from pathlib import Path

import pytest
from tiny_runs import compute, plan_tiny

from flows.pipeline import IMAGE_TO_ASSET
from flows.run_folder import require_ours, write_run_folder
from stages.errors import InputError


def test_run_folder_holds_products_links_and_page(store, source, tmp_path):
    plan = plan_tiny(store, source)
    artifacts = compute(plan, store)
    out = tmp_path / "out" / "digits"
    write_run_folder(out, plan, artifacts, store, {"preset": "standard"})
    assert (out / "walk").is_symlink() and not Path((out / "walk").readlink()).is_absolute()
    assert (out / "walk" / "manifest.json").is_file()
    product = artifacts["total"].folder / "numbers.safetensors"
    assert (out / "total.safetensors").read_bytes() == product.read_bytes()
    page = json.loads((out / "run.json").read_text())
    assert page["preset"] == "standard" and page["config"]["walk"]["steps"] == 40
    assert page["stages"]["walk"]["state"] == "computed"
    assert page["stages"]["walk"]["key"] == artifacts["walk"].key
    assert page["stages"]["walk"]["seconds"] >= 0
    assert page["products"] == {"total.safetensors": product.stat().st_size}


def test_products_outlive_the_store(store, source, tmp_path):
    plan = plan_tiny(store, source)
    write_run_folder(tmp_path / "out", plan, compute(plan, store), store, {})
    moved = (tmp_path / "out").rename(tmp_path / "elsewhere")
    shutil.rmtree(store.root)
    assert (moved / "total.safetensors").stat().st_size > 0


def test_second_run_leaves_nothing_of_the_first(store, source, tmp_path):
    plan = plan_tiny(store, source)
    write_run_folder(tmp_path / "out", plan, compute(plan, store), store, {})
    part = plan_tiny(store, source, until="digits")
    write_run_folder(tmp_path / "out", part, compute(part, store), store, {})
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert names == {"digits", "run.json"}


def test_copies_stand_in_where_links_fail(store, source, tmp_path, monkeypatch):
    def refuse(*_, **__):
        raise OSError("no links here")

    monkeypatch.setattr(Path, "symlink_to", refuse)
    plan = plan_tiny(store, source)
    for _ in range(2):
        write_run_folder(tmp_path / "out", plan, compute(plan, store), store, {})
    assert not (tmp_path / "out" / "walk").is_symlink()
    assert (tmp_path / "out" / "walk" / "manifest.json").is_file()


def test_forbidden_folder_is_refused(store, source, tmp_path):
    plan = plan_tiny(store, source)
    (tmp_path / "out").write_text("a file is in the way")
    with pytest.raises(InputError, match=r"run folder .* cannot be written"):
        write_run_folder(tmp_path / "out", plan, compute(plan, store), store, {})


def test_folder_of_somebody_else_is_left_alone(store, source, tmp_path):
    plan = plan_tiny(store, source)
    (tmp_path / "out" / "walk").mkdir(parents=True)
    (tmp_path / "out" / "walk" / "diary.txt").write_text("mine")
    with pytest.raises(InputError, match="is no run folder, yet holds walk"):
        write_run_folder(tmp_path / "out", plan, compute(plan, store), store, {})
    assert (tmp_path / "out" / "walk" / "diary.txt").read_text() == "mine"
    assert not (tmp_path / "out" / "run.json").exists()


def test_the_folder_of_a_run_that_failed_is_taken_again(tmp_path, store, source):
    # Such a folder holds a record and a report, and nothing of a finished run.
    out = tmp_path / "out"
    out.mkdir()
    (out / "report.html").write_text("of a run that failed")
    with pytest.raises(InputError, match=r"holds report\.html"):
        require_ours(out, IMAGE_TO_ASSET)
    (out / "record.json").write_text("{}")
    require_ours(out, IMAGE_TO_ASSET)
