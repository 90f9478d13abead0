"""The queue of jobs: kept on disk, carried out as child processes, a few at a time.

One thread looks after all of it. What is acknowledged is on disk first, so a service that was
killed goes on where it was: waiting jobs wait, running ones are run again, which resumes them.
"""

import contextlib
import fcntl
import logging
import os
import shutil
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from flows.service.child import Child, kill_leftover
from flows.service.limits import Limits
from flows.service.outcome import explain_end
from flows.service.records import Record, new_id
from stages.errors import InputError

log = logging.getLogger(__name__)

POLL_S = 0.1
TIDY_EVERY_S = 60.0
STOP_GRACE_S = 20.0  # a stage looks for an interrupt between steps, which may take seconds
MAX_STARTS = 3  # a run that takes the service down with it must not do so for ever
BAD_INPUT = 2  # exit code of a run whose input can never work

Command = Callable[[Record, Path], Sequence[str]]


class QueueFullError(Exception):
    """As many jobs wait as may."""


class JobQueue:
    """Jobs under one folder; `with` it for as long as they are to be carried out.

    Args:
        folder: made if it is not there; of one service at a time.
        command: what runs a job, given its record and its folder.
        limits: of waiting, running and keeping.
        slots: runs at a time.
    """

    def __init__(self, folder: Path, command: Command, limits: Limits, *, slots: int) -> None:
        self.limits = limits
        self.slots = slots
        self._folder = folder
        self._command = command
        self._lock = threading.RLock()
        self._wake = threading.Event()
        self._stopping = False
        self._receiving = 0
        self._records: dict[str, Record] = {}
        self._children: dict[str, Child] = {}
        # By the clock that nobody sets: when a run must be done, and when a stopped one is killed.
        self._due: dict[str, float] = {}
        self._kill_at: dict[str, float] = {}
        self._tidy_at = 0.0

    def __enter__(self) -> "JobQueue":
        """Take the folder, read what is there, begin to work.

        Raises:
            InputError: the folder cannot be written, or another service works on it.
        """
        try:
            for name in ("jobs", "incoming"):
                (self._folder / name).mkdir(parents=True, exist_ok=True)
            self._mine = (self._folder / "lock").open("a")
            fcntl.flock(self._mine, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise InputError(
                f"another service works on {self._folder}; stop it, or choose another --store"
            ) from error
        except OSError as error:
            raise InputError(
                f"the folder {self._folder} cannot be written ({error.strerror}); mend its "
                "permissions or choose another --store"
            ) from error
        _clear(self._folder / "incoming")
        self._recover()
        self._thread = threading.Thread(target=self._work, name="jobs", daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Stop all runs so that they can be resumed, and leave their jobs waiting."""
        self._stopping = True
        self._wake.set()
        self._thread.join()
        self._mine.close()

    def folder(self, record: Record) -> Path:
        """Where a job lies."""
        return self._folder / "jobs" / record.id

    def get(self, job: str) -> Record | None:
        """A job as it stands; None if there is none of this id."""
        with self._lock:
            found = self._records.get(job)
            return found and found.model_copy(deep=True)

    def newest(self) -> list[Record]:
        """All jobs as they stand, the newest first."""
        with self._lock:
            records = [record.model_copy(deep=True) for record in self._records.values()]
        return sorted(records, key=lambda record: record.created, reverse=True)

    def position(self, record: Record) -> int | None:
        """How many jobs come before a waiting one; None if it waits no more."""
        waiting = [waiting.id for waiting in self._waiting()]
        return waiting.index(record.id) if record.id in waiting else None

    def count(self, *states: str) -> int:
        """How many jobs are in these states."""
        with self._lock:
            return sum(record.state in states for record in self._records.values())

    @contextlib.contextmanager
    def place(self) -> Iterator[None]:
        """Hold a place in the queue while a job is received.

        Raises:
            QueueFullError: there is none.
        """
        with self._lock:
            if self.count("queued") + self._receiving >= self.limits.queue:
                raise QueueFullError
            self._receiving += 1
        try:
            yield
        finally:
            with self._lock:
                self._receiving -= 1

    def submit(self, fill: Callable[[str, Path], Record]) -> Record:
        """Add a job.

        Args:
            fill: `fill(id, folder)` writes the input into an empty folder and returns the record;
                what it raises leaves nothing behind.
        """
        job = new_id()
        incoming = self._folder / "incoming" / job
        incoming.mkdir()
        try:
            record = fill(job, incoming)
            record.note(time.time(), "queued")
            record.write(incoming)
            with self._lock:
                incoming.rename(self.folder(record))
                _sync_folder(self._folder / "jobs")
                self._records[job] = record
                copy = record.model_copy(deep=True)
        finally:
            shutil.rmtree(incoming, ignore_errors=True)
        self._wake.set()
        return copy

    def cancel(self, job: str) -> Record | None:
        """Cancel a job that waits or runs, remove one that has ended; None if there is none."""
        with self._lock:
            record = self._records.get(job)
            if record is None:
                return None
            if record.state == "queued":
                self._finish(record, "cancelled", "cancelled before it was started")
            elif record.state == "running":
                self._change(record, "asked to stop", state="cancelling")
                self._stop_child(job)
            elif not record.is_active:
                self._remove(record)
            return record.model_copy(deep=True)

    # What the queue's own thread does.

    def _recover(self) -> None:
        """Read all jobs; those that were running wait again."""
        for folder in sorted((self._folder / "jobs").iterdir()):
            try:
                record = Record.read(folder)
            except (OSError, ValueError) as error:
                log.warning("%s is left alone: its page cannot be read (%s)", folder, error)
                continue
            self._records[record.id] = record
            if record.state in ("running", "cancelling"):
                kill_leftover(folder, record.pid)
            if record.state == "cancelling":
                self._finish(record, "cancelled", "cancelled")
            elif record.state == "running":
                self._change(record, "the service was started again", state="queued", pid=None)

    def _work(self) -> None:
        while not self._stopping:
            try:
                self._look()
            except Exception:
                # A full disk or a lost mount; the queue outlives it.
                log.exception("the queue met a fault and goes on")
            self._wake.wait(POLL_S)
            self._wake.clear()
        self._stop_all()

    def _look(self) -> None:
        """See what has ended, what takes too long, what can be started, what is too old."""
        with self._lock:
            now = time.monotonic()
            for job, child in list(self._children.items()):
                code = child.exit_code()
                if code is not None:
                    self._ended(self._records[job], code)
                elif job in self._kill_at:
                    if now > self._kill_at[job]:
                        child.kill()
                elif now > self._due[job]:
                    error = f"took longer than {self.limits.timeout_s:.0f} s; use a lighter preset"
                    self._change(self._records[job], "timed out", error=error)
                    self._stop_child(job)
            for record in self._waiting():
                if len(self._children) < self.slots:
                    self._start(record)
            if now > self._tidy_at:
                self._tidy_at = now + TIDY_EVERY_S
                self._tidy()

    def _waiting(self) -> list[Record]:
        with self._lock:
            waiting = [record for record in self._records.values() if record.state == "queued"]
        return sorted(waiting, key=lambda record: record.created)

    def _start(self, record: Record) -> None:
        folder = self.folder(record)
        if record.starts >= MAX_STARTS:
            error = f"{record.starts} runs of it ended together with the service; it is left out"
            self._finish(record, "failed", "failed", error=error)
            return
        try:
            child = Child.start(self._command(record, folder), folder)
        except OSError as error:
            self._finish(record, "failed", "failed", error=f"no run could be started: {error}")
            return
        if child is None:
            return  # an earlier run is about to end
        self._children[record.id] = child
        self._due[record.id] = time.monotonic() + self.limits.timeout_s
        now, starts = time.time(), record.starts + 1
        message = "started" if starts == 1 else f"started again ({starts})"
        self._change(
            record, message, state="running", started=now, starts=starts, pid=child.pid, error=None
        )

    def _ended(self, record: Record, code: int) -> None:
        del self._children[record.id]
        self._due.pop(record.id, None)
        self._kill_at.pop(record.id, None)
        if record.state == "cancelling":
            self._finish(record, "cancelled", "cancelled")
        elif code == 0:
            self._finish(record, "done", "done", error=None)
        else:
            error = record.error or explain_end(self.folder(record), code)
            message = "the input cannot work" if code == BAD_INPUT else "failed"
            self._finish(record, "failed", message, error=error)

    def _stop_child(self, job: str) -> None:
        self._children[job].ask_to_stop()
        self._kill_at[job] = time.monotonic() + STOP_GRACE_S

    def _stop_all(self) -> None:
        """End all runs; their jobs wait for the next start of the service."""
        with self._lock:
            for child in self._children.values():
                child.ask_to_stop()
            deadline = time.monotonic() + STOP_GRACE_S
            for job, child in self._children.items():
                while (code := child.exit_code()) is None and time.monotonic() < deadline:
                    time.sleep(POLL_S / 10)
                if code is None:
                    child.kill()
                record = self._records[job]
                if record.state == "cancelling":
                    self._finish(record, "cancelled", "cancelled")
                    continue
                # A stop that was asked for is no sign of a run that takes the service down.
                starts = record.starts - 1
                message = "waits: the service stops"
                self._change(record, message, state="queued", starts=starts, pid=None)
            self._children.clear()

    def _tidy(self) -> None:
        """Remove what ended long ago."""
        now = time.time()
        for record in list(self._records.values()):
            if record.finished is not None and now - record.finished > self.limits.keep_s:
                self._remove(record)

    def _remove(self, record: Record) -> None:
        """Forget a job: its page first, so that half a removal is none that comes back."""
        with contextlib.suppress(FileNotFoundError):
            gone = self._folder / "incoming" / f"{record.id}.gone"
            self.folder(record).rename(gone)
            shutil.rmtree(gone, ignore_errors=True)
        self._records.pop(record.id, None)

    def _finish(self, record: Record, state: str, message: str, **values: object) -> None:
        self._change(record, message, state=state, finished=time.time(), pid=None, **values)

    def _change(self, record: Record, message: str, **values: object) -> None:
        """Change a record in memory and on disk."""
        for name, value in values.items():
            setattr(record, name, value)
        record.note(time.time(), message)
        record.write(self.folder(record))


def _clear(folder: Path) -> None:
    """Remove what a folder holds: jobs that were never acknowledged, removals cut short."""
    for path in folder.iterdir():
        shutil.rmtree(path, ignore_errors=True)


def _sync_folder(folder: Path) -> None:
    """Make a rename in a folder outlive a loss of power."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
