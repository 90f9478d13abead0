"""`svim3d stability`: hazards where methods of this kind fail, swept by severity and seed."""

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from rich.table import Table

from flows.cases import Results
from flows.stability_cases import BASELINE, OURS, Case, Settings, code_digest, run_case
from flows.stability_report import write_page
from flows.stability_table import (
    FORBIDDEN,
    Judged,
    Row,
    breakdowns,
    cells,
    judge_all,
    rows_of,
    write_csv,
)
from flows.stopping import interrupt_on_stop
from stages.errors import InputError

SOUND, FORBIDDEN_FOUND = 0, 1
REPORT, TABLE = "stability.html", "stability.csv"


@dataclass(frozen=True)
class Wanted:
    """A hazard and the part of it that is asked for."""

    name: str
    about: str
    unit: str
    severities: tuple[float, ...]
    harmless: float
    notes: tuple[str, ...]
    variants: tuple[str, ...]
    has_baseline: bool


def stability(options: argparse.Namespace) -> int:
    """Run what is asked for, and report; the exit code is 1 where something must not be."""
    wanted = _wanted(options)
    console = Console()
    if options.list:
        for one in wanted:
            console.print(f"{one.name}: {one.about}", highlight=False, markup=False)
            console.print(f"    {one.unit}: {_listed(one.severities)}", highlight=False)
        return SOUND
    interrupt_on_stop()
    settings = Settings(
        options.preset,
        tuple(options.set),
        options.size,
        options.views,
        options.store,
        options.limit,
    )
    cases = list(cases_of(wanted, options.seeds, baseline=options.baseline))
    results = _run(cases, settings, options, console)
    judged = judge_all(
        results, {w.name: w.notes for w in wanted}, {w.name: w.harmless for w in wanted}
    )
    rows = rows_of(judged)
    write_csv(rows, options.output / TABLE)
    write_page(
        judged,
        rows,
        {w.name: (w.about, w.unit) for w in wanted},
        _told(settings, options),
        options.output / REPORT,
    )
    _print(rows, judged, options.output, console)
    wrong = any(one.verdict in FORBIDDEN and one.case.way == OURS for one in judged)
    return FORBIDDEN_FOUND if wrong else SOUND


def _listed(severities: Sequence[float]) -> str:
    return ", ".join(f"{severity:g}" for severity in severities)


def _wanted(options: argparse.Namespace) -> list[Wanted]:
    """The hazards that are asked for.

    Raises:
        InputError: there is no such hazard or variant, or a number out of bounds.
    """
    from stages.hazard_trial import HAZARDS

    unknown = [name for name in options.hazard if name not in HAZARDS]
    if unknown:
        raise InputError(f"hazard {unknown[0]}: wanted one of {', '.join(HAZARDS)}")
    for name, value, least in (
        ("--seeds", options.seeds, 1),
        ("--size", options.size, 32),
        ("--views", options.views, 3),
    ):
        if value < least:
            raise InputError(f"{name} {value}: wanted {least} or more")
    chosen = []
    for name in options.hazard or HAZARDS:
        hazard = HAZARDS[name]
        variants = tuple(
            v for v in hazard.variants if options.variants in (None, []) or v in options.variants
        )
        if not variants and options.hazard:
            raise InputError(f"{name}: wanted variants among {', '.join(hazard.variants)}")
        chosen.append(
            Wanted(
                name=name,
                about=hazard.about,
                unit=hazard.unit,
                severities=_nearest(hazard.severities, options.severities),
                harmless=hazard.severities[0],
                notes=hazard.notes,
                variants=variants or hazard.variants,
                has_baseline=hazard.is_perturbation,
            )
        )
    return chosen


def _nearest(severities: Sequence[float], shares: Sequence[float] | None) -> tuple[float, ...]:
    """Of rising severities the harmless one and those at shares of their number."""
    if shares is None:
        return tuple(severities)
    if not all(0.0 <= share <= 1.0 for share in shares):
        raise InputError(f"--severities {_listed(shares)}: wanted shares from 0 to 1")
    chosen = {0, *(round(share * (len(severities) - 1)) for share in shares)}
    return tuple(severities[index] for index in sorted(chosen))


def cases_of(wanted: Sequence[Wanted], seeds: int, *, baseline: bool) -> Sequence[Case]:
    """All cases, seed by seed: the first seed already fills the whole table."""
    return [
        Case(one.name, variant, severity, seed, way)
        for seed in range(seeds)
        for one in wanted
        for variant in one.variants
        for severity in one.severities
        for way in ((OURS, BASELINE) if baseline and one.has_baseline else (OURS,))
    ]


def _run(
    cases: Sequence[Case], settings: Settings, options: argparse.Namespace, console: Console
) -> dict[Case, dict[str, object]]:
    """Results of all cases, those that are known as they are."""
    results = Results[Case](options.output, any_code=options.keep)
    code = code_digest()
    found = {}
    for number, case in enumerate(cases, 1):
        key = settings.key(case, code)
        known = results.get(case, key)
        found[case] = known or results.put(case, key, run_case(case, settings))
        state = "known" if known else f"{found[case].get('cpu_s', 0.0):.0f} CPU s"
        told = _in_a_line(found[case])
        console.print(
            f"[{number}/{len(cases)}] {case.name}: {told} ({state})",
            highlight=False,
            markup=False,
            soft_wrap=True,
        )
    return found


def _in_a_line(result: dict[str, object]) -> str:
    figures = result.get("figures")
    if isinstance(figures, dict) and "score_db" in figures:
        return f"{result['outcome']}, {figures['score_db']:.1f} dB"
    error = str(result.get("error", "")).strip().splitlines()
    return f"{result['outcome']}{f': {error[-1]}' if error else ''}"


def _told(settings: Settings, options: argparse.Namespace) -> list[str]:
    """How it was measured, for the report."""
    changed = f", with {' '.join(settings.overrides)}" if settings.overrides else ""
    return [
        f"svim3d stability, preset {settings.preset}{changed}: {settings.views} views of "
        f"{settings.size} x {settings.size} pixels, {options.seeds} seed(s) a severity; each case "
        "is a run of all stages in a process of its own.",
        "The score is the worse of two PSNR after AgX at cameras that were not given: under the "
        "light that was found, and under one that no view shows. A case fails if it loses more "
        "than 3 dB against the same object without its hazard, has no asset, is not watertight "
        "where it should be, lacks a hole, has an inner shell, or holds NaN. It is a silent wreck "
        "if it lost more than 3 dB and nobody is told.",
        "Pictures: two given views, then twice the truth beside the asset.",
    ]


def _print(rows: Sequence[Row], judged: Sequence[Judged], out: Path, console: Console) -> None:
    """The table, in short, and what must not be."""
    table = Table(box=None, pad_edge=False)
    for title in ("hazard", "way", "severity", "failed", "95 %", "p50 dB", "worst", "outcomes"):
        table.add_column(title, justify="left" if title in ("hazard", "way") else "right")
    breaks = breakdowns(rows)
    for row in rows:
        page = cells(row, breaks[row.hazard, row.variant, row.way])
        table.add_row(
            f"{row.hazard} {row.variant}".strip(),
            row.way,
            f"{row.severity:g}",
            f"{row.failures}/{len(row.cases)}",
            f"{page['low']:.0%}-{page['high']:.0%}",
            f"{page['p50_db']:.1f}",
            f"{page['worst_tenth_db']:.1f}",
            ", ".join(dict.fromkeys(str(one.verdict) for one in row.cases)),
        )
    console.print(table)
    wrong = [one for one in judged if one.verdict in FORBIDDEN and one.case.way == OURS]
    console.print(
        f"{out / REPORT}: {len(judged)} cases, {len(wrong)} that must not be",
        highlight=False,
        soft_wrap=True,
    )
