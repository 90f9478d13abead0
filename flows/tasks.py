"""A stage of a plan as a Prefect task: run name, tags, retries by kind of fault, cached state.

Tasks are thin. They return a reference to the store, Prefect keeps no result, and there is one
cache only: the store.
"""

import errno
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, cast

import torch
from prefect import Task, task
from prefect.cache_policies import NO_CACHE
from prefect.client.schemas.objects import State, TaskRun
from prefect.states import Completed

from flows.pipeline import SOURCE
from flows.plan import Plan, Step, Verdict
from stages.base import Progress
from stages.errors import TransientError
from stages.execution import run_stage
from stages.store import Store, Stored

RETRY_DELAYS_S = (1.0, 5.0)  # a moment for memory to be freed, then for a mount to come back
# What a file system says when it is away for a while, as against a path that is wrong.
PASSING_FAULTS = frozenset(
    {errno.EIO, errno.EAGAIN, errno.EBUSY, errno.ESTALE, errno.ETIMEDOUT, errno.ENOMEM}
)


class Observer(Protocol):
    """Who watches a run."""

    def started(self, step: Step) -> None:
        """A stage begins to compute."""

    def progressed(self, progress: Progress) -> None:
        """A stage has done some of its steps."""

    def failed(self, step: Step, error: BaseException) -> None:
        """A stage failed; it may be tried again."""

    def finished(self, step: Step, stored: Stored) -> None:
        """A stage's artifact is in the store."""


@dataclass(frozen=True)
class Bench:
    """Where and how the stages of a plan are run.

    Attributes:
        plan: what to do.
        store: where artifacts are.
        device: where to compute.
        observer: who watches.
    """

    plan: Plan
    store: Store
    device: torch.device
    observer: Observer


def is_transient(error: BaseException) -> bool:
    """Whether the same attempt may succeed later: memory or a file system that was away."""
    if isinstance(error, OSError):
        return error.errno in PASSING_FAULTS
    return isinstance(error, TransientError | MemoryError | torch.OutOfMemoryError)


def _should_retry(_: Task[..., Any], __: TaskRun, state: State[Any]) -> bool:
    try:
        state.result()
    except Exception as error:
        return is_transient(error)
    return False


def _run_step(step: Step, upstream: Mapping[str, Stored], bench: Bench) -> Stored | State[Stored]:
    """The artifact of a step, from the store or from its stage."""
    if step.verdict is Verdict.CACHED and step.stored is not None:
        return _as_cached(step, step.stored, bench)
    if step.recipe is None:
        raise ValueError(f"{step.node.name} is skipped and has nothing to run")
    bench.observer.started(step)
    try:
        stored = run_stage(
            bench.store,
            step.recipe,
            step.node.load(),
            {
                name: bench.plan.source if name == SOURCE else upstream.get(name)
                for name in step.node.inputs
            },
            config=getattr(bench.plan.config, step.node.name),
            device=bench.device,
            force=step.stored is not None,
            on_progress=bench.observer.progressed,
        )
    except Exception as error:
        bench.observer.failed(step, error)
        raise
    if stored.is_cached:  # another process made it while this one waited for the lock
        return _as_cached(step, stored, bench)
    bench.observer.finished(step, stored)
    return stored


def _as_cached(step: Step, stored: Stored, bench: Bench) -> State[Stored]:
    bench.observer.finished(step, stored)
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
        task_run_name=f"{step.node.name}-{step.key8}",
        tags=[f"stage:{step.node.name}", f"device:{bench.device.type}"],
        retries=len(retry_delays_s),
        retry_delay_seconds=list(retry_delays_s),
    )
    # A task that returns a state is handed that state; its result is what the next step needs.
    state = stage_task(step, upstream, bench, return_state=True)
    return cast(Stored, state.result())
