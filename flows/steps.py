"""One step of a plan, computed or found; whoever runs it, an engine or a command."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import torch

from flows.pipeline import SOURCE
from flows.plan import Plan, Step, Verdict
from flows.stopping import is_stop_wanted
from stages.base import Progress
from stages.execution import run_stage
from stages.faults import kind_of
from stages.store import Store, Stored

# A moment for memory to be freed, then growing ones for a mount to come back.
RETRY_DELAYS_S = (1.0, 4.0, 16.0)


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
        limits_s: seconds after which a stage is stopped, by its name; others have no limit.
    """

    plan: Plan
    store: Store
    device: torch.device
    observer: Observer
    limits_s: Mapping[str, float] = field(default_factory=dict)


def obtain_step(step: Step, upstream: Mapping[str, Stored], bench: Bench) -> Stored:
    """The artifact of a step, from the store or from its stage."""
    stored = step.stored
    if step.verdict is not Verdict.CACHED or stored is None:
        stored = _compute(step, upstream, bench)
    bench.observer.finished(step, stored)
    return stored


def obtain_step_patiently(
    step: Step,
    upstream: Mapping[str, Stored],
    bench: Bench,
    retry_delays_s: Sequence[float] = RETRY_DELAYS_S,
) -> Stored:
    """`obtain_step`, tried again after passing faults, as tasks of an engine are."""
    for delay_s in retry_delays_s:
        try:
            return obtain_step(step, upstream, bench)
        except Exception as error:
            if not kind_of(error).is_passing:
                raise
        time.sleep(delay_s)
    return obtain_step(step, upstream, bench)


def obtain_steps(
    bench: Bench, retry_delays_s: Sequence[float] = RETRY_DELAYS_S
) -> dict[str, Stored]:
    """The artifacts of a plan's steps, one after the other, without an engine."""
    artifacts: dict[str, Stored] = {}
    for step in bench.plan.steps:
        if step.verdict in (Verdict.CACHED, Verdict.COMPUTE):
            name = step.node.name
            artifacts[name] = obtain_step_patiently(step, artifacts, bench, retry_delays_s)
    return artifacts


def _compute(step: Step, upstream: Mapping[str, Stored], bench: Bench) -> Stored:
    if step.recipe is None:
        raise ValueError(f"{step.node.name} is skipped and has nothing to run")
    bench.observer.started(step)
    try:
        return run_stage(
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
            limit_s=bench.limits_s.get(step.node.name),
            on_progress=bench.observer.progressed,
        )
    except Exception as error:
        if is_stop_wanted():
            raise KeyboardInterrupt from error
        bench.observer.failed(step, error)
        raise
