"""What is known of a run: its page among all runs, and what the store holds of each stage."""

import contextlib
import csv
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from flows.config import PipelineConfig, differences
from flows.report.notes import FAILED_ATTEMPT
from flows.run_folder import RUN_PAGE
from flows.run_records import FAILED, RunIndex, RunRecord
from stages.store import Store, Stored

SCALARS, EVENTS = "scalars.csv", "events.jsonl"
MOST_ROWS = 400_000  # of a stage's scalars; a run of the paper's length has a tenth of it
LOG_LINES = 40  # the end of a failed run's log

Curve = list[tuple[int, float]]  # step and value


@dataclass(frozen=True)
class StageEvidence:
    """One stage of a run.

    Attributes:
        name: of the stage.
        state: what became of it.
        seconds: that making the artifact took, whenever that was; None without an artifact.
        cpu_seconds: the same, summed over cores.
        memory_mib: highest resident memory of the process meanwhile.
        size: bytes of the artifact.
        headline: the artifact in a few words.
        key: of the artifact, empty where the stage was left out.
        events: kind and message.
        curves: by term, what the stage counted on its way.
        stored: the artifact, if the store has it.
    """

    name: str
    state: str
    seconds: float | None
    cpu_seconds: float | None
    memory_mib: float | None
    size: int | None
    headline: str
    key: str
    events: tuple[tuple[str, str], ...]
    curves: dict[str, Curve]
    stored: Stored | None


@dataclass(frozen=True)
class RunEvidence:
    """A run and its stages.

    Attributes:
        record: its page; `now` says what became of it.
        stages: in order.
        about: what the run folder's own page says besides; empty for a run that did not get there.
        log: the last lines of its log, for runs that failed.
    """

    record: RunRecord
    stages: tuple[StageEvidence, ...]
    about: Mapping[str, Any]
    log: tuple[str, ...]

    @property
    def artifacts(self) -> dict[str, Stored]:
        """What the store has, by stage."""
        return {stage.name: stage.stored for stage in self.stages if stage.stored}

    def settings(self) -> list[tuple[str, str, str]]:
        """Settings that are not the defaults: name, value, default."""
        defaults = PipelineConfig().model_dump(mode="json")
        return [
            (f"{stage.name}.{name}", _said(value), _said(default))
            for stage in self.stages
            if stage.stored
            for name, value, default in differences(
                stage.stored.manifest.recipe.config, defaults.get(stage.name, {})
            )
        ]


def gather(record: RunRecord, store: Store) -> RunEvidence:
    """Read all that is known of a run; nothing is computed."""
    index = RunIndex(store.root)
    log: Sequence[str] = ()
    if record.error or record.now == FAILED:
        with contextlib.suppress(OSError):
            log = index.log(record.id).read_text(errors="replace").splitlines()[-LOG_LINES:]
    stages = tuple(_stage(name, record, store) for name in record.stages)
    return RunEvidence(record, stages, _about(record), tuple(log))


def _about(record: RunRecord) -> dict[str, Any]:
    """The run folder's page, if it is this run's."""
    with contextlib.suppress(OSError, ValueError, AttributeError):
        page = json.loads((Path(record.folder) / RUN_PAGE).read_text())
        keys = {stage["key"] for stage in page.get("stages", {}).values()}
        if record.keys <= keys:
            return dict(page)
    return {}


def _stage(name: str, record: RunRecord, store: Store) -> StageEvidence:
    noted = record.stages[name]
    stored = store.check(noted.key).stored if noted.key else None
    made = stored.manifest.record if stored else {}
    work = store.work(noted.key) if noted.key else None
    if stored:
        events = [(str(e.get("kind", "")), str(e.get("message", ""))) for e in made["events"]]
        scalars = store.artifact(stored.key) / SCALARS
    else:
        events = list(_unfinished_events(work)) if work else []
        events += [(FAILED_ATTEMPT, line) for line in noted.events]
        scalars = work / SCALARS if work else Path(SCALARS)
    return StageEvidence(
        name=name,
        state=noted.state,
        seconds=made.get("seconds"),
        cpu_seconds=made.get("cpu_seconds"),
        memory_mib=made.get("peak_memory_mib", {}).get("host"),
        size=stored.manifest.size if stored else None,
        headline=str(made.get("headline", "")),
        key=noted.key or "",
        events=tuple(events),
        curves=read_curves(scalars),
        stored=stored,
    )


def _unfinished_events(work: Path) -> Iterator[tuple[str, str]]:
    """What a stage told before it failed; lines that were cut are left out."""
    with contextlib.suppress(OSError):
        for line in (work / EVENTS).read_bytes().splitlines():
            with contextlib.suppress(ValueError, KeyError, TypeError):
                entry = json.loads(line)
                yield str(entry["kind"]), str(entry["message"])


def read_curves(file: Path) -> dict[str, Curve]:
    """Curves by term of a stage's `step,term,value` rows; rows that were cut are left out."""
    curves: dict[str, Curve] = {}
    with contextlib.suppress(OSError), file.open(newline="", errors="replace") as stream:
        for number, row in enumerate(csv.reader(stream)):
            if number >= MOST_ROWS:
                break
            with contextlib.suppress(ValueError):
                step, term, value = row
                curves.setdefault(term, []).append((int(step), float(value)))
    return {term: curve for term, curve in curves.items() if len(curve) > 1}


def _said(value: Any) -> str:
    """A setting's value as `--set` takes it."""
    if value is ...:
        return ""
    if isinstance(value, list | tuple):
        return f"[{', '.join(_said(v) for v in value)}]"
    return "none" if value is None else str(value)
