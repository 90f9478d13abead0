"""What a person sees of a run: progress with time left, warnings, and the closing table."""

import contextlib
import logging
from collections.abc import Iterator, Mapping
from types import TracebackType
from typing import TYPE_CHECKING, Self

from rich.console import Console
from rich.markup import escape
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Table

from flows.plan import Plan, Step, Verdict, state_of
from stages.store import Stored

if TYPE_CHECKING:  # a plan is shown without torch
    from stages.base import Progress as StageProgress

STATE_STYLES = {"computed": "green", "cached": "cyan", "skipped": "dim", "not asked for": "dim"}


class RunDisplay:
    """Watches a run on a console: bars where it is a terminal, lines where it is a file."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._bars = Progress(
            TextColumn("{task.description:>12}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TextColumn("left"),
            TimeRemainingColumn(),
            TextColumn("{task.fields[note]}", style="dim"),
            console=console,
            disable=not console.is_terminal,
        )
        self._bar_of: dict[str, TaskID] = {}

    def __enter__(self) -> Self:
        self._bars.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._bars.stop()

    def started(self, step: Step) -> None:
        """Show that a stage computes."""
        name = step.node.name
        if name in self._bar_of:  # tried again
            self._bars.reset(self._bar_of[name])
            return
        self._bar_of[name] = self._bars.add_task(name, total=None, note=escape(step.reason))
        if not self._console.is_terminal:
            self._tell(f"{name}: computing ({step.reason})")

    def progressed(self, progress: "StageProgress") -> None:
        """Move a stage's bar."""
        self._bars.update(
            self._bar_of[progress.stage],
            completed=progress.step,
            total=progress.total,
            note=", ".join(f"{name} {value:.4g}" for name, value in progress.terms.items()),
        )

    def failed(self, step: Step, error: BaseException) -> None:
        """Name a fault; the engine decides whether the stage is tried again."""
        self._tell(f"{step.node.name}: {type(error).__name__}: {error}", style="yellow")

    def finished(self, step: Step, stored: Stored) -> None:
        """Fill a stage's bar."""
        headline = stored.manifest.record["headline"]
        if step.node.name in self._bar_of:
            bar = self._bar_of[step.node.name]
            self._bars.update(bar, completed=1, total=1, note=escape(headline))
        if not self._console.is_terminal:
            how = "cached" if stored.is_cached else f"{stored.manifest.record['seconds']:.1f} s"
            self._tell(f"{step.node.name}: {how}, {headline}")

    def _tell(self, text: str, style: str | None = None) -> None:
        """Print a line as it is: brackets in messages are no markup."""
        self._console.print(text, style=style, highlight=False, markup=False)


class _ConsoleHandler(logging.Handler):
    def __init__(self, console: Console) -> None:
        super().__init__(logging.WARNING)
        self._console = console

    def emit(self, record: logging.LogRecord) -> None:
        self._console.print(self.format(record), style="yellow", highlight=False, markup=False)


@contextlib.contextmanager
def stage_warnings_on(console: Console) -> Iterator[None]:
    """Print what stages warn of above the bars, and nowhere else."""
    logger = logging.getLogger("stages")
    handler = _ConsoleHandler(console)
    logger.addHandler(handler)
    logger.propagate = False
    try:
        yield
    finally:
        logger.removeHandler(handler)
        logger.propagate = True


def plan_table(plan: Plan) -> Table:
    """What a run would do, and why."""
    table = Table("stage", "key", "verdict", "why", box=None, pad_edge=False)
    for step in plan.steps:
        verdict = "hit" if step.verdict is Verdict.CACHED else str(step.verdict)
        verdict = "miss" if step.verdict is Verdict.COMPUTE and step.stored is None else verdict
        table.add_row(step.node.name, step.key8, verdict, escape(step.reason))
    return table


def result_table(plan: Plan, artifacts: Mapping[str, Stored]) -> Table:
    """What a run did: the seconds are those that the artifact took when it was computed."""
    table = Table(box=None, pad_edge=False)
    for column in ("stage", "state"):
        table.add_column(column)
    for column in ("seconds", "MiB"):
        table.add_column(column, justify="right")
    for column in ("key", "result"):
        table.add_column(column)
    for step in plan.steps:
        stored = artifacts.get(step.node.name)
        state = state_of(step, stored)
        record = stored.manifest.record if stored else None
        table.add_row(
            step.node.name,
            f"[{STATE_STYLES[state]}]{state}",
            f"{record['seconds']:.1f}" if record else "",
            f"{record['peak_memory_mib']['host']:.0f}" if record else "",
            step.key8,
            escape(record["headline"]) if record else "",
        )
        for event in record["events"] if record else ():
            table.add_row("", "", "", "", "", f"[yellow]{escape(event['message'])}")
    return table
