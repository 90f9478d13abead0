"""The report of the stability suite: one HTML file that needs no other, and no script."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from flows.report.charts import Line, line_chart
from flows.stability_cases import OURS
from flows.stability_table import (
    FORBIDDEN,
    Judged,
    Row,
    Verdict,
    breakdowns,
    cells,
    confusion,
)

HEAD = (
    *("severity", "way", "cases", "failed", "95 %", "p5", "p50", "p95", "worst 10 %"),
    *("asset", "noted", "error", "forbidden"),
)
TEXTS = ("severity", "way", "outcome", "was")  # columns that are read, not compared
MOST_NOTES = 4  # different ones are shown of a severity


@dataclass(frozen=True)
class Cell:
    """A cell of a table."""

    text: str
    is_bad: bool = False
    is_text: bool = False


@dataclass(frozen=True)
class Table:
    """A table; the first cell of each row names it."""

    head: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    caption: str = ""


def write_page(
    judged: Sequence[Judged],
    rows: Sequence[Row],
    about: Mapping[str, tuple[str, str]],
    told: Sequence[str],
    file: Path,
) -> None:
    """Write the report.

    Args:
        judged: all cases.
        rows: the same, grouped.
        about: what each hazard is, and what its severities count.
        told: lines on how all was measured.
        file: where to.
    """
    from flows.report.template import filled  # only who writes a page loads it

    names = list(dict.fromkeys(row.hazard for row in rows))
    page = filled(
        "stability.html.j2",
        title="Stability",
        told=told,
        texts=TEXTS,
        summary=_summary(judged),
        wrong=list(_wrong(judged)),
        hazards=[_hazard(name, rows, about[name]) for name in names],
    )
    file.write_text(page)


def _summary(judged: Sequence[Judged]) -> Table:
    """How many cases came to what, by way."""
    ways = list(dict.fromkeys(one.case.way for one in judged))
    rows = []
    for verdict in Verdict:
        counts = [sum(o.case.way == w and o.verdict is verdict for o in judged) for w in ways]
        is_bad = verdict in FORBIDDEN and any(counts)
        rows.append([Cell(str(verdict)), *(Cell(str(count), is_bad) for count in counts)])
    return Table(("outcome", *ways), rows)


def _wrong(judged: Sequence[Judged]) -> Iterator[str]:
    """Cases that must not be."""
    for one in judged:
        if one.verdict in FORBIDDEN and one.case.way == OURS:
            yield f"{one.case.name}: {one.verdict}{_reason(one)}"


def _reason(one: Judged) -> str:
    if error := str(one.result.get("error", "")):
        return f", {error.strip().splitlines()[-1][:200]}"
    return f", {one.lost_db:.1f} dB lost" if math.isfinite(one.lost_db) else ""


def _hazard(name: str, rows: Sequence[Row], about: tuple[str, str]) -> dict[str, Any]:
    """A hazard: its tables, curves and pictures."""
    own = [row for row in rows if row.hazard == name]
    breaks = breakdowns(own)
    variants = []
    for variant in dict.fromkeys(row.variant for row in own):
        chosen = [row for row in own if row.variant == variant]
        variants.append(
            {
                "table": _table(variant or name, chosen, breaks),
                "chart": _chart(variant or name, chosen),
                "cases": list(_cases(chosen)),
            }
        )
    mixed = name == "gloss-or-metal"
    return {
        "name": name,
        "about": about[0],
        "unit": about[1],
        "variants": variants,
        "confusion": _confusion([o for row in own for o in row.cases]) if mixed else None,
    }


def _table(
    title: str, rows: Sequence[Row], breaks: Mapping[tuple[str, str, str], float | None]
) -> Table:
    """All severities, one way after the other."""
    ways = dict.fromkeys((row.hazard, row.variant, row.way) for row in rows)
    at = ", ".join(f"{w[2]}: {'none' if (b := breaks[w]) is None else f'{b:g}'}" for w in ways)
    caption = f"{title}; breaks down at {at}; p5 to worst tenth in dB"
    return Table(HEAD, [_row(row) for row in rows], caption)


def _row(row: Row) -> list[Cell]:
    page = cells(row, None)
    scores = [page[name] for name in ("p5_db", "p50_db", "p95_db", "worst_tenth_db")]
    return [
        Cell(f"{row.severity:g}"),
        Cell(row.way, is_text=True),
        Cell(str(page["cases"])),
        Cell(f"{page['rate']:.0%}"),
        Cell(f"{page['low']:.0%} to {page['high']:.0%}"),
        *(Cell(f"{score:.1f}" if math.isfinite(score) else "-") for score in scores),
        *(Cell(str(page[name])) for name in ("assets", "noted", "refused")),
        Cell(str(page["forbidden"]), is_bad=bool(page["forbidden"])),
    ]


def _chart(title: str, rows: Sequence[Row]) -> str:
    """Median score over severity, a line for each way; nothing where there is no course."""
    severities = sorted({row.severity for row in rows})
    lines = []
    for way in dict.fromkeys(row.way for row in rows):
        scored = [row for row in rows if row.way == way and row.scores]
        points = [(row.severity, cells(row, None)["p50_db"]) for row in scored]
        if points:
            lines.append(Line(way, sorted(points), "ours" if way == OURS else "plain"))
    if len(severities) < 2 or not lines:
        return ""
    about = f"Median score over severity: {title}"
    return line_chart(about, lines, unit="dB", ticks=severities)


def _cases(rows: Sequence[Row]) -> Iterator[dict[str, str]]:
    """Of each severity the first seed, with what was told."""
    for row in rows:
        first = row.cases[0]
        said = list(dict.fromkeys(first.notes))
        error = str(first.result.get("error", "")).strip()
        words = "; ".join([*said[:MOST_NOTES], *([error.splitlines()[-1]] if error else [])])
        about = f"severity {row.severity:g}, {row.way}: {first.verdict}"
        strip = first.result.get("strip")
        if strip or words:
            yield {
                "text": f"{about}. {words}" if words else about,
                "strip": f"data:image/jpeg;base64,{strip}" if strip else "",
                "alt": f"{row.hazard} {row.variant} {about}: two given views, then twice truth "
                "beside asset",
            }


def _confusion(judged: Sequence[Judged]) -> Table:
    """What plastic and metal came out as."""
    counts = confusion([one for one in judged if one.case.way == OURS])
    names = {False: "plastic", True: "metal"}
    rows = [
        [Cell(names[was]), Cell(str(counts[was, False])), Cell(str(counts[was, True]))]
        for was in names
    ]
    return Table(("was", "plastic", "metal"), rows)
