"""`svim3d batch`: many inputs, each a run of its own; what is there already is not done again."""

import argparse
import contextlib
import importlib.util
import os
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

from rich.console import Console

from flows.batch_inputs import Entry, read_entries
from flows.batch_job import BatchJob, JobError, first_line
from flows.batch_results import DONE, Results, Row, State
from flows.config import PipelineConfig, load_config
from flows.engine import Engine
from flows.hooks import Hooks, announce_death
from flows.limits import parse_limits
from flows.options import photo_settings
from flows.pipeline import IMAGE_TO_ASSET
from flows.plan import Selection
from flows.run_folder import require_ours
from flows.run_records import RunIndex
from flows.stopping import interrupt_on_stop
from flows.workers import WorkerLostError, Workers
from stages.errors import InputError
from stages.store import Store

LOCAL = "local"  # the runner that needs no package
ALL_DONE, SOME_FAILED = 0, 1


def batch(options: argparse.Namespace) -> int:
    """Carry out what the command line names; see `svim3d batch --help`."""
    interrupt_on_stop()
    return carry_out(options, Engine(options.store / "prefect"))


def carry_out(options: argparse.Namespace, engine: Engine | None = None) -> int:
    """Make what options of `svim3d batch` name; gives the exit code.

    Args:
        options: as `batch_options` reads them, and the store.
        engine: that has to be started; None inside a flow, which has one.

    Raises:
        InputError: what is wrong for all inputs.
    """
    if options.jobs < 1:
        raise InputError(f"--jobs {options.jobs}: wanted at least one")
    if options.address and options.runner == LOCAL:
        raise InputError("--address names a cluster; say --runner dask or ray with it")
    _require_runner(options.runner)
    entries = read_entries(options.input, IMAGE_TO_ASSET.takes)
    # What is wrong for all is refused before any.
    overrides = (*photo_settings(options), *options.set)
    load_config(PipelineConfig, options.preset, overrides, options.skip)
    Selection(skip=frozenset(options.skip)).check(IMAGE_TO_ASSET)
    Hooks.of_environment()
    limits_s = parse_limits(options.timeout, IMAGE_TO_ASSET.names)
    jobs = [_job(entry, options, overrides, limits_s) for entry in entries]
    run = _Run(Store(options.store), options.output, entries)
    try:
        groups = run.look_up(jobs)
        if groups:
            _compute(groups, run, options, engine)
    except BaseException:
        run.results.cancel()
        raise
    finally:
        run.results.write()
        run.summarise()
    return SOME_FAILED if run.results.count(State.FAILED) else ALL_DONE


def _require_runner(name: str) -> None:
    if name != LOCAL and importlib.util.find_spec(f"prefect_{name}") is None:
        raise InputError(f"--runner {name} needs a package more: pip install 'svim3d[{name}]'")


def _job(
    entry: Entry,
    options: argparse.Namespace,
    overrides: Sequence[str],
    limits_s: Mapping[str, float],
) -> BatchJob:
    """An entry with all that it leaves to the command line."""
    return BatchJob(
        name=entry.name,
        pipeline=IMAGE_TO_ASSET,
        schema=PipelineConfig,
        source=entry.path,
        out=options.output / entry.name,
        preset=entry.preset or options.preset,
        overrides=(*overrides, *entry.overrides),
        skip=entry.skip.union(options.skip),
        seed=options.seed if entry.seed is None else entry.seed,
        device=options.device,
        store=options.store,
        limits_s=limits_s,
        share=options.share,
    )


class _Run:
    """A batch as it goes: results, and a console that is told."""

    def __init__(self, store: Store, out: Path, entries: Sequence[Entry]) -> None:
        self.store = store
        self.results = Results(out, [Row(entry.name, entry.source) for entry in entries])
        self._sources = {entry.name: entry.source for entry in entries}
        self._console = Console()
        self._start = time.monotonic()

    def look_up(self, jobs: Sequence[BatchJob]) -> list[list[BatchJob]]:
        """Settle what needs no computing; the rest, with those together that make the same."""
        groups: dict[tuple[str, ...], list[BatchJob]] = {}
        for job in jobs:
            start = time.monotonic()
            try:
                plan = job.plan(self.store)
                require_ours(job.out, plan.pipeline)
                if not plan.to_compute:
                    if not job.is_laid_out(plan):
                        artifacts = {s.node.name: s.stored for s in plan.steps if s.stored}
                        job.finish(plan, artifacts, self.store)
                    self._done(job, State.CACHED, time.monotonic() - start)
                    continue
            except Exception as error:
                self.failed(job, error)
                continue
            keys = tuple(step.recipe.key for step in plan.steps if step.recipe)
            groups.setdefault(keys, []).append(job)
        return list(groups.values())

    def settle(self, group: Sequence[BatchJob], outcome: float | BaseException) -> None:
        """Note what the computation of a group came to."""
        if isinstance(outcome, BaseException):
            for job in group:
                self.failed(job, outcome)
            return
        self._done(group[0], State.COMPUTED, outcome)
        if len(group) > 1:
            self.look_up(group[1:])

    def failed(self, job: BatchJob, error: BaseException) -> None:
        """Note a failure and go on."""
        if isinstance(error, WorkerLostError):
            announce_death(RunIndex(self.store.root), job.out, first_line(error))
        if not isinstance(error, JobError):
            error = JobError("", first_line(error), 0.0)
        told = (round(error.seconds, 3), error.stage, error.message)
        self._tell(Row(job.name, self._sources[job.name], State.FAILED, *told), style="red")

    def _done(self, job: BatchJob, state: State, seconds: float) -> None:
        products = (job.out / product.name for product in job.pipeline.results)
        asset = next((str(product) for product in products if product.exists()), "")
        source = self._sources[job.name]
        row = Row(job.name, source, state, round(seconds, 3), asset=asset)
        self._tell(row)

    def _tell(self, row: Row, style: str | None = None) -> None:
        self.results.put(row)
        settled = len(self.results) - self.results.count(State.WAITING)
        told = f"{row.stage}: {row.error}" if row.stage else row.error or f"{row.seconds:.1f} s"
        self._console.print(
            f"[{settled}/{len(self.results)}] {row.name}: {row.state}, {told}",
            style=style,
            highlight=False,
            markup=False,
            soft_wrap=True,
        )

    def summarise(self) -> None:
        """Say how many inputs came to what, and where to read more."""
        counts = [f"{count} {state}" for state in State if (count := self.results.count(state))]
        self._console.print(
            f"{self.results.file}: {', '.join(counts)} in {time.monotonic() - self._start:.1f} s; "
            f"{self.results.count(*DONE)} of {len(self.results)} are there",
            highlight=False,
            soft_wrap=True,
        )


def _compute(
    groups: list[list[BatchJob]], run: _Run, options: argparse.Namespace, engine: Engine | None
) -> None:
    """Compute the first of each group under the engine, and let the others find it."""
    group_of = {group[0].name: group for group in groups}
    at_once = min(options.jobs, len(groups))
    with engine or contextlib.nullcontext():
        from flows.batch_flow import Batch, make_runner, run_batch

        runner = make_runner(options.runner, at_once, options.address)
        threads = max(1, (os.cpu_count() or 1) // at_once) if at_once > 1 else None
        with Workers(at_once, threads) as workers:
            if engine is not None:
                engine.wait()
            run_batch(
                Batch(
                    [group[0] for group in groups],
                    lambda job, outcome: run.settle(group_of[job.name], outcome),
                    workers if options.runner == LOCAL else None,
                ),
                runner,
                name=options.output.name or "batch",
            )
