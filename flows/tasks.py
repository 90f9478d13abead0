"""A stage of a plan as a Prefect task: run name, retries by kind of fault, cached state.

Tasks are thin. They return a reference to the store, Prefect keeps no result, and there is one
cache only: the store. Prefect's records are a view: where they cannot be written, work goes on.
"""

import logging
from collections.abc import Mapping, Sequence
from typing import Any, cast

from prefect import Task, task
from prefect.cache_policies import NO_CACHE
from prefect.client.schemas.objects import State, TaskRun
from prefect.states import Completed

from flows.plan import Step
from flows.steps import Bench, obtain_step, obtain_step_patiently
from stages.faults import kind_of
from stages.store import Stored

log = logging.getLogger(__name__)


def _should_retry(_: Task[..., Any], __: TaskRun, state: State[Any]) -> bool:
    try:
        state.result()
    except Exception as error:
        return kind_of(error).is_passing
    return False


def _run_step(step: Step, upstream: Mapping[str, Stored], bench: Bench) -> Stored | State[Stored]:
    """The artifact of a step; one that was there, or that another process made, shows as cached."""
    stored = obtain_step(step, upstream, bench)
    if not stored.is_cached:
        return stored
    return Completed(name="Cached", message=f"{stored.key[:8]} is in the store", data=stored)


STAGE_TASK = task(_run_step).with_options(
    retry_condition_fn=_should_retry, cache_policy=NO_CACHE, persist_result=False
)


def run_step(
    step: Step, upstream: Mapping[str, Stored], bench: Bench, retry_delays_s: Sequence[float]
) -> Stored:
    """Run one step of a plan as a Prefect task."""
    stage_task = STAGE_TASK.with_options(
        name=step.node.name,
        task_run_name=f"{step.node.name}-{bench.plan.source.stem}-{step.key8}",
        retries=len(retry_delays_s),
        retry_delay_seconds=list(retry_delays_s),
    )
    try:
        # A task that returns a state is handed that state, and so is one that failed.
        state = stage_task(step, upstream, bench, return_state=True)
    except Exception as error:  # of the engine, then: its server may be overrun, its disk full
        log.warning("%s: the engine failed (%s); going on without it", step.node.name, error)
        return obtain_step_patiently(step, upstream, bench, retry_delays_s)
    return cast(Stored, state.result())
