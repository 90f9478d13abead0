"""A run says what it is doing while it does it, and how it ended."""

import errno
import json
import logging
import threading
import time
from dataclasses import replace
from pathlib import Path

import pytest
from tiny_job import carry_out
from tiny_runs import compute, plan_tiny

from flows import pace, recording
from flows.cli import _parser
from flows.commands import Request
from flows.job import compute_here
from flows.recording import RunRecorder
from flows.run_records import CANCELLED, DONE, FAILED, RUNNING, RunIndex
from stages.base import Progress
from stages.errors import TransientError
from stages.locks import file_lock, is_locked
from stages.store import Store
from stages.store_cleaning import LEASE, collect_garbage


def states(record) -> list[str]:
    return [stage.state for stage in record.stages.values()]


def test_done_run_names_its_stages_keys_and_seconds(store, source, tmp_path):
    record = carry_out(store, source, tmp_path / "out")
    assert (record.state, record.stage, record.error) == (DONE, "total", "")
    assert states(record) == ["computed"] * 3
    assert record.keys == set(store.keys()) and len(record.keys) == 3
    assert all(stage.seconds >= 0 for stage in record.stages.values())
    assert record.source == str(source) and record.folder == str(tmp_path / "out")
    assert record.preset == "standard" and record.pipeline == "tiny"
    assert record.started <= record.ended <= record.changed + 1.0
    copy = tmp_path / "out" / "record.json"
    assert json.loads(copy.read_text())["id"] == record.id


def test_second_run_is_a_page_of_its_own_and_all_cached(store, source, tmp_path):
    first = carry_out(store, source, tmp_path / "out")
    second = carry_out(store, source, tmp_path / "out")
    assert first.id != second.id and first.keys == second.keys
    assert states(second) == ["cached"] * 3


def test_stages_that_are_not_asked_for_have_no_key(store, source, tmp_path):
    record = carry_out(store, source, tmp_path / "out", skip=frozenset({"walk"}), until="digits")
    assert states(record) == ["computed", "skipped", "not asked for"]
    assert len(record.keys) == 1


def test_failed_run_says_why_in_a_line_and_at_length_in_its_log(store, source, tmp_path):
    record = carry_out(store, source, tmp_path / "out", "walk.fault=defect")
    assert (record.state, record.error) == (FAILED, "RuntimeError: a defect")
    assert states(record) == ["computed", "failed", "waiting"]
    log = RunIndex(store.root).log(record.id).read_text()
    assert "Traceback" in log and "RuntimeError: a defect" in log
    assert (tmp_path / "out" / "run.log").read_text() == log


def test_cancelled_run_says_so(store, source, tmp_path):
    def interrupt(plan, job):
        raise KeyboardInterrupt

    record = carry_out(store, source, tmp_path / "out", compute=interrupt)
    assert (record.state, record.error, states(record)) == (CANCELLED, "", ["waiting"] * 3)


def test_log_lines_tell_time_level_stage_and_message(store, source, tmp_path):
    def warn(plan, job):
        logging.getLogger("stages.walk").warning("a view was dropped")
        logging.getLogger("stages.walk").info("step [7] of 9")
        logging.getLogger("stages.walk").debug("too much")
        job.store._say("artifact is damaged")
        return compute_here(plan, job)

    logger = logging.getLogger("stages")
    before = logger.level, list(logger.handlers)
    record = carry_out(store, source, tmp_path / "out", compute=warn)
    lines = RunIndex(store.root).log(record.id).read_text().splitlines()
    parts = [line.split(maxsplit=3) for line in lines]
    assert all(stamp[10] == "T" and stamp[-5] in "+-" for stamp, *_ in parts)
    said = [(level, stage, text) for _, level, stage, text in parts]
    assert said[2:5] == [
        ("WARNING", "-", "a view was dropped"),
        ("INFO", "-", "step [7] of 9"),
        ("WARNING", "-", "artifact is damaged"),
    ]
    assert said[0][2].startswith("svim3d run ")
    assert (logger.level, logger.handlers) == before
    assert any(stage == "walk" and text.startswith("computed") for _, stage, text in said)
    assert said[-1][2].startswith("done after")


def recorder(store: Store, source: Path, out: Path, *overrides: str) -> RunRecorder:
    return RunRecorder(
        store, plan_tiny(store, source, *overrides), out, preset="standard", command=("run",)
    )


def test_page_moves_with_the_steps_but_is_not_written_at_each(store, source, tmp_path, monkeypatch):
    recorded = recorder(store, source, tmp_path / "out")
    index = RunIndex(store.root)
    with recorded:
        walk = plan_tiny(store, source).steps[1]
        recorded.started(walk)
        recorded.progressed(Progress("walk", 3, 40, {}))
        assert (index.records()[0].step, index.records()[0].now) == (0, RUNNING)
        monkeypatch.setattr(recording, "WRITE_EVERY_S", 0.0)
        recorded.progressed(Progress("walk", 4, 40, {}))
        assert (index.records()[0].step, index.records()[0].total) == (4, 40)
        assert states(index.records()[0]) == ["waiting", "computing", "waiting"]


def test_page_tells_when_the_stage_will_be_done(store, source, tmp_path, monkeypatch):
    monkeypatch.setattr(recording, "WRITE_EVERY_S", 0.0)
    clock = iter((100.0, 102.0, 103.0, 200.0, 201.0))
    monkeypatch.setattr(pace.time, "monotonic", lambda: next(clock))
    follow = pace.Pace()
    # A resumed stage begins in its midst: what it did before this run says nothing of its pace.
    assert [follow.left_s(Progress("walk", step, 40, {})) for step in (20, 24, 30)] == [
        None,
        2.0 / 4 * 16,
        3.0 / 10 * 10,
    ]
    # Tried again, it goes back.
    assert [follow.left_s(Progress("walk", step, 40, {})) for step in (20, 30)] == [None, 1.0]
    monkeypatch.undo()
    monkeypatch.setattr(recording, "WRITE_EVERY_S", 0.0)
    recorded = recorder(store, source, tmp_path / "out")
    with recorded:
        walk = plan_tiny(store, source).steps[1]
        recorded.started(walk)
        for step in (1, 2):
            time.sleep(0.05)
            recorded.progressed(Progress("walk", step, 41, {}))
        left_s = RunIndex(store.root).records()[0].due - time.time()
        assert 0.5 < left_s < 30.0
        recorded.started(plan_tiny(store, source).steps[2])
        assert RunIndex(store.root).records()[0].due is None


def test_events_of_stages_are_on_the_page(store, source, tmp_path):
    record = carry_out(
        store, source, tmp_path / "out", "walk.fault=defect", skip=frozenset({"walk"})
    )
    [event] = record.stages["total"].events
    assert event == "the numbers stay where they were"
    failed = carry_out(store, source, tmp_path / "out", "walk.fault=defect")
    assert failed.stages["walk"].events == ("RuntimeError: a defect",)
    assert failed.stages["digits"].events == ()


def test_cleaning_takes_nothing_that_a_run_at_work_has_named(store, source, tmp_path):
    compute(plan_tiny(store, source), store)
    index = RunIndex(store.root)

    def needed() -> frozenset[str]:
        return frozenset().union(*(r.keys for r in index.records() if r.now == RUNNING))

    with recorder(store, source, tmp_path / "out"):
        assert not is_locked(store.root / LEASE)
        assert collect_garbage(store, needed, older_than_s=-1.0) == []
    assert len(collect_garbage(store, needed, older_than_s=-1.0)) == 3


def test_run_that_lost_artifacts_between_plan_and_start_is_a_passing_fault(store, source, tmp_path):
    compute(plan_tiny(store, source), store)
    late = recorder(store, source, tmp_path / "out")
    collect_garbage(store, frozenset, older_than_s=-1.0)
    with pytest.raises(TransientError, match="digits, walk, total left the store"), late:
        pytest.fail("the run began")
    assert RunIndex(store.root).records()[0].state == FAILED


def test_run_waits_with_its_page_until_a_cleaning_has_decided(store, source, tmp_path):
    thread = threading.Thread(target=lambda: recorder(store, source, tmp_path / "o").__enter__())
    with file_lock(store.root / LEASE):
        thread.start()
        thread.join(0.3)
        assert thread.is_alive() and RunIndex(store.root).records() == []
    thread.join(30)
    assert len(RunIndex(store.root).records()) == 1


def test_store_that_cannot_be_written_costs_the_page_only(store, source, tmp_path, monkeypatch):
    compute(plan_tiny(store, source), store)

    def refuse(*_, **__):
        raise OSError(errno.EROFS, "Read-only file system")

    monkeypatch.setattr(recording, "file_lock", refuse)
    monkeypatch.setattr(RunIndex, "write", refuse)
    with recorder(store, source, tmp_path / "out") as recorded:
        recorded.say("still here")
    assert recorded.record.state == DONE
    assert RunIndex(store.root).records() == []


def test_log_on_a_full_disk_costs_its_lines_only(capsys):
    with recording._log_to(Path("/dev/full"), lambda: "nerf"):
        logging.getLogger("flows").info("lost")
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("days", [-7, 7])
def test_clock_that_jumps_changes_no_result(store, source, tmp_path, monkeypatch, days):
    undisturbed = carry_out(Store(tmp_path / "other"), source, tmp_path / "out")
    now, jump = time.time, iter([0.0] * 4)
    monkeypatch.setattr(time, "time", lambda: now() + next(jump, 86_400.0 * days))
    record = carry_out(store, source, tmp_path / "out")
    assert (record.state, states(record)) == (DONE, ["computed"] * 3)
    assert next(jump, None) is None and record.duration_s >= 0.0
    assert record.keys == undisturbed.keys
    for key in record.keys:
        made, wanted = (s.check(key).stored.manifest for s in (store, Store(tmp_path / "other")))
        assert made.files == wanted.files


@pytest.mark.parametrize(
    "given",
    [
        [],
        ["photo", "--preset", "paper", "--seed", "7", "--device", "cpu"],
        ["a b.png", "-o", "out put", "--set", "nerf.steps=3", "--set", "skip=[dmtet]"],
        [
            "x.glb",
            "--from",
            "nerf",
            "--until",
            "export",
            "--skip",
            "dmtet,capacity",
            "--skip",
            "preview",
        ],
        ["x.glb", "--only", "nerf", "--force", "nerf", "--samples", "3", "--model", "m o"],
    ],
)
def test_recorded_command_asks_for_the_same(given, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)

    def request_of(arguments) -> Request:
        return Request.of(_parser().parse_args(["run", *arguments]))

    first = request_of(given)
    again = request_of(first.command[1:])
    assert again == replace(
        first, source=again.source, out=first.run_folder.resolve(), store=first.store.resolve()
    )
    assert again.path.resolve() == first.path.resolve()
    # From anywhere else, too.
    monkeypatch.chdir("/")
    assert request_of(first.command[1:]).command == first.command
