"""What is known of every run: a small page each, in one folder of the store.

    runs/<id>.json   what was asked for, how far it is, how it ended
    runs/<id>.log    what its stages said

Pages are replaced in one step and read without touching an artifact. They are a view: a run that
cannot write them runs all the same, and what the store holds decides what is computed.
"""

import contextlib
import json
import os
import re
import secrets
import time
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Self

from flows.processes import Process
from stages.errors import InputError

RUNNING, DONE, FAILED, CANCELLED, DIED = "running", "done", "failed", "cancelled", "died"
UNFINISHED = (FAILED, CANCELLED, DIED)
WAITING, COMPUTING, COMPUTED, CACHED = "waiting", "computing", "computed", "cached"  # of stages
# A run on a machine that cannot be asked counts as ended when it gave no sign for this long.
SILENT_S = 3600.0
MAX_NAME = 20  # of the folder's name in an id
ID = re.compile(r"[A-Za-z0-9_][A-Za-z0-9._-]{0,99}")


def in_a_line(error: BaseException) -> str:
    """A fault as pages, logs and servers tell it."""
    return " ".join(f"{type(error).__name__}: {error}".split())


@dataclass(frozen=True)
class StageRecord:
    """One stage of a run.

    Attributes:
        key: of its artifact; None where it is left out.
        state: "waiting", "computing", "failed", or as in the run's closing table.
        seconds: that computing it took.
        events: fallbacks taken, attempts that failed, views dropped, as messages.
    """

    key: str | None
    state: str
    seconds: float | None = None
    events: tuple[str, ...] = ()

    @classmethod
    def parse(cls, entry: Mapping[str, Any]) -> Self:
        """Read a page's entry."""
        return cls(**{**entry, "events": tuple(entry.get("events", ()))})


@dataclass(frozen=True)
class RunRecord:
    """One run: a command that was carried out, or is, or was until it was stopped.

    Attributes:
        id: name of its page.
        command: arguments of `svim3d` that do the same again; empty if it cannot be repeated.
        cwd: where they were given.
        pipeline: name of the flow.
        source: the input, as an absolute path.
        preset: of settings; empty where there are none.
        folder: the run folder, as an absolute path.
        process: that carries it out.
        state: as it was last written; see `now` for what became of it.
        stages: by name, in order.
        stage: at work now, or when the run ended; empty before the first.
        step: how far that stage is.
        total: steps of that stage; 0 while unknown.
        started: seconds since 1970.
        changed: when the page was last written.
        ended: None while it runs.
        error: how it failed, in a line.
        due: when the stage at work should be done, by its pace so far; None while unknown.
    """

    id: str
    command: tuple[str, ...]
    cwd: str
    pipeline: str
    source: str
    preset: str
    folder: str
    process: Process
    state: str
    stages: dict[str, StageRecord]
    stage: str
    step: int
    total: int
    started: float
    changed: float
    ended: float | None
    error: str
    due: float | None = None

    @property
    def asset(self) -> str:
        """Short name of the input."""
        return Path(self.source).stem

    @property
    def keys(self) -> frozenset[str]:
        """Artifacts that it has or wants."""
        return frozenset(stage.key for stage in self.stages.values() if stage.key)

    @property
    def now(self) -> str:
        """State, with a run whose process is gone told from one that goes on."""
        if self.state != RUNNING:
            return self.state
        is_alive = self.process.is_alive()
        if is_alive is None:
            is_alive = time.time() - self.changed < SILENT_S
        return RUNNING if is_alive else DIED

    @property
    def duration_s(self) -> float:
        """How long it took, or has taken; a clock that was set back counts as none."""
        if self.ended is not None:
            end = self.ended
        else:
            end = time.time() if self.now == RUNNING else self.changed
        return max(0.0, end - self.started)

    @classmethod
    def parse(cls, text: bytes) -> Self:
        """Read a page.

        Raises:
            ValueError: it is none.
        """
        try:
            page: dict[str, Any] = json.loads(text)
            stages = {name: StageRecord.parse(entry) for name, entry in page.pop("stages").items()}
            process = Process(**page.pop("process"))
            command = tuple(page.pop("command"))
            record = cls(command=command, process=process, stages=stages, **page)
        except (KeyError, TypeError, AttributeError) as error:
            raise ValueError(f"no page of a run: {error}") from error
        if not record.has_sound_types():
            raise ValueError("no page of a run: a value is of the wrong kind")
        return record

    def has_sound_types(self) -> bool:
        """Whether values are what their names promise; a page may come from elsewhere."""
        texts = (self.id, self.cwd, self.pipeline, self.source, self.preset, self.folder)
        ended = self.changed if self.ended is None else self.ended
        due = self.changed if self.due is None else self.due
        times = (self.started, self.changed, ended, due)
        numbers = (self.step, self.total, *times, self.process.pid)
        return (
            all(isinstance(t, str) for t in (*texts, self.state, self.stage, self.error))
            and all(isinstance(argument, str) for argument in self.command)
            # Not a number compares false; times beyond the year 5000 break calendars.
            and all(isinstance(n, int | float) and 0 <= n < 1e11 for n in numbers)
            and all(isinstance(s.key, str | None) for s in self.stages.values())
            and all(isinstance(s.state, str) for s in self.stages.values())
            and all(isinstance(event, str) for s in self.stages.values() for event in s.events)
            and ID.fullmatch(self.id) is not None
        )

    def as_bytes(self) -> bytes:
        """The page."""
        return json.dumps(asdict(self)).encode()


class RunIndex:
    """The pages of all runs of a store.

    Args:
        store: its root folder.
    """

    def __init__(self, store: Path) -> None:
        self.folder = store / "runs"

    def page(self, run: str) -> Path:
        """Where a run's page lies."""
        return self.folder / f"{run}.json"

    def log(self, run: str) -> Path:
        """Where a run's log lies."""
        return self.folder / f"{run}.log"

    def write(self, record: RunRecord) -> None:
        """Replace a page in one step.

        Raises:
            OSError: it cannot be written; or there is no store, which is not made here: one that
                went away while it was in use would be in the way of its return.
        """
        self.folder.mkdir(exist_ok=True)
        partial = self.folder / f".{record.id}.{os.getpid()}"
        partial.write_bytes(record.as_bytes())
        partial.replace(self.page(record.id))

    def read(self, run: str) -> RunRecord:
        """The page of a run that is there."""
        return RunRecord.parse(self.page(run).read_bytes())

    def forget(self, run: str) -> None:
        """Remove a run's page and log."""
        self.page(run).unlink(missing_ok=True)
        self.log(run).unlink(missing_ok=True)

    def records(self) -> list[RunRecord]:
        """All readable pages, newest first."""
        return sorted(self._read(), key=lambda record: record.started, reverse=True)

    def _read(self) -> Iterator[RunRecord]:
        with contextlib.suppress(FileNotFoundError), os.scandir(self.folder) as entries:
            for entry in entries:
                if entry.name.endswith(".json") and not entry.name.startswith("."):
                    with contextlib.suppress(OSError, ValueError):
                        yield RunRecord.parse(Path(entry.path).read_bytes())

    def find(self, given: str) -> RunRecord:
        """The run that a person means: by its id or its beginning, its folder or that one's name.

        Of several runs in one folder it is the newest.

        Raises:
            InputError: there is none, or more than one.
        """
        records = self.records()
        folder = str(Path(given).resolve())
        # Guesses, the most certain first.
        for is_meant in (
            lambda record: record.id == given,
            lambda record: record.folder == folder,
            lambda record: Path(record.folder).name == given,
            lambda record: record.id.startswith(given),
        ):
            found = newest_of_folders([record for record in records if is_meant(record)])
            if len(found) == 1:
                return found[0]
            if found:
                names = ", ".join(record.id for record in found[:5])
                raise InputError(f"{given} may be any of {names}; give one of these")
        raise InputError(
            f"there is no run {given} in {self.folder}; svim3d status lists those there are"
        )


def new_id(name: str) -> str:
    """A short name that no other run has."""
    plain = re.sub(r"[^A-Za-z0-9_-]+", "-", name).strip("-")[:MAX_NAME] or "run"
    return f"{plain}-{secrets.token_hex(4)}"


def newest_of_folders(records: Iterable[RunRecord]) -> list[RunRecord]:
    """Of each run folder the newest run, newest first: what it shows now."""
    latest: dict[str, RunRecord] = {}
    for record in sorted(records, key=lambda record: record.started, reverse=True):
        # An imported run has no folder here.
        latest.setdefault(record.folder or record.id, record)
    return list(latest.values())


def worth_keeping(records: Iterable[RunRecord], keep_last: int) -> list[RunRecord]:
    """Runs at work, and of each input the newest ones; of runs with equal keys the newest stands.

    Failures do not push out results: `keep_last` is counted among all runs, and again among those
    that were done.
    """
    kept = []
    seen: dict[tuple[str, str, bool], list[frozenset[str]]] = {}
    for record in sorted(records, key=lambda record: record.started, reverse=True):
        state = record.now
        is_kept = state == RUNNING
        for is_done in (False, True) if state == DONE else (False,):
            versions = seen.setdefault((record.pipeline, record.source, is_done), [])
            if record.keys not in versions and len(versions) < keep_last:
                versions.append(record.keys)
                is_kept = True
        if is_kept:
            kept.append(record)
    return kept
