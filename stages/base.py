"""What a stage is and what it is given to work with."""

import contextlib
import csv
import hashlib
import inspect
import json
import logging
import math
import re
import time
import typing
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol, Self

import torch
from torch import Tensor

from stages.errors import DivergenceError
from svim3d.io.weights import load_sealed, save_sealed

log = logging.getLogger(__name__)

CHECKPOINT_EVERY_S = 20.0  # a killed stage loses at most this much work
MAX_NON_FINITE_STEPS = 20  # beyond this the optimisation is diverging, not hiccuping
NON_FINITE_STEP = "non_finite_step"  # kind of the event that such a step leaves
OUT_OF_MEMORY = "out_of_memory"  # kind of the event that an attempt leaves which ran out of it
SCALAR_ROW = re.compile(rb"(\d{1,9}),[^,\n]+,[^,\n]+\n")  # the step, a term and its value
MIN_CHUNK = 1024  # smaller ones save little memory, and calls begin to cost more than work


class Artifact(Protocol):
    """A frozen value that passes between stages and lives in a folder."""

    def save(self, folder: Path) -> None:
        """Write the payload into an existing, empty folder."""

    @classmethod
    def load(cls, folder: Path) -> Self:
        """Read the payload back, on the CPU."""

    def headline(self) -> str:
        """What it is, in a few words and numbers: a cell of the run's closing table."""


@dataclass(frozen=True)
class Progress:
    """One sign of life from a running stage."""

    stage: str
    step: int
    total: int
    terms: Mapping[str, float]


class Checkpoints:
    """Named tensors of a half-done stage: the last good step, replaced atomically.

    Args:
        folder: where they lie; it exists.
        every_s: how often they are due.
        before_save: called before each is written.
        tell: told, by a word and a message, that one was taken up or was damaged.
    """

    def __init__(
        self,
        folder: Path,
        every_s: float = CHECKPOINT_EVERY_S,
        before_save: Callable[[], None] | None = None,
        tell: Callable[[str, str], None] | None = None,
    ) -> None:
        self._file = folder / "checkpoint.safetensors"
        self._every_s = every_s
        self._before_save = before_save
        self._tell = tell or (lambda kind, message: log.warning(message))
        self._last_s = time.monotonic()

    @property
    def exists(self) -> bool:
        """Whether an earlier attempt left something to go on with."""
        return self._file.exists()

    def due(self) -> bool:
        """Whether enough time has passed since the last one."""
        return time.monotonic() - self._last_s >= self._every_s

    def save(self, step: int, tensors: Mapping[str, Tensor]) -> None:
        """Replace the checkpoint by the state before `step`."""
        if self._before_save is not None:
            self._before_save()
        temporary = self._file.with_suffix(".tmp")
        save_sealed(temporary, {**tensors, "__step__": torch.tensor(step)})
        temporary.replace(self._file)
        self._last_s = time.monotonic()

    def discard(self) -> None:
        """Forget the half-done work."""
        self._file.unlink(missing_ok=True)

    def load(self) -> tuple[int, dict[str, Tensor]] | None:
        """The step to go on with and its state, or None at the beginning."""
        if not self.exists:
            return None
        try:
            tensors = load_sealed(self._file)
            step = int(tensors.pop("__step__"))
        except Exception as error:  # of any kind: a damaged checkpoint costs time, nothing else
            self._tell("damaged_checkpoint", f"started anew, its checkpoint was damaged: {error}")
            self.discard()
            return None
        self._tell("resumed", f"went on at step {step} from a checkpoint of an interrupted run")
        return step, tensors


@dataclass
class Context:
    """What a stage may know of its surroundings.

    Attributes:
        stage: the stage's name.
        device: where tensors should live.
        seed: seed of the run; every generator derives from it.
        work: private folder for checkpoints and scalars, kept until the artifact is published.
        shared: folder for derived data that runs may share (content-addressed by its users).
        on_progress: called at most a few times a second.
        events: fallbacks taken, views dropped, steps skipped; they end up in the manifest.
        checkpoint_every_s: how often a long stage saves its state.
    """

    stage: str
    device: torch.device
    seed: int
    work: Path
    shared: Path
    on_progress: Callable[[Progress], None] | None = None
    events: list[dict[str, str]] = field(default_factory=list)
    checkpoint_every_s: float = CHECKPOINT_EVERY_S

    def __post_init__(self) -> None:
        self.work.mkdir(parents=True, exist_ok=True)
        self.checkpoints = Checkpoints(
            self.work,
            self.checkpoint_every_s,
            before_save=self._flush_scalars,
            tell=self.event,
        )
        self._scalars: typing.TextIO | None = None
        self._last_progress_s = -math.inf
        self._event_log = self.work / "events.jsonl"
        if self._event_log.exists():
            self.events.extend(_readable_events(self._event_log.read_bytes()))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._scalars is not None:
            self._scalars.close()

    def generator(self, name: str, device: str | torch.device = "cpu") -> torch.Generator:
        """A random generator that depends on the run's seed, the stage and `name` alone."""
        digest = hashlib.sha256(f"{self.seed}/{self.stage}/{name}".encode()).digest()
        return torch.Generator(device=device).manual_seed(int.from_bytes(digest[:7], "big"))

    def event(self, kind: str, message: str, *, tell: bool = True) -> None:
        """Record something the operator should know and the manifest must keep.

        The record outlives a killed process; a resumed one that meets the same event again (name
        the step in the message) does not repeat it.

        Args:
            kind: a word for programs.
            message: for people.
            tell: whether to warn now, besides.
        """
        entry = {"kind": kind, "message": message}
        if entry in self.events:
            return
        if tell:
            log.warning("%s: %s", self.stage, message)
        self.events.append(entry)
        with self._event_log.open("a") as stream:
            # Begun anew, in case a full disk has cut the line before.
            stream.write("\n" + json.dumps(entry) + "\n")

    def count(self, kind: str) -> int:
        """How many events of a kind there were, in earlier attempts too."""
        return sum(entry["kind"] == kind for entry in self.events)

    def chunk(self, most: int) -> int:
        """How many items to work on at a time: `most`, halved for each time that memory ran out.

        For what gives the same result in pieces of any size, to rounding: the size is no part of
        the artifact's key.
        """
        return max(min(most, MIN_CHUNK), most >> self.count(OUT_OF_MEMORY))

    def report(self, step: int, total: int, terms: Mapping[str, float]) -> None:
        """Append scalars to `scalars.csv` and show progress; cheap enough for every step.

        Rows are `step,term,value`. `step` counts up through the whole stage, to `total`: a resumed
        stage rewrites the rows from its first step on.
        """
        if self._scalars is None:
            self._scalars = self._open_scalars(step)
        writer = csv.writer(self._scalars, lineterminator="\n")
        writer.writerows([step, name, f"{value:.6g}"] for name, value in terms.items())
        now = time.monotonic()
        if self.on_progress is not None and (now - self._last_progress_s > 0.2 or step == total):
            self._last_progress_s = now
            self.on_progress(Progress(self.stage, step, total, dict(terms)))

    def _open_scalars(self, first_step: int) -> typing.TextIO:
        """Continue what a killed attempt left; its rows from `first_step` on are made again."""
        file = self.work / "scalars.csv"
        rows = file.read_bytes().splitlines(keepends=True) if file.exists() else []
        whole = [match for row in rows if (match := SCALAR_ROW.fullmatch(row))]
        file.write_bytes(b"".join(row[0] for row in whole if int(row[1]) < first_step))
        return file.open("a", newline="")

    def _flush_scalars(self) -> None:
        """A checkpoint promises that nothing before it must be done again: neither must rows."""
        if self._scalars is not None:
            self._scalars.flush()

    def is_finite(self, step: int, terms: Mapping[str, Tensor]) -> bool:
        """Whether all terms are finite; a bad step is counted and should be skipped.

        Raises:
            DivergenceError: after `MAX_NON_FINITE_STEPS` bad steps; what was checkpointed is
                forgotten, so that the next attempt starts anew.
        """
        bad = [name for name, value in terms.items() if not bool(torch.isfinite(value).all())]
        if not bad:
            return True
        self.event(NON_FINITE_STEP, f"step {step} skipped: non-finite {', '.join(bad)}")
        if self.count(NON_FINITE_STEP) > MAX_NON_FINITE_STEPS:
            self.checkpoints.discard()
            self._event_log.unlink(missing_ok=True)
            raise DivergenceError(
                f"{self.stage}: more than {MAX_NON_FINITE_STEPS} steps had a non-finite "
                f"{', '.join(bad)}; lower the learning rate or check the input for NaN"
            )
        return False


@dataclass(frozen=True)
class Stage:
    """A stage's `run` function, with what its signature says about inputs and output.

    `run(<artifact or None>..., *, config, ctx) -> Artifact`. An input annotated `Path` is a file or
    folder from outside; any other is an artifact class, `| None` where the input may be skipped.
    """

    run: Callable[..., Any]

    def _hints(self) -> dict[str, Any]:
        return typing.get_type_hints(self.run)

    @property
    def inputs(self) -> dict[str, type[Any]]:
        """Input names with the class that each is loaded as."""
        hints = self._hints()
        positional = [
            p.name
            for p in inspect.signature(self.run).parameters.values()
            if p.kind is not inspect.Parameter.KEYWORD_ONLY
        ]
        return {name: _without_none(hints[name]) for name in positional}

    @property
    def output(self) -> type[Any]:
        """The artifact class that `run` returns."""
        output: type[Any] = self._hints()["return"]
        return output


def _readable_events(log_of_events: bytes) -> Iterator[dict[str, str]]:
    """Entries of an event log; lines that were cut or spoilt are left out."""
    for line in log_of_events.splitlines():
        with contextlib.suppress(ValueError, TypeError, KeyError):
            entry = json.loads(line)
            yield {"kind": str(entry["kind"]), "message": str(entry["message"])}


def _without_none(annotation: Any) -> type[Any]:
    """`A | None` -> `A`."""
    options = [a for a in typing.get_args(annotation) if a is not type(None)]
    chosen: type[Any] = options[0] if options else annotation
    return chosen
