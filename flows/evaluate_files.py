"""Tables as Markdown, CSV and LaTeX: means, intervals, and differences to the first row."""

import csv
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from flows.evaluate_tables import ASSET, HEADS, Line, Pages, Table

if TYPE_CHECKING:
    from stages.score_summary import Interval

MARKDOWN, CSV, LATEX = "tables.md", "tables.csv", "tables.tex"
OBJECTS, FAILURES = "objects.csv", "failures.csv"
CSV_COLUMNS = (
    *("table", "row", "subject", "figure", "mean", "low", "high", "objects"),
    *("difference", "difference_low", "difference_high", "paired_objects"),
)
SPECIAL = {character: f"\\{character}" for character in "&%$#_{}"}
ABSENT = "-"

Failure = tuple[str, str, int, str]  # row, object, seed, reason


@dataclass(frozen=True)
class Cell:
    """One figure of a line.

    Attributes:
        mean: over objects, with its interval.
        difference: to the first row's line, over the objects of both; None for that one.
        digits: after the point.
    """

    mean: "Interval"
    difference: "Interval | None"
    digits: int

    @property
    def text(self) -> str:
        """For people: the mean, and in brackets its interval, or the difference and its own."""
        if not self.mean.count:
            return ABSENT
        mean = _number(self.mean.mean, self.digits)
        if self.difference is not None and self.difference.count:
            told = _number(self.difference.mean, self.digits, sign="+")
            return f"{mean} ({told}{self._ends(self.difference, sign='+')})"
        return f"{mean}{self._ends(self.mean)}"

    def _ends(self, interval: "Interval", *, sign: str = "") -> str:
        if interval.count < 2:  # one object tells nothing of others
            return ""
        low, high = (_number(end, self.digits, sign=sign) for end in (interval.low, interval.high))
        return f" [{low}, {high}]"


def cell(line: Line, figure: str) -> Cell:
    """A figure of a line over its objects."""
    from stages.score_summary import difference, mean_over_objects

    values = line.figures.get(figure, {})
    against = None
    if line.base is not None:
        against = difference(values, line.base.figures.get(figure, {}))
    return Cell(mean_over_objects(values), against, HEADS[figure][1])


def write_tables(
    tables: Sequence[Table],
    results: Mapping[str, Pages],
    failures: Sequence[Failure],
    told: Sequence[str],
    folder: Path,
) -> None:
    """Write all files of an evaluation, each replaced as a whole.

    Args:
        tables: to write.
        results: by row, then by object and seed, what they were made of.
        failures: row, object, seed and reason of each case without scores.
        told: paragraphs on how it was measured.
        folder: where to; made if need be.
    """
    folder.mkdir(parents=True, exist_ok=True)
    cells = {
        (table.name, number, figure): cell(line, figure)
        for table in tables
        for number, line in enumerate(table.lines)
        for figure in table.figures
    }
    _replace(folder / MARKDOWN, _markdown(tables, cells, failures, told))
    _replace(folder / LATEX, _latex(tables, cells, told))
    _write_csv(folder / CSV, CSV_COLUMNS, _csv_rows(tables, cells))
    _write_csv(
        folder / OBJECTS,
        ("row", "object", "seed", "part", "subject", "light", "azimuth_deg", "figure", "value"),
        _object_rows(results),
    )
    _write_csv(folder / FAILURES, ("row", "object", "seed", "reason"), failures)


Cells = Mapping[tuple[str, int, str], Cell]


def _markdown(
    tables: Sequence[Table],
    cells: Cells,
    failures: Sequence[Failure],
    told: Sequence[str],
) -> str:
    lines = ["# Evaluation", "", *(text for paragraph in told for text in (paragraph, ""))]
    for table in tables:
        lines += [f"## {table.title}", ""]
        lines.append("| row | of | " + " | ".join(HEADS[f][0] for f in table.figures) + " |")
        lines.append("|---|---|" + "---|" * len(table.figures))
        for number, line in enumerate(table.lines):
            texts = (cells[table.name, number, f].text for f in table.figures)
            lines.append(f"| {line.row} | {line.subject} | " + " | ".join(texts) + " |")
        lines += ["", *(text for note in table.notes for text in (note, ""))]
    lines += [f"## Failures: {len(failures)}", ""]
    lines += [
        f"- {name}, {row}, seed {seed}: {r.splitlines()[-1]}" for row, name, seed, r in failures
    ]
    return "\n".join(lines).rstrip() + "\n"


def _latex(tables: Sequence[Table], cells: Cells, told: Sequence[str]) -> str:
    lines = ["% \\usepackage{booktabs}", *(f"% {text}" for text in told)]
    for table in tables:
        heads = " & ".join(_escaped(HEADS[f][0]) for f in table.figures)
        lines += [
            "",
            "\\begin{table}",
            f"\\caption{{{_escaped(table.title)}}}",
            f"\\label{{tab:{table.name}}}",
            f"\\begin{{tabular}}{{ll{'r' * len(table.figures)}}}",
            "\\toprule",
            f"row & of & {heads} \\\\",
            "\\midrule",
        ]
        for number, line in enumerate(table.lines):
            found = [cells[table.name, number, f] for f in table.figures]
            means = [_number(c.mean.mean, c.digits) if c.mean.count else ABSENT for c in found]
            row = " & ".join([_escaped(line.row), _escaped(line.subject), *means])
            lines.append(f"{row} \\\\")
        lines += ["\\bottomrule", "\\end{tabular}", "\\end{table}"]
        lines += [f"% {note}" for note in table.notes]
    return "\n".join(lines) + "\n"


def _csv_rows(tables: Sequence[Table], cells: Cells) -> list[tuple[Any, ...]]:
    rows = []
    for table in tables:
        for number, line in enumerate(table.lines):
            for figure in table.figures:
                found = cells[table.name, number, figure]
                mean, against = found.mean, found.difference
                ends = (mean.mean, mean.low, mean.high, mean.count) if mean.count else ("",) * 4
                apart: tuple[Any, ...] = ("",) * 4
                if against is not None and against.count:
                    apart = (against.mean, against.low, against.high, against.count)
                rows.append((table.name, line.row, line.subject, figure, *ends, *apart))
    return rows


def _object_rows(results: Mapping[str, Pages]) -> list[tuple[Any, ...]]:
    """Every figure of every view: what the tables' means are of."""
    rows: list[tuple[Any, ...]] = []
    for row, pages in results.items():
        for sample, page in pages.items():
            for view in page["views"]:
                where = (view["part"], view["subject"], view["light"], view["azimuth_deg"])
                rows += [(row, *sample, *where, f, v) for f, v in view["figures"].items()]
            parts = [("agreement", of, found) for of, found in page["agreement"].items()]
            parts += [(p, ASSET, page.get(p, {})) for p in ("surface", "capture", "cost")]
            for part, of, found in parts:
                rows += [(row, *sample, part, of, "", "", f, v) for f, v in found.items()]
    return rows


def _number(value: float, digits: int, *, sign: str = "") -> str:
    # Adding zero takes the sign of a rounded -0.
    return f"{round(value, digits) + 0.0:{sign}.{digits}f}" if math.isfinite(value) else ABSENT


def _escaped(text: str) -> str:
    return "".join(SPECIAL.get(character, character) for character in text)


def _write_csv(file: Path, columns: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
    temporary = file.with_suffix(".tmp")
    with temporary.open("w", newline="") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(columns)
        writer.writerows(rows)
    temporary.replace(file)


def _replace(file: Path, text: str) -> None:
    temporary = file.with_suffix(".tmp")
    temporary.write_text(text)
    temporary.replace(file)
