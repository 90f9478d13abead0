"""A plan carried out for a person: computed, laid out in a run folder, told about on a console."""

import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console

from flows.console import RunDisplay, result_table, stage_warnings_on
from flows.engine import Engine
from flows.pipeline import REPORT
from flows.plan import Plan, Verdict
from flows.recording import Audience, RunRecorder
from flows.run_folder import require_ours, write_run_folder
from flows.run_records import RunRecord
from flows.stopping import interrupt_on_stop
from stages.shared_store import open_store
from stages.store import Stored

if TYPE_CHECKING:
    from flows.steps import Observer

DONE = 0

Compute = Callable[[Plan, "Job"], tuple[dict[str, Stored], dict[str, Any]]]


class Job:
    """Where a plan is carried out, and who is told.

    Attributes:
        store: where artifacts are kept.
        out: the run folder.
        device: "auto", "cpu" or "cuda".
        console: where progress and results are told.
        limits_s: seconds after which a stage is stopped, by its name.

    Args:
        command: arguments of `svim3d` that do the same again, for `svim3d resume`.
        share: URL of a store that other machines use too.
    """

    def __init__(
        self,
        store: Path,
        out: Path,
        device: str,
        console: Console,
        command: Sequence[str] = (),
        share: str | None = None,
    ) -> None:
        self._start = time.monotonic()
        self._command = command
        self._recorder: RunRecorder | None = None
        self.out = out
        self.device = device
        self.console = console
        self.limits_s: Mapping[str, float] = {}
        self.store = open_store(store, share, say=self._say)

    def _say(self, text: str) -> None:
        self.console.print(text, style="yellow", highlight=False, markup=False)
        if self._recorder is not None:
            self._recorder.say(text)

    @property
    def record(self) -> RunRecord | None:
        """The run's page, while the plan is carried out."""
        return self._recorder.record if self._recorder else None

    def watched_by(self, display: "Observer") -> "Observer":
        """Who is told of the stages: a display, and the run's record."""
        return Audience(display, self._recorder) if self._recorder else display

    def carry_out(self, plan: Plan, about: Mapping[str, Any], *, compute: Compute) -> int:
        """Compute what is missing, write the run folder, print the table of all stages.

        Args:
            plan: what to do.
            about: what the caller adds to `run.json`.
            compute: what runs the steps; returns the artifacts and what it adds to `run.json`.
        """
        require_ours(self.out, plan.pipeline)
        interrupt_on_stop()
        self._recorder = RunRecorder(
            self.store,
            plan,
            self.out,
            preset=str(about.get("preset", "")),
            command=self._command,
        )
        try:
            with self._recorder:
                return self._carry_out(plan, about, compute)
        finally:
            if plan.pipeline.has_report and (self.out / REPORT).is_file():
                self.console.print(f"{self.out / REPORT}", highlight=False, soft_wrap=True)

    def _carry_out(self, plan: Plan, about: Mapping[str, Any], compute: Compute) -> int:
        if plan.to_compute:
            artifacts, told = compute(plan, self)
        else:
            artifacts = {step.node.name: step.stored for step in plan.steps if step.stored}
            told = {}
        computed_s = sum(
            stored.manifest.record["seconds"]
            for stored in artifacts.values()
            if not stored.is_cached
        )
        total_s = time.monotonic() - self._start
        seconds = {"stages_s": round(computed_s, 2), "total_s": round(total_s, 2)}
        page = {**about, "device": self.device, **told, **seconds}
        write_run_folder(self.out, plan, artifacts, self.store, page)
        self.console.print(result_table(plan, artifacts))
        waited_s = told.get("engine_startup_s")
        engine = f", {waited_s:.1f} s waiting for the engine" if waited_s is not None else ""
        self.console.print(
            f"{self.out}: {total_s:.1f} s in all, {computed_s:.1f} s in stages{engine}",
            highlight=False,
        )
        return DONE


def compute_under_engine(plan: Plan, job: Job) -> tuple[dict[str, Stored], dict[str, Any]]:
    """Run the plan under Prefect; tells the seconds spent on the engine's start."""
    forced = [s.node.name for s in plan.to_compute if s.stored is not None]
    kept = [s.node.name for s in plan.steps if s.verdict is Verdict.CACHED]
    if forced and kept:
        job.console.print(
            f"computing {', '.join(forced)} again; keys name recipes, so later stages that nothing "
            f"else changed keep their artifacts (--from {forced[0]} recomputes them too)",
            highlight=False,
        )
    with Engine(job.store.root / "prefect") as engine:
        # All of this takes seconds to import, and does so while the server starts.
        from flows.image_to_asset import run_plan
        from flows.steps import Bench
        from stages.execution import choose_device

        device = choose_device(job.device)
        for step in plan.to_compute:
            step.node.load()
        engine.wait()
        with stage_warnings_on(job.console), RunDisplay(job.console) as display:
            bench = Bench(plan, job.store, device, job.watched_by(display), job.limits_s)
            artifacts = run_plan(bench, job.record)
        return artifacts, {"engine_startup_s": round(engine.waited_s, 2)}


def compute_here(plan: Plan, job: Job) -> tuple[dict[str, Stored], dict[str, Any]]:
    """Run the plan's steps one after the other in this process, without an engine."""
    from flows.steps import Bench, obtain_steps
    from stages.execution import choose_device

    with stage_warnings_on(job.console), RunDisplay(job.console) as display:
        device, observer = choose_device(job.device), job.watched_by(display)
        return obtain_steps(Bench(plan, job.store, device, observer, job.limits_s)), {}
