"""What the process of a case does about its request: a run of the pipeline, and how it ended."""

import json
import sys
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

from flows.cases import Outcome
from flows.config import RunConfig
from flows.pipeline import IMAGE_TO_ASSET
from flows.plan import Plan, Selection, Step, make_plan
from flows.steps import Bench, obtain_steps
from stages.base import Progress
from stages.errors import DivergenceError, InputError, StageTimeoutError, TransientError
from stages.execution import choose_device
from stages.store import Store, Stored

# These say what was wanted and what to do.
CLEAR = (InputError, DivergenceError, TransientError, StageTimeoutError)

Request = dict[str, Any]


class Listener:
    """Watches a run: remembers which stage failed."""

    def __init__(self) -> None:
        self.stage = ""

    def started(self, step: Step) -> None:
        """Nothing to tell."""

    def progressed(self, progress: Progress) -> None:
        """Nothing to tell."""

    def failed(self, step: Step, error: BaseException) -> None:
        """Remember where."""
        self.stage = step.node.name

    def finished(self, step: Step, stored: Stored) -> None:
        """Nothing to tell."""


def carry_out(
    request: Request, measure: Callable[[Request, Listener], dict[str, Any]]
) -> dict[str, Any]:
    """What `measure` finds, or why there is nothing; whatever happens is a result."""
    start = time.process_time()
    listener = Listener()
    try:
        result = measure(request, listener)
    except CLEAR as error:
        message = f"{type(error).__name__}: {error}"
        result = {"outcome": Outcome.REFUSED, "error": message, "stage": listener.stage}
    except Exception:
        last = traceback.format_exc(limit=-4)
        result = {"outcome": Outcome.CRASHED, "error": last, "stage": listener.stage}
    return {"cpu_s": round(time.process_time() - start, 1)} | result


def plan_asset(
    config: RunConfig, source: Path, *, seed: int, store: Store, until: str | None = None
) -> Plan:
    """What a run up to a stage has to compute."""
    selection = Selection(until=until)
    return make_plan(
        IMAGE_TO_ASSET,
        config,
        source=source,
        seed=seed,
        store=store,
        selection=selection,
        explained=False,
    )


def obtain_asset(plan: Plan, store: Store, listener: Listener) -> dict[str, Stored]:
    """Artifacts of all stages of a plan, computed on the CPU where the store has none."""
    return obtain_steps(Bench(plan, store, choose_device("cpu"), listener), retry_delays_s=())


def events_of(artifacts: dict[str, Stored]) -> list[list[str]]:
    """Stage, kind and message of all events."""
    return [
        [name, str(event["kind"]), str(event["message"])]
        for name, stored in artifacts.items()
        for event in stored.manifest.record.get("events", ())
    ]


def answer(measure: Callable[[Request, Listener], dict[str, Any]]) -> None:
    """Carry out the request in the file that the command line names."""
    request = json.loads(Path(sys.argv[1]).read_text())
    Path(request["out"]).write_text(json.dumps(carry_out(request, measure)))
