"""A run writes down what it does: its page among those of all runs, and its log."""

import contextlib
import logging
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from flows.hooks import Hooks
from flows.pace import Pace
from flows.plan import Plan, Step, Verdict
from flows.processes import Process
from flows.run_folder import LOG_COPY, RECORD_COPY, replace_file
from flows.run_records import (
    CACHED,
    CANCELLED,
    COMPUTED,
    COMPUTING,
    DONE,
    FAILED,
    RUNNING,
    WAITING,
    RunIndex,
    RunRecord,
    StageRecord,
    in_a_line,
    new_id,
)
from stages.errors import TransientError
from stages.locks import file_lock
from stages.store import Store, Stored
from stages.store_cleaning import LEASE

if TYPE_CHECKING:  # a run that computes nothing is recorded without torch
    from flows.steps import Observer
    from stages.base import Progress

log = logging.getLogger(__name__)

WRITE_EVERY_S = 2.0  # while a stage counts its steps
LOG_FORMAT = "%(asctime)s %(levelname)-7s %(stage)-10s %(message)s"
LOG_TIME = "%Y-%m-%dT%H:%M:%S%z"


class RunRecorder:
    """Keeps a run's page and log up to date for the length of a `with` block, then reports.

    The page names all keys before anything is computed, so that no cleaning takes them. Where the
    store cannot be written there is neither page nor log, and the run goes on.

    Args:
        store: where artifacts are, and pages.
        plan: what is carried out.
        folder: the run folder; gets copies of page and log.
        preset: of settings; empty where there are none.
        command: arguments that do the same again.

    Raises:
        InputError: who is to be told of the run's end cannot be.
    """

    def __init__(
        self, store: Store, plan: Plan, folder: Path, *, preset: str, command: Sequence[str]
    ) -> None:
        self._store = store
        self._index = RunIndex(store.root)
        self._plan = plan
        self._writing = threading.Lock()
        self._written_s = 0.0
        self._pace = Pace()
        self._hooks = Hooks.of_environment()
        self._logging = contextlib.ExitStack()
        now = time.time()
        self.record = RunRecord(
            id=new_id(folder.resolve().name),
            command=tuple(command),
            cwd=str(Path.cwd()),
            pipeline=plan.pipeline.name,
            source=str(plan.source.resolve()),
            preset=preset,
            folder=str(folder.resolve()),
            process=Process.this(),
            state=RUNNING,
            stages={step.node.name: _planned(step) for step in plan.steps},
            stage="",
            step=0,
            total=0,
            started=now,
            changed=now,
            ended=None,
            error="",
        )

    def __enter__(self) -> Self:
        """Begin page and log.

        Raises:
            TransientError: artifacts that the plan counts on were cleaned away meanwhile.
        """
        with contextlib.suppress(OSError):
            with file_lock(self._store.root / LEASE, shared=True, wait=True):
                self._index.write(self.record)
            self._copy_to_folder()
            self._logging.enter_context(
                _log_to(self._index.log(self.record.id), lambda: self.record.stage)
            )
        gone = [
            step.node.name
            for step in self._plan.steps
            if step.verdict is Verdict.CACHED and step.stored and not step.stored.folder.exists()
        ]
        if gone:
            error = TransientError(
                f"{', '.join(gone)} left the store since this run was planned; run it again"
            )
            self._end(error)
            raise error
        log.info("svim3d %s", " ".join(self.record.command))
        log.info("process %d on %s", self.record.process.pid, self.record.process.host)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Say how it ended."""
        self._end(error)

    def _end(self, error: BaseException | None) -> None:
        state, line = DONE, ""
        if error is not None and not isinstance(error, Exception):
            state = CANCELLED  # by the keyboard, the system, or whoever runs a deployment
            log.warning("cancelled")
        elif error is not None:
            state, line = FAILED, in_a_line(error)
            log.error(line, exc_info=error)
        self._change(state=state, error=line, ended=time.time())
        log.info("%s after %.1f s", state, self.record.duration_s)
        if self._plan.pipeline.has_report and state != CANCELLED:  # who stops a run waits for it
            from flows.report.writing import report_quietly

            report_quietly(self.record, self._store)
        try:
            self._hooks.announce(self.record)
        finally:
            self._logging.close()
            with contextlib.suppress(OSError):
                self._copy_to_folder()

    def _copy_to_folder(self) -> None:
        """Let the run folder tell of the run without the store."""
        folder = Path(self.record.folder)
        folder.mkdir(parents=True, exist_ok=True)
        replace_file(folder / RECORD_COPY, self.record.as_bytes())
        so_far = self._index.log(self.record.id)
        replace_file(folder / LOG_COPY, so_far.read_bytes() if so_far.exists() else b"")

    def say(self, text: str) -> None:
        """Log what the store tells an operator."""
        log.warning(text)

    def started(self, step: Step) -> None:
        """A stage begins to compute."""
        self._at_work(step, state=COMPUTING)
        log.info("computing %s (%s)", step.key8, step.reason)

    def progressed(self, progress: "Progress") -> None:
        """A stage has done some of its steps."""
        left_s = self._pace.left_s(progress)
        if time.monotonic() - self._written_s > WRITE_EVERY_S:
            due = None if left_s is None else time.time() + left_s
            self._change(step=progress.step, total=progress.total, due=due)

    def failed(self, step: Step, error: BaseException) -> None:
        """A stage failed; it may be tried again."""
        line = in_a_line(error)
        events = (*self.record.stages[step.node.name].events, line)
        self._change(**self._stage(step.node.name, state=FAILED, events=events))
        log.warning(line)

    def finished(self, step: Step, stored: Stored) -> None:
        """A stage's artifact is in the store."""
        record = stored.manifest.record
        state = CACHED if stored.is_cached else COMPUTED
        seconds = None if stored.is_cached else record.get("seconds")
        # The artifact tells of the attempts that failed, too.
        events = tuple(str(event.get("message", "")) for event in record.get("events", ()))
        self._at_work(step, state=state, seconds=seconds, events=events)
        log.info("%s %s: %s", state, step.key8, record.get("headline", ""))

    def _at_work(self, step: Step, **changes: Any) -> None:
        """Name a stage that begins or ends, with what has changed about it."""
        name = step.node.name
        self._change(stage=name, step=0, total=0, due=None, **self._stage(name, **changes))

    def _stage(self, name: str, **changes: Any) -> dict[str, dict[str, StageRecord]]:
        stages = self.record.stages
        return {"stages": {**stages, name: replace(stages[name], **changes)}}

    def _change(self, **changes: Any) -> None:
        with self._writing:
            self.record = replace(self.record, changed=time.time(), **changes)
            self._written_s = time.monotonic()
            with contextlib.suppress(OSError):  # a view; the run does not end for its sake
                self._index.write(self.record)


class Audience:
    """Several observers of a run as one."""

    def __init__(self, *observers: "Observer") -> None:
        self._observers = observers

    def started(self, step: Step) -> None:
        """A stage begins to compute."""
        for observer in self._observers:
            observer.started(step)

    def progressed(self, progress: "Progress") -> None:
        """A stage has done some of its steps."""
        for observer in self._observers:
            observer.progressed(progress)

    def failed(self, step: Step, error: BaseException) -> None:
        """A stage failed; it may be tried again."""
        for observer in self._observers:
            observer.failed(step, error)

    def finished(self, step: Step, stored: Stored) -> None:
        """A stage's artifact is in the store."""
        for observer in self._observers:
            observer.finished(step, stored)


def _planned(step: Step) -> StageRecord:
    """A stage before the run."""
    states = {Verdict.CACHED: CACHED, Verdict.COMPUTE: WAITING}
    is_wanted = step.verdict in states
    key = step.recipe.key if step.recipe and is_wanted else None
    return StageRecord(key, states.get(step.verdict, str(step.verdict)))


class _RunLog(logging.FileHandler):
    """A log whose lines are lost where they cannot be written: no run fails, or is told, of it."""

    def handleError(self, record: logging.LogRecord) -> None:
        """Say nothing: who writes a full disk's log has other worries."""

    def close(self) -> None:
        """Close the file, whether or not its last lines could be written."""
        with contextlib.suppress(OSError):
            super().close()


@contextlib.contextmanager
def _log_to(file: Path, stage: Callable[[], str]) -> Iterator[None]:
    """Append what flows and stages tell, each line with the stage at work, to a file."""
    handler = _RunLog(file, encoding="utf-8")
    handler.setFormatter(logging.Formatter(LOG_FORMAT, LOG_TIME))

    def add_stage(record: logging.LogRecord) -> bool:
        record.stage = stage() or "-"
        return True

    handler.addFilter(add_stage)
    flows, stages = logging.getLogger("flows"), logging.getLogger("stages")
    levels = flows.level, stages.level
    for logger in (flows, stages):
        logger.addHandler(handler)
        logger.setLevel(logging.INFO)
        # These lines are for the file: the console has a display of its own, and Prefect, once it
        # is imported, prints whatever reaches the root.
        logger.propagate = False
    try:
        yield
    finally:
        for logger, level in zip((flows, stages), levels, strict=True):
            logger.propagate = True
            logger.removeHandler(handler)
            logger.setLevel(level)
        handler.close()
