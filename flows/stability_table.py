"""From results of cases to verdicts and rows: what failed, how often, from which severity on."""

import csv
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

from flows.cases import Outcome
from flows.stability_cases import BASELINE, OURS, Case
from flows.stability_figures import breakdown, quantile, wilson, worst_tenth

TOLERATED_DB = 3.0  # below the same object without its hazard; more is a failure
# What events of any run say, and nothing about a hazard.
ROUTINE = frozenset({"lod", "material", "resumed"})
COLUMNS = (
    *("hazard", "variant", "way", "severity", "cases", "failures", "rate", "low", "high"),
    *("p5_db", "p50_db", "p95_db", "worst_tenth_db", "assets", "noted", "refused", "forbidden"),
    "breakdown",
)


class Verdict(StrEnum):
    """What a case came to; the last four must not happen."""

    ASSET = "asset"
    NOTED = "asset with a note"
    REFUSED = "clear error"
    SILENT = "silent wreck"
    NOT_FINITE = "NaN"
    CRASHED = "crash"
    TOO_LONG = "too long"


FORBIDDEN = (Verdict.SILENT, Verdict.NOT_FINITE, Verdict.CRASHED, Verdict.TOO_LONG)


@dataclass(frozen=True)
class Judged:
    """A case with its verdict.

    Attributes:
        case: what was run.
        verdict: what it came to.
        has_failed: whether the asset is not there, not whole, or too far from the truth.
        score_db: of its worse figure; NaN without an asset or where there is none.
        lost_db: against the same object without the hazard.
        notes: what an operator was told of the hazard.
        result: all that was measured.
    """

    case: Case
    verdict: Verdict
    has_failed: bool
    score_db: float
    lost_db: float
    notes: tuple[str, ...]
    result: Mapping[str, Any]


@dataclass(frozen=True)
class Row:
    """All seeds of a severity of a hazard, by one way."""

    hazard: str
    variant: str
    way: str
    severity: float
    cases: tuple[Judged, ...]

    @property
    def failures(self) -> int:
        """How many failed."""
        return sum(case.has_failed for case in self.cases)

    @property
    def rate(self) -> float:
        """Share that failed."""
        return self.failures / len(self.cases)

    @property
    def interval(self) -> tuple[float, float]:
        """Wilson's, of 95 %."""
        return wilson(self.failures, len(self.cases))

    @property
    def scores(self) -> list[float]:
        """Of those with an asset."""
        return [case.score_db for case in self.cases if math.isfinite(case.score_db)]

    def count(self, *verdicts: Verdict) -> int:
        """How many came to these."""
        return sum(case.verdict in verdicts for case in self.cases)


def judge_all(
    results: Mapping[Case, Mapping[str, Any]],
    notes: Mapping[str, Sequence[str]],
    harmless: Mapping[str, float],
) -> list[Judged]:
    """Verdicts of all cases.

    Args:
        results: as they were kept.
        notes: kinds of events that tell of each hazard.
        harmless: of each hazard, the severity that the others are held against.
    """
    references: dict[tuple[str, str, int], float] = {}
    for way in (BASELINE, OURS):  # ours counts where both are there
        for case, result in results.items():
            if case.way == way and case.severity == harmless[case.hazard]:
                references[case.hazard, case.variant, case.seed] = _score(result)
    return [
        _judged(
            case,
            result,
            references.get((case.hazard, case.variant, case.seed), math.nan),
            notes[case.hazard],
        )
        for case, result in results.items()
    ]


def _score(result: Mapping[str, Any]) -> float:
    return float(result.get("figures", {}).get("score_db", math.nan))


def _judged(
    case: Case, result: Mapping[str, Any], reference: float, kinds: Sequence[str]
) -> Judged:
    """A case held against its reference."""
    figures = result.get("figures", {})
    told = tuple(
        f"{stage}: {message}"
        for stage, kind, message in result.get("events", ())
        if kind in kinds or (kind not in ROUTINE and kind == "note")
    )
    score = _score(result)
    lost = reference - score
    wreck = lost > TOLERATED_DB
    whole = _is_whole(figures)
    repeats = figures.get("equal_bytes", True)
    if result["outcome"] == Outcome.ASSET:
        verdict = Verdict.NOTED if told else Verdict.ASSET
        if not figures.get("finite", True):
            verdict = Verdict.NOT_FINITE
        elif (wreck or not figures.get("is_whole", True) or not repeats) and not told:
            verdict = Verdict.SILENT
    else:
        verdict = {
            Outcome.REFUSED: Verdict.REFUSED,
            Outcome.TOO_LONG: Verdict.TOO_LONG,
        }.get(Outcome(result["outcome"]), Verdict.CRASHED)
    has_failed = verdict not in (Verdict.ASSET, Verdict.NOTED) or wreck or not whole or not repeats
    return Judged(case, verdict, has_failed, score, lost, told, result)


def _is_whole(figures: Mapping[str, Any]) -> bool:
    """Whether the surface, or the atlas, is what it should be, as far as that is known."""
    is_closed = figures.get("watertight", True) or not figures.get("should_be_watertight", True)
    true_euler = figures.get("true_euler")
    has_its_holes = true_euler is None or figures["euler"] == true_euler
    no_shells = not figures.get("cavities")
    return bool(figures.get("is_whole", True) and is_closed and has_its_holes and no_shells)


def rows_of(judged: Iterable[Judged]) -> list[Row]:
    """Cases by hazard, variant, way and severity, in order of appearance, severities rising."""
    groups: dict[tuple[str, str, str], dict[float, list[Judged]]] = {}
    for one in judged:
        case = one.case
        group = groups.setdefault((case.hazard, case.variant, case.way), {})
        group.setdefault(case.severity, []).append(one)
    return [
        Row(*key, severity, tuple(group[severity]))
        for key, group in groups.items()
        for severity in sorted(group)
    ]


def breakdowns(rows: Iterable[Row]) -> dict[tuple[str, str, str], float | None]:
    """First severity with more failures than not, by hazard, variant and way."""
    rates: dict[tuple[str, str, str], dict[float, float]] = {}
    for row in rows:
        rates.setdefault((row.hazard, row.variant, row.way), {})[row.severity] = row.rate
    return {key: breakdown(by_severity) for key, by_severity in rates.items()}


def cells(row: Row, breaks_at: float | None) -> dict[str, Any]:
    """A row by column."""
    low, high = row.interval
    p5, p50, p95 = (quantile(row.scores, share) for share in (0.05, 0.5, 0.95))
    return {
        "hazard": row.hazard,
        "variant": row.variant,
        "way": row.way,
        "severity": row.severity,
        "cases": len(row.cases),
        "failures": row.failures,
        "rate": row.rate,
        "low": low,
        "high": high,
        "p5_db": p5,
        "p50_db": p50,
        "p95_db": p95,
        "worst_tenth_db": worst_tenth(row.scores),
        "assets": row.count(Verdict.ASSET),
        "noted": row.count(Verdict.NOTED),
        "refused": row.count(Verdict.REFUSED),
        "forbidden": row.count(*FORBIDDEN),
        "breakdown": "" if breaks_at is None else breaks_at,
    }


def write_csv(rows: Sequence[Row], file: Path) -> None:
    """All rows as a table."""
    breaks = breakdowns(rows)
    with file.open("w", newline="") as stream:
        writer = csv.DictWriter(stream, COLUMNS, lineterminator="\n")
        writer.writeheader()
        for row in rows:
            page = cells(row, breaks[row.hazard, row.variant, row.way])
            writer.writerow({n: f"{v:.4g}" if isinstance(v, float) else v for n, v in page.items()})


def confusion(judged: Iterable[Judged]) -> dict[tuple[bool, bool], int]:
    """How often an object of (metal or not) came out as (metal or not)."""
    counts = {(was, came): 0 for was in (False, True) for came in (False, True)}
    for one in judged:
        figures = one.result.get("figures", {})
        if one.case.hazard == "gloss-or-metal" and "is_metal" in figures:
            counts[bool(figures["was_metal"]), bool(figures["is_metal"])] += 1
    return counts
