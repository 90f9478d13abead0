"""One input of a batch, carried out by whoever is given it: this process, a worker, a cluster."""

import functools
import json
import logging
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from flows.config import RunConfig, load_config, resolved_preset
from flows.pipeline import Pipeline
from flows.plan import Plan, Selection, Step, make_plan
from flows.recording import Audience, RunRecorder
from flows.run_folder import RUN_PAGE, require_ours, write_run_folder
from stages.keys import code_digests
from stages.store import Store, Stored

if TYPE_CHECKING:
    from stages.base import Progress

log = logging.getLogger("stages")  # where stages and store warn

# Both read files that do not change while a batch runs, the same ones for all inputs: a plan takes
# 9 ms of CPU instead of 260.
_code = functools.cache(code_digests)
_config = functools.cache(load_config)


@dataclass(frozen=True)
class BatchJob:
    """What to do about one input; plain values, so that it can go to another process.

    Attributes:
        name: of the input.
        pipeline: stages and products.
        schema: of the settings.
        source: where the input lies.
        out: run folder.
        preset: before overrides.
        overrides: as given to `--set`.
        skip: stages to leave out.
        seed: of the run.
        device: "auto", "cpu" or "cuda".
        store: folder of the artifacts.
        limits_s: seconds that stages may take, by name.
        share: URL of a store that machines share.
        lost_workers: processes that died over this input before.
    """

    name: str
    pipeline: Pipeline
    schema: type[RunConfig]
    source: Path
    out: Path
    preset: str
    overrides: tuple[str, ...]
    skip: frozenset[str]
    seed: int
    device: str
    store: Path
    limits_s: Mapping[str, float] = field(default_factory=dict)
    share: str | None = None
    lost_workers: int = 0

    @property
    def command(self) -> tuple[str, ...]:
        """Arguments of `svim3d` that make this one input alone."""
        return (
            *("run", str(self.source.resolve()), "-o", str(self.out.resolve())),
            *(
                "--preset",
                resolved_preset(self.preset),
                "--seed",
                str(self.seed),
                "--device",
                self.device,
            ),
            *(f"--set={override}" for override in self.overrides),
            *(f"--skip={stage}" for stage in sorted(self.skip)),
            *(f"--timeout={stage}={limit}" for stage, limit in self.limits_s.items()),
            *((f"--share={self.share}",) if self.share else ()),
            *("--store", str(self.store.resolve())),
        )

    def plan(self, store: Store) -> Plan:
        """Resolve settings and look every stage up in the store."""
        return make_plan(
            self.pipeline,
            _config(self.schema, self.preset, self.overrides, self.skip),
            source=self.source,
            seed=self.seed,
            store=store,
            selection=Selection(skip=self.skip),
            code=_code,
            explained=False,
        )

    def is_laid_out(self, plan: Plan) -> bool:
        """Whether the run folder shows what the plan asks for."""
        try:
            stages = json.loads((self.out / RUN_PAGE).read_text())["stages"]
            shown = {name: stage["key"] for name, stage in stages.items()}
        except (OSError, ValueError, KeyError, TypeError, AttributeError):
            return False
        wanted = {s.node.name: s.recipe.key if s.recipe else None for s in plan.steps}
        has_product = any((self.out / product.name).exists() for product in plan.pipeline.results)
        return shown == wanted and has_product

    def finish(self, plan: Plan, artifacts: Mapping[str, Stored], store: Store) -> None:
        """Lay the results out in the run folder."""
        about: dict[str, Any] = {"preset": self.preset, "device": self.device}
        if self.lost_workers:
            about["lost_workers"] = self.lost_workers
        write_run_folder(self.out, plan, artifacts, store, about)


class JobError(Exception):
    """An input failed.

    Attributes:
        stage: that failed, empty where the fault lay elsewhere.
        message: the fault in a line.
        seconds: until then.
    """

    def __init__(self, stage: str, message: str, seconds: float) -> None:
        super().__init__(stage, message, seconds)  # so that it can go to another process
        self.seconds = seconds
        self.stage = stage
        self.message = message


def first_line(error: BaseException) -> str:
    """A fault in a line."""
    kind = type(error).__name__
    line = str(error).strip().partition("\n")[0]
    # Our own errors say all in words; of others the kind is half of what there is to know.
    is_ours = type(error).__module__.startswith(("stages.", "flows."))
    return line if is_ours and line else f"{kind}: {line}" if line else kind


def do_job(job: BatchJob) -> float:
    """Compute an input and lay it out; returns the seconds that took.

    Raises:
        JobError: with the stage that failed.
    """
    start = time.monotonic()
    watch = _Watch()
    try:
        # Prefect and torch, which the one who hands jobs out may do without.
        from flows.image_to_asset import run_plan
        from flows.steps import Bench
        from stages.execution import choose_device
        from stages.shared_store import open_store

        store = open_store(job.store, job.share, say=log.warning)
        plan = job.plan(store)
        require_ours(job.out, plan.pipeline)
        with RunRecorder(store, plan, job.out, preset=job.preset, command=job.command) as recorder:
            observer = Audience(watch, recorder)
            bench = Bench(plan, store, choose_device(job.device), observer, job.limits_s)
            job.finish(plan, run_plan(bench, recorder.record), store)
    except Exception as error:
        seconds = time.monotonic() - start
        # The cause stays here: it may hold what cannot go to another process.
        raise JobError(watch.stage, first_line(error), seconds) from None
    return time.monotonic() - start


class _Watch:
    """Knows which stage is at work."""

    def __init__(self) -> None:
        self.stage = ""

    def started(self, step: Step) -> None:
        self.stage = step.node.name

    def progressed(self, progress: "Progress") -> None:
        pass

    def failed(self, step: Step, error: BaseException) -> None:
        pass

    def finished(self, step: Step, stored: Stored) -> None:
        self.stage = ""
