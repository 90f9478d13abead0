"""The flow: a plan's steps in order, each a task, every artifact handed on by reference."""

import contextlib
import logging
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any, cast

from prefect import flow, runtime, tags
from prefect.client.orchestration import get_client
from prefect.client.schemas.filters import FlowRunFilter, FlowRunFilterId
from prefect.client.schemas.objects import State
from prefect.context import TagsContext
from prefect.events.worker import EventsWorker
from prefect.states import Failed

from flows.heartbeats import heartbeats_if_deployed
from flows.plan import Plan, Verdict
from flows.recording import Audience
from flows.run_records import RunRecord, in_a_line
from flows.showing import Showcase, is_watched
from flows.steps import RETRY_DELAYS_S, Bench, obtain_steps
from flows.tasks import run_step
from stages.store import Stored

log = logging.getLogger(__name__)

RECORD_TIMEOUT_S = 3.0  # the server writes what tasks did a moment after they did it
RECORD_POLL_S = 0.05


def run_plan(
    bench: Bench,
    record: RunRecord | None = None,
    *,
    retry_delays_s: Sequence[float] = RETRY_DELAYS_S,
) -> dict[str, Stored]:
    """Run what a plan asks for, under Prefect.

    Args:
        bench: the plan, and where to run it.
        record: the run's page in the store: names the flow run, and is named by what it shows.
        retry_delays_s: pauses before each further try after a passing fault.

    Returns:
        The artifact of every stage that was asked for and not skipped.
    """
    plan = bench.plan
    faults: list[Exception] = []

    @flow(
        name=plan.pipeline.name,
        flow_run_name=_name(plan, record),
        persist_result=False,
        validate_parameters=False,
    )
    def run_steps(source: str, keys: dict[str, str]) -> dict[str, Stored] | State[Any]:
        artifacts: dict[str, Stored] = {}
        tried = 0
        try:
            # The flow's tags are not for its tasks: for each that has one Prefect asks its server
            # for a slot, which takes longer than all the rest of a task.
            with _shown(bench, record) as watched, TagsContext(current_tags=set()):
                for step in plan.steps:
                    if step.verdict in (Verdict.CACHED, Verdict.COMPUTE):
                        tried += 1
                        made = run_step(step, artifacts, watched, retry_delays_s)
                        artifacts[step.node.name] = made
        except Exception as fault:
            # Raised, it would be written to Prefect's home, for nobody; and where the store has
            # gone, that would be in the way of its return.
            faults.append(fault)
            return Failed(message=in_a_line(fault))
        finally:
            if runtime.flow_run.parent_flow_run_id is None:  # others' server goes on
                _await_records(tried)
        return artifacts

    keys = {step.node.name: step.recipe.key for step in plan.steps if step.recipe}
    with heartbeats_if_deployed(), tags(*_tags(plan, record)):
        try:
            state = run_steps(source=str(plan.source), keys=keys, return_state=True)
        except Exception as error:  # of the engine, which does not raise what stages fail of
            log.warning("the engine failed (%s); going on without it", error)
            if not faults:
                return obtain_steps(bench, retry_delays_s)
        if faults:
            raise faults[0] from faults[0].__cause__
        return cast(dict[str, Stored], state.result())


def _name(plan: Plan, record: RunRecord | None) -> str:
    """What tells a run from others in a list: asset, preset, seed."""
    preset = record.preset if record else ""
    return " · ".join(part for part in (plan.source.stem, preset, f"seed {plan.seed}") if part)


def _tags(plan: Plan, record: RunRecord | None) -> list[str]:
    """What runs are searched by."""
    of_record = {"preset": record.preset, "run": record.id} if record else {}
    named = {"asset": plan.source.stem, **of_record}
    return [f"{name}:{value}" for name, value in named.items() if value]


@contextlib.contextmanager
def _shown(bench: Bench, record: RunRecord | None) -> Iterator[Bench]:
    """The bench with one more who watches, where there is somebody to show things to."""
    if not is_watched():
        yield bench
        return
    with Showcase(bench.plan, record) as showcase, showcase.logging_shown():
        yield replace(bench, observer=Audience(bench.observer, showcase))


def _await_records(expected: int) -> None:
    """Wait until the server has written the final state of all tasks; it is about to be stopped."""
    EventsWorker.instance().wait_until_empty()
    run = FlowRunFilter(id=FlowRunFilterId(any_=[runtime.flow_run.id]))
    deadline = time.monotonic() + RECORD_TIMEOUT_S
    with get_client(sync_client=True) as client:
        while time.monotonic() < deadline:
            runs = client.read_task_runs(flow_run_filter=run)
            if sum(r.state is not None and r.state.is_final() for r in runs) >= expected:
                return
            time.sleep(RECORD_POLL_S)
