"""The flow: a plan's steps in order, each a task, every artifact handed on by reference."""

import time
from collections.abc import Sequence

from prefect import flow, runtime
from prefect.client.orchestration import get_client
from prefect.client.schemas.filters import FlowRunFilter, FlowRunFilterId
from prefect.events.worker import EventsWorker

from flows.heartbeats import heartbeats_if_deployed
from flows.plan import Verdict
from flows.steps import RETRY_DELAYS_S, Bench
from flows.tasks import run_step
from stages.store import Stored

RECORD_TIMEOUT_S = 3.0  # the server writes what tasks did a moment after they did it
RECORD_POLL_S = 0.05


def run_plan(
    bench: Bench, *, retry_delays_s: Sequence[float] = RETRY_DELAYS_S
) -> dict[str, Stored]:
    """Run what a plan asks for, under Prefect.

    Args:
        bench: the plan, and where to run it.
        retry_delays_s: pauses before each further try after a passing fault.

    Returns:
        The artifact of every stage that was asked for and not skipped.
    """
    plan = bench.plan

    @flow(
        name=plan.pipeline.name,
        flow_run_name=f"{plan.source.stem}-seed{plan.seed}",
        persist_result=False,
        validate_parameters=False,
    )
    def run_steps(source: str, keys: dict[str, str]) -> dict[str, Stored]:
        artifacts: dict[str, Stored] = {}
        tried = 0
        try:
            for step in plan.steps:
                if step.verdict in (Verdict.CACHED, Verdict.COMPUTE):
                    tried += 1
                    artifacts[step.node.name] = run_step(step, artifacts, bench, retry_delays_s)
        finally:
            if runtime.flow_run.parent_flow_run_id is None:  # others' server goes on
                _await_records(tried)
        return artifacts

    keys = {step.node.name: step.recipe.key for step in plan.steps if step.recipe}
    with heartbeats_if_deployed():
        return run_steps(source=str(plan.source), keys=keys)


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
