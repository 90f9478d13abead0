"""Where somebody looks a run shows its progress, pages and lines; elsewhere nothing is sent."""

import logging
import threading
import time
from pathlib import Path

import pytest
import torch
from test_flow import Watcher
from tiny_job import page
from tiny_runs import plan_tiny

from stages.store import Store

pytestmark = pytest.mark.flow


class Teller(Watcher):
    """Logs from where stages and flows may."""

    def started(self, step):
        logging.getLogger("stages.teller").info("begun %s", step.node.name)

    def progressed(self, progress):
        thread = threading.Thread(target=_say)
        thread.start()
        thread.join()

    def finished(self, step, stored):
        pass


def _say():
    from prefect.settings import PREFECT_LOGGING_TO_API_ENABLED, temporary_settings

    # What a test sets for a while holds in its thread alone.
    with temporary_settings({PREFECT_LOGGING_TO_API_ENABLED: True}):
        logging.getLogger("flows.teller").info("from a thread")


def execute(store: Store, source: Path, *overrides: str, watched: bool = True, said=()):
    """Run the tiny pipeline; the flow run as the server knows it, its artifacts and its lines."""
    from prefect.client.orchestration import get_client
    from prefect.client.schemas import filters
    from prefect.client.schemas.sorting import FlowRunSort
    from prefect.settings import PREFECT_LOGGING_TO_API_ENABLED, temporary_settings

    from flows.image_to_asset import run_plan
    from flows.steps import Bench

    bench = Bench(plan_tiny(store, source, *overrides), store, torch.device("cpu"), Teller())
    error = None
    with temporary_settings({PREFECT_LOGGING_TO_API_ENABLED: watched}):
        try:
            run_plan(bench, page(), retry_delays_s=())
        except RuntimeError as raised:
            error = raised
    with get_client(sync_client=True) as client:
        run = client.read_flow_runs(sort=FlowRunSort.START_TIME_DESC, limit=1)[0]
        only = filters.FlowRunFilterId(any_=[run.id])
        artifacts = client.read_artifacts(flow_run_filter=filters.FlowRunFilter(id=only))
        tasks = client.read_task_runs(flow_run_filter=filters.FlowRunFilter(id=only))
        of_run = filters.LogFilter(flow_run_id=filters.LogFilterFlowRunId(any_=[run.id]))
        deadline = time.monotonic() + 20
        lines = client.read_logs(of_run)
        while not {line.message for line in lines} >= set(said) and time.monotonic() < deadline:
            time.sleep(0.1)
            lines = client.read_logs(of_run)
    named = {a.key: a for a in artifacts if a.key}  # Prefect keeps results without a key
    return run, named, {t.name: t.id for t in tasks}, lines, error


@pytest.fixture
def loggers(monkeypatch):
    monkeypatch.setattr(logging.getLogger("flows"), "level", logging.INFO)
    monkeypatch.setattr(logging.getLogger("stages"), "level", logging.INFO)


def test_watched_run_has_names_pages_progress_and_lines(
    engine, store, source, loggers, monkeypatch
):
    from flows import showing

    monkeypatch.setattr(showing, "PROGRESS_EVERY_S", 0.1)
    slow = ("walk.steps=40", "walk.pause_s=0.03", "walk.fault=transient", "walk.faults=0")
    run, artifacts, tasks, _, error = execute(store, source, *slow)
    assert error is None
    assert run.name == "digits · standard · seed 0"
    assert {"asset:digits", "preset:standard", f"run:{page().id}"} <= set(run.tags)
    assert set(artifacts) == {"digits", "walk", "total", "run", "progress"}
    by_stage = {name.partition("-")[0]: number for name, number in tasks.items()}
    assert {name: artifacts[name].task_run_id for name in by_stage} == by_stage
    assert artifacts["progress"].task_run_id == by_stage["walk"]
    assert (artifacts["progress"].data, artifacts["progress"].description) == (100.0, "walk: done")
    assert "| mean |" in artifacts["walk"].data and "| total | computed |" in artifacts["run"].data
    assert page().id in artifacts["run"].data


def test_failed_run_shows_what_it_has(engine, store, source, loggers):
    before = list(logging.getLogger("stages").handlers)
    run, artifacts, _, _, error = execute(store, source, "walk.fault=defect")
    assert isinstance(error, RuntimeError) and run.state_name == "Failed"
    assert set(artifacts) == {"digits", "run"}
    assert artifacts["run"].data.startswith("**RuntimeError: a defect**")
    assert logging.getLogger("stages").handlers == before


def test_lines_reach_the_run_and_the_stage_that_they_are_of(engine, store, source, loggers):
    said = ("begun digits", "begun walk", "begun total", "from a thread")
    _, _, tasks, lines, _ = execute(store, source, said=said)
    by_stage = {name.partition("-")[0]: number for name, number in tasks.items()}
    told = {line.message: (line.name, line.task_run_id) for line in lines}
    for name, number in by_stage.items():
        assert told[f"begun {name}"] == ("stages.teller", number)
    assert told["from a thread"] == ("flows.teller", by_stage["walk"])


def test_nothing_is_sent_where_nobody_looks(engine, store, source, loggers):
    _, artifacts, tasks, lines, _ = execute(store, source, watched=False)
    assert len(tasks) == 3 and artifacts == {} and lines == []


def test_server_that_takes_no_pages_costs_the_pages_only(
    engine, store, source, loggers, monkeypatch
):
    from flows.showing import SyncPrefectClient

    def refuse(*_):
        raise ConnectionError("away")

    monkeypatch.setattr(SyncPrefectClient, "create_artifact", refuse)
    run, artifacts, tasks, _, error = execute(store, source)
    assert error is None and run.state_name == "Completed"
    assert artifacts == {} and len(tasks) == 3
