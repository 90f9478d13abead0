"""Runs under the Prefect engine: states, retries by kind of fault, resumed runs, no leftovers."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import tiny_command
import torch
from tiny_runs import plan_tiny

from flows import cli
from flows.run_records import CANCELLED, COMPUTING, DIED, RunIndex, StageRecord
from stages.errors import InputError
from stages.store import Store, Stored

pytestmark = pytest.mark.flow
CPU = torch.device("cpu")
NO_PAUSE = (0.0, 0.0)


class Watcher:
    """Keeps what it is told."""

    def __init__(self) -> None:
        self.told: list[tuple[str, str]] = []

    def started(self, step):
        self.told.append(("started", step.node.name))

    def progressed(self, progress):
        self.told.append(("progressed", progress.stage))

    def failed(self, step, error):
        self.told.append(("failed", step.node.name))

    def finished(self, step, stored):
        self.told.append(("finished", step.node.name))

    def count(self, what: str, name: str) -> int:
        return self.told.count((what, name))


def execute(store: Store, source: Path, *overrides: str, **wishes) -> tuple[Watcher, dict]:
    from flows.image_to_asset import run_plan
    from flows.steps import Bench

    watcher = Watcher()
    plan = plan_tiny(store, source, *overrides, **wishes)
    try:
        return watcher, run_plan(Bench(plan, store, CPU, watcher), retry_delays_s=NO_PAUSE)
    except Exception as error:
        error.watcher = watcher
        raise


def payload(stored: Stored) -> bytes:
    return (stored.folder / "numbers.safetensors").read_bytes()


def recorded_tasks() -> list:
    """Task runs of the latest flow run, as the server knows them."""
    from prefect.client.orchestration import get_client
    from prefect.client.schemas.filters import FlowRunFilter, FlowRunFilterId
    from prefect.client.schemas.sorting import FlowRunSort

    with get_client(sync_client=True) as client:
        latest = client.read_flow_runs(sort=FlowRunSort.START_TIME_DESC, limit=1)[0]
        only = FlowRunFilter(id=FlowRunFilterId(any_=[latest.id]))
        return client.read_task_runs(flow_run_filter=only)


def test_fault_of_a_stage_is_told_though_the_engine_cannot_note_it(
    engine, store, source, monkeypatch
):
    from prefect import flow_engine

    propose = flow_engine.propose_state_sync

    def refuse(client, state, **rest):
        if state.is_failed():
            raise RuntimeError("500: the data base is full")
        return propose(client, state, **rest)

    monkeypatch.setattr(flow_engine, "propose_state_sync", refuse)
    with pytest.raises(InputError, match="the walk cannot start here"):
        execute(store, source, "walk.fault=input")


def test_an_engine_that_fails_stops_no_run(engine, store, source, monkeypatch, caplog):
    class Overrun:
        def with_options(self, **options):
            return self

        def __call__(self, *arguments, **options):
            raise ConnectionError("503 Service Unavailable")

    monkeypatch.setattr("flows.tasks.STAGE_TASK", Overrun())
    _, made = execute(store, source, "walk.fault=io", "walk.faults=1")
    assert sorted(made) == ["digits", "total", "walk"]
    assert not any(stored.is_cached for stored in made.values())
    assert caplog.text.count("the engine failed (503 Service Unavailable)") == 3


def test_a_flow_that_cannot_end_has_its_artifacts(engine, store, source, monkeypatch):
    from prefect import flow_engine

    def refuse(client, state, **rest):
        raise ConnectionError("503 Service Unavailable")

    monkeypatch.setattr(flow_engine, "propose_state_sync", refuse)
    _, made = execute(store, source)
    assert sorted(made) == ["digits", "total", "walk"]


def test_failed_run_writes_nothing_of_it_to_the_engines_home(engine, store, source):
    from prefect.settings import PREFECT_LOCAL_STORAGE_PATH

    kept = set(PREFECT_LOCAL_STORAGE_PATH.value().rglob("*"))
    with pytest.raises(InputError, match="the walk cannot start here"):
        execute(store, source, "walk.fault=input")
    assert set(PREFECT_LOCAL_STORAGE_PATH.value().rglob("*")) == kept


def test_computed_and_cached_stages_show_as_such(engine, store, source):
    watcher, first = execute(store, source)
    assert [n for what, n in watcher.told if what == "finished"] == ["digits", "walk", "total"]
    assert watcher.count("progressed", "walk") >= 1
    assert {r.state_name for r in recorded_tasks()} == {"Completed"}

    watcher, second = execute(store, source, "walk.steps=3")
    states = {r.name: r.state_name for r in recorded_tasks()}
    assert states == {
        f"digits-digits-{second['digits'].key[:8]}": "Cached",
        f"walk-digits-{second['walk'].key[:8]}": "Completed",
        f"total-digits-{second['total'].key[:8]}": "Completed",
    }
    # For each task with a tag Prefect asks the server for a slot.
    assert not any(run.tags for run in recorded_tasks())
    assert second["digits"].is_cached and not second["walk"].is_cached
    assert first["digits"].key == second["digits"].key


@pytest.mark.parametrize("fault", ["transient", "memory", "cuda memory", "io"])
def test_passing_faults_are_tried_again(engine, store, source, fault):
    watcher, artifacts = execute(store, source, f"walk.fault={fault}", "walk.faults=2")
    assert watcher.count("failed", "walk") == 2 and "total" in artifacts
    # Each attempt that failed shows in the manifest, and with it in the run's table.
    kinds = [event["kind"] for event in artifacts["walk"].manifest.record["events"]]
    assert kinds == 2 * [
        {"transient": "transient_fault", "io": "io_fault"}.get(fault, "out_of_memory")
    ]


def test_tries_have_an_end(engine, store, source):
    with pytest.raises(MemoryError) as caught:
        execute(store, source, "walk.fault=memory", "walk.faults=9")
    assert caught.value.watcher.count("started", "walk") == 1 + len(NO_PAUSE)


@pytest.mark.parametrize(("fault", "kind"), [("input", InputError), ("defect", RuntimeError)])
def test_lasting_faults_are_not(engine, store, source, fault, kind):
    with pytest.raises(kind) as caught:
        execute(store, source, f"walk.fault={fault}")
    assert caught.value.watcher.count("started", "walk") == 1
    assert caught.value.watcher.count("started", "total") == 0
    assert store.check(plan_tiny(store, source).steps[0].recipe.key).state == "ok"


def test_skipped_forced_and_partial_runs(engine, store, source):
    _, whole = execute(store, source)
    _, without = execute(store, source, skip=frozenset({"walk"}))
    assert set(without) == {"digits", "total"} and payload(without["total"]) != payload(
        whole["total"]
    )
    assert without["total"].manifest.record["events"][0]["kind"] == "no_walk"
    watcher, forced = execute(store, source, force=frozenset({"walk"}))
    assert watcher.count("started", "walk") == 1 and watcher.count("started", "total") == 0
    assert payload(forced["walk"]) == payload(whole["walk"])
    watcher, _ = execute(store, source, start="walk")
    assert watcher.count("started", "total") == 1
    _, part = execute(store, source, "walk.steps=9", until="walk")
    assert set(part) == {"digits", "walk"}


def files_of(stored: Stored) -> dict[str, bytes]:
    """Everything of an artifact that a resumed run must make equal: all but the record."""
    folder = stored.folder.parent
    return {name: (folder / name).read_bytes() for name in stored.manifest.files}


@pytest.mark.parametrize(
    ("stop", "code"),
    [
        (signal.SIGKILL, -9),
        (signal.SIGINT, 130),
        pytest.param(signal.SIGTERM, 130, marks=pytest.mark.slow),
    ],
)
def test_stopped_run_goes_on_and_ends_with_equal_bytes(engine, tmp_path, source, stop, code):
    store, untouched = Store(tmp_path / "store"), Store(tmp_path / "untouched")
    slow = ("walk.steps=40", "walk.pause_s=0.05")
    walk = plan_tiny(store, source, *slow).steps[1].recipe.key
    sets = [part for override in slow for part in ("--set", override)]
    command = ["run", source, "-o", tmp_path / "out", "--store", store.root, *sets]
    process = tiny_command.start(command)
    scalars = store.work(walk) / "scalars.csv"
    deadline = time.monotonic() + 90
    # A checkpoint flushes the rows before it: wait for the one before step 10.
    while not (scalars.exists() and "\n9,mean" in scalars.read_text()):
        assert process.poll() is None and time.monotonic() < deadline, process.communicate()
        time.sleep(0.02)
    process.send_signal(stop)
    _, errors = process.communicate(timeout=30)
    assert process.returncode == code, errors
    assert ("goes on where this one stopped" in errors) == (code == 130)
    assert (store.work(walk) / "checkpoint.safetensors").exists()
    record = RunIndex(store.root).find(str(tmp_path / "out"))
    assert record.now == (CANCELLED if code == 130 else DIED)
    assert record.stages["walk"] == StageRecord(walk, COMPUTING)
    log = RunIndex(store.root).log(record.id).read_text()
    assert f"computing {walk[:8]}" in log and ("cancelled after" in log) == (code == 130)

    assert tiny_command.main([str(a) for a in command]) == cli.DONE
    page = json.loads((tmp_path / "out" / "run.json").read_text())
    assert page["stages"]["digits"]["state"] == "cached"
    assert page["stages"]["walk"]["events"][0]["kind"] == "resumed"
    _, whole = execute(untouched, source, *slow)
    for step in plan_tiny(store, source, *slow).steps:
        assert files_of(step.stored) == files_of(whole[step.node.name])


def test_command_computes_then_answers_from_the_store(engine, store, source, tmp_path, capsys):
    command = ["run", str(source), "-o", str(tmp_path / "out"), "--store", str(store.root)]
    assert tiny_command.main(command) == cli.DONE
    printed = capsys.readouterr().out
    assert printed.count(" computed ") == 3 and "waiting for the engine" in printed
    assert "engine_startup_s" in json.loads((tmp_path / "out" / "run.json").read_text())
    assert tiny_command.main(command) == cli.DONE
    assert capsys.readouterr().out.count(" cached ") == 3


@pytest.mark.parametrize(
    ("fault", "code", "complaint"),
    [("input", cli.BAD_INPUT, "the walk cannot start here"), ("defect", cli.FAILED, "a defect")],
)
def test_failed_command_says_why_in_a_line(
    engine, store, source, tmp_path, capsys, fault, code, complaint
):
    options = ["-o", str(tmp_path / "out"), "--store", str(store.root)]
    given = ["run", str(source), *options, "--set", f"walk.fault={fault}"]
    assert tiny_command.main(given) == code
    errors = capsys.readouterr().err
    assert complaint in errors and "Traceback" not in errors


def test_stage_past_its_limit_is_stopped_once_and_goes_on(engine, store, source, tmp_path, capsys):
    command = ["run", str(source), "-o", str(tmp_path / "out"), "--store", str(store.root)]
    slow = ["--set", "walk.steps=40", "--set", "walk.pause_s=0.05"]
    assert tiny_command.main([*command, *slow, "--timeout", "walk=0.5"]) == cli.FAILED
    assert "walk was stopped after its 0.5 s" in capsys.readouterr().err
    assert tiny_command.main([*command, *slow, "--timeout", "60"]) == cli.DONE
    events = json.loads((tmp_path / "out" / "run.json").read_text())["stages"]["walk"]["events"]
    assert [event["kind"] for event in events] == ["timeout", "resumed"]
    assert "attempt" in capsys.readouterr().out  # in the table


def test_server_goes_with_its_parent_however_that_ends(tmp_path):
    script = f"""
import os, sys
os.environ.pop("PREFECT_API_URL", None)
from pathlib import Path
from flows.engine import Engine
with Engine(Path({str(tmp_path / "home")!r})) as engine:
    print(engine._server.pid, flush=True)
    sys.stdin.read()
"""
    parent = subprocess.Popen(
        [sys.executable, "-c", script],
        cwd=tiny_command.PROJECT,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    server = int(parent.stdout.readline())
    os.kill(server, 0)
    parent.kill()
    parent.wait()
    deadline = time.monotonic() + 60
    while Path(f"/proc/{server}").exists():
        assert time.monotonic() < deadline, "the server outlived its parent"
        time.sleep(0.1)
    parent.communicate()
