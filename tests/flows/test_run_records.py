"""Pages of runs: found by any name, judged by their processes, kept by their worth."""

import json
import time
from dataclasses import replace

import pytest
from tiny_job import gone_process, page

from flows.run_records import (
    CANCELLED,
    DIED,
    DONE,
    FAILED,
    RUNNING,
    SILENT_S,
    RunIndex,
    RunRecord,
    StageRecord,
    new_id,
    newest_of_folders,
    worth_keeping,
)
from stages.errors import InputError


@pytest.fixture
def index(tmp_path) -> RunIndex:
    return RunIndex(tmp_path)


def test_page_is_read_as_it_was_written(index):
    index.write(page(3, stages={"a": StageRecord(None, "skipped")}, ended=None, error="x: [y]"))
    assert index.records() == [
        page(
            3,
            stages={"a": StageRecord(None, "skipped")},
            ended=None,
            error="x: [y]",
            started=index.records()[0].started,
            changed=index.records()[0].changed,
        )
    ]


def test_page_of_an_earlier_version_is_read(index):
    index.write(page(3))
    old = json.loads(index.page(page(3).id).read_text())
    del old["due"], old["stages"]["nerf"]["events"]
    index.page(page(3).id).write_text(json.dumps(old))
    [record] = index.records()
    assert record.due is None and record.stages["nerf"].events == ()


@pytest.mark.parametrize(
    "change",
    [
        {"due": "soon"},
        {"stages": {"a": {"key": None, "state": "done", "events": [1]}}},
        {"stages": {"a": {"key": None, "state": "done", "events": None}}},
        {"id": "../evil"},
        {"id": ".hidden"},
        {"id": 7},
        {"started": float("nan")},
        {"started": float("inf")},
        {"ended": 1e30},
        {"ended": "now"},
        {"step": -1},
        {"command": [1]},
        {"command": 3},
        {"process": {}},
        {"stages": {"a": {"key": 3, "state": "done"}}},
        {"stages": []},
        {"extra": 1},
    ],
)
def test_page_with_anything_odd_is_none(index, change):
    text = json.dumps(json.loads(page().as_bytes()) | change).encode()
    with pytest.raises(ValueError, match="no page of a run"):
        RunRecord.parse(text)
    index.write(page(1))
    (index.folder / "odd.json").write_bytes(text)
    (index.folder / "half.json").write_bytes(text[:40])
    assert [record.id for record in index.records()] == [page(1).id]


def test_run_whose_process_is_gone_died(index):
    at_work = page(state=RUNNING, ended=None)
    assert at_work.now == RUNNING
    assert replace(at_work, process=gone_process()).now == DIED
    assert replace(at_work, process=gone_process(), state=DONE).now == DONE


def test_run_elsewhere_counts_as_long_as_it_gives_signs():
    elsewhere = replace(page().process, host="far", boot="other")
    now = time.time()
    record = page(state=RUNNING, ended=None, process=elsewhere, started=now - 2e4, changed=now - 60)
    assert record.now == RUNNING
    assert replace(record, changed=now - SILENT_S - 60).now == DIED


def test_time_taken_ends_with_the_run_or_its_last_sign_and_is_never_negative():
    assert page().duration_s == pytest.approx(60.0)
    died = page(state=RUNNING, ended=None, process=gone_process())
    assert died.duration_s == pytest.approx(60.0)
    assert page(state=RUNNING, ended=None).duration_s == pytest.approx(1000.0, abs=30.0)
    assert page(ended=page().started - 100.0).duration_s == 0.0


def test_run_is_found_by_id_beginning_folder_and_name(index, tmp_path, monkeypatch):
    old, new, other = page(1), page(2, folder="/out/cat1"), page(0x3000000)
    for record in (old, new, other):
        index.write(record)
    monkeypatch.chdir("/")
    assert index.find(old.id) == old
    # Of a folder's runs the newest is meant.
    assert index.find("/out/cat1") == index.find("out/../out/cat1") == index.find("cat1") == new
    assert index.find("cat-03") == other
    with pytest.raises(InputError, match=r"may be any of .*cat-"):
        index.find("cat-0")
    with pytest.raises(InputError, match="there is no run dog"):
        index.find("dog")


def test_each_run_has_an_id_that_is_a_file_name(index):
    ids = {new_id(name) for name in ["a b/../c", "", "...", "Katze_ü", "x" * 300] * 20}
    assert len(ids) == 100
    for name in ids:
        index.write(page(id=name))
        assert index.page(name).parent == index.folder and index.page(name).is_file()


def test_forgotten_run_leaves_nothing(index):
    index.write(page())
    index.log(page().id).write_text("x")
    index.forget(page().id)
    assert list(index.folder.iterdir()) == []


def test_newest_run_stands_for_its_folder_and_imported_ones_for_themselves():
    runs = [page(1), page(2, folder="/out/cat1"), page(3, folder=""), page(4, folder="")]
    assert [r.id for r in newest_of_folders(runs)] == [page(n).id for n in (4, 3, 2)]


def runs_of_one_cat(*states: str) -> list[RunRecord]:
    """Oldest first, each with a key of its own."""
    return [page(n, source="/in/cat.png", state=state) for n, state in enumerate(states)]


def kept(records: list[RunRecord], keep_last: int) -> set[int]:
    return {records.index(record) for record in worth_keeping(records, keep_last)}


def test_newest_runs_of_each_input_are_worth_keeping():
    cats, dog = runs_of_one_cat(DONE, DONE, DONE), page(9, source="/in/dog.png", started=0.0)
    assert kept([*cats, dog], 2) == {1, 2, 3}
    assert kept([*cats, dog], 0) == set()


def test_failures_do_not_push_out_results():
    assert kept(runs_of_one_cat(DONE, DONE, FAILED, CANCELLED, FAILED), 1) == {1, 4}


def test_repeated_run_is_one_and_its_newest_page_stands():
    cats = [replace(cat, stages=page(0).stages) for cat in runs_of_one_cat(DONE, DONE, DONE)]
    assert kept([page(7, source="/in/cat.png", started=1.0), *cats], 2) == {0, 3}


def test_runs_at_work_are_kept_whatever_their_age():
    cats = runs_of_one_cat(RUNNING, DONE, DONE)
    assert kept(cats, 1) == {0, 2}
    cats[0] = replace(cats[0], process=gone_process())
    assert kept(cats, 1) == {2}


def test_page_makes_no_store(tmp_path):
    index = RunIndex(tmp_path / "gone")
    with pytest.raises(FileNotFoundError):
        index.write(page())
    assert not (tmp_path / "gone").exists()
