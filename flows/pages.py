"""What is shown of a run where it can be seen by a browser: pages in Markdown.

Pages carry their pictures in themselves. A browser loads no file of the machine that computes, and
a picture must not make a page so large that a list of pages is slow.
"""

import base64
import csv
import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from flows.plan import Plan, Step, state_of
from flows.run_records import RunRecord
from stages.store import Stored

PICTURE_BYTES = 48_000  # of all pictures of a page; in base64, as they are written, 64,000
SCALARS = "scalars.csv"
FIGURES = ("metrics.json", "summary.json")  # that stages leave in their payload
MAX_ROWS = 60  # of a table
Pictures = Mapping[str, bytes]


def stage_page(stored: Stored, pictures: Pictures) -> str:
    """What a stage has made: how it went, its pictures, its figures, how its losses fell."""
    record = stored.manifest.record
    how = "taken from the store" if stored.is_cached else f"computed in {record['seconds']:.1f} s"
    memory = record.get("peak_memory_mib", {}).get("host")
    facts = [how, *([f"{memory:.0f} MiB"] if memory else []), f"key `{stored.key[:8]}`"]
    return "\n\n".join(
        part
        for part in (
            ", ".join(facts),
            _list(_events(record)),
            *(_picture(name, content) for name, content in pictures.items()),
            _table(("figure", "value"), _figures(stored.folder)),
            _table(("term", "first", "last", "step"), _scalars(stored.folder.parent / SCALARS)),
        )
        if part
    )


def run_page(
    plan: Plan,
    artifacts: Mapping[str, Stored],
    pictures: Pictures,
    record: RunRecord | None,
    error: str,
) -> str:
    """A run as a whole: its stages in a table, what it is for, and where that lies."""
    rows = [_row(step, artifacts.get(step.node.name)) for step in plan.steps]
    parts = [f"**{_plain(error)}**" if error else ""]
    parts += [_picture(name, content) for name, content in pictures.items()]
    parts.append(_table(("stage", "state", "seconds", "MiB", "key", "result", "events"), rows))
    if record is not None:
        parts.append(
            f"Run `{record.id}` on `{record.process.host}`: `{record.folder}`\n\n"
            f"`svim3d status {record.id}`, `svim3d logs {record.id}`"
        )
    return "\n\n".join(part for part in parts if part)


def product_stages(plan: Plan) -> Iterable[str]:
    """Stages with a picture that the user came for, each once, the best first."""
    return dict.fromkeys(
        stage
        for product in plan.pipeline.products
        if product.name.endswith(".png")
        for stage, _ in product.origins
    )


def _row(step: Step, stored: Stored | None) -> tuple[str, ...]:
    state = state_of(step, stored)
    if stored is None:
        return (step.node.name, state, "", "", step.key8, "", "")
    record = stored.manifest.record
    memory = record.get("peak_memory_mib", {}).get("host")
    return (
        step.node.name,
        state,
        f"{record['seconds']:.1f}",
        f"{memory:.0f}" if memory else "",
        step.key8,
        record.get("headline", ""),
        "; ".join(_events(record)),
    )


def _events(record: Mapping[str, Any]) -> list[str]:
    return [str(event["message"]) for event in record.get("events", ())]


def _figures(payload: Path) -> list[tuple[str, str]]:
    """Plain values of the JSON files that stages sum themselves up in."""
    rows = []
    for name in FIGURES:
        if (payload / name).is_file():
            page = json.loads((payload / name).read_text())
            rows += [(key, _number(value)) for key, value in page.items() if _is_plain(value)]
    return rows


def _scalars(file: Path) -> list[tuple[str, str, str, str]]:
    """Of each term of a stage's `step,term,value` rows the first and the last value."""
    first: dict[str, str] = {}
    last: dict[str, tuple[str, str]] = {}
    if file.is_file():
        with file.open(newline="") as stream:
            for step, term, value in csv.reader(stream):
                first.setdefault(term, value)
                last[term] = value, step
    return [(term, first[term], *last[term]) for term in first]


def _is_plain(value: Any) -> bool:
    return isinstance(value, int | float | str)


def _number(value: float | str) -> str:
    return f"{value:.5g}" if isinstance(value, float) else str(value)


def _picture(name: str, content: bytes) -> str:
    return f"![{name}](data:image/jpeg;base64,{base64.b64encode(content).decode()})"


def _list(lines: Iterable[str]) -> str:
    return "\n".join(f"- {_plain(line)}" for line in lines)


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table in Markdown; empty without rows."""
    if not rows:
        return ""
    lines = [
        head,
        ["---"] * len(head),
        *([_plain(cell) for cell in row] for row in rows[:MAX_ROWS]),
    ]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _plain(text: str) -> str:
    """A text in a line, in which nothing is taken for markup."""
    for sign in "\\`*_[]<>|":
        text = text.replace(sign, f"\\{sign}")
    return " ".join(text.split())
