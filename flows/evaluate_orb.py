"""The table by the rules of Stanford-ORB: official rows, and what they hide.

A capture without an asset counts with what the benchmark's script tells of white pictures; how
many there are stands beside every official row.
"""

from collections.abc import Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING

from flows.evaluate_tables import (
    ASSET,
    NOVEL,
    RELIT,
    Page,
    Sample,
    Table,
    Values,
    lines_of,
    mean_views,
)

if TYPE_CHECKING:
    from stages.score_summary import BenchmarkScore

NAME, TITLE = "stanford-orb", "By the rules of Stanford-ORB"
OFFICIAL, ORB_ROWS = "official", ("official", "foreground", "unscaled")
# Part of the views and prefix of the figures, by what a line is called.
TASKS = {
    "relit": (RELIT, "orb"),
    "novel views": (NOVEL, "orb"),
    "albedo": (NOVEL, "orb.albedo"),
}
FIGURES = ("psnr_hdr_db", "psnr_ldr_db", "ssim", "lpips", "normal", "depth", "shape")
FAILED = "failed"
WORST, TAIL = "worst capture", "tenth percentile"
ALL: Sample = ("(all)", 0)  # of what is no mean over objects

# Scores of what has no asset; None where there is not even a truth to hold white against.
Missing = Mapping[Sample, Page | None]


def orb_table(
    results: Mapping[str, Mapping[Sample, Page]],
    missing: Mapping[str, Missing],
    notes: Sequence[str],
) -> Table | None:
    """The table; None where no capture was scored.

    Args:
        results: by row, then by capture and seed.
        missing: the same of captures that failed.
        notes: below it, before what is told of each row.
    """
    scored = {
        row: {**pages, **{s: p for s, p in missing.get(row, {}).items() if p is not None}}
        for row, pages in results.items()
    }
    figures = {row: _figures(pages) for row, pages in scored.items()}
    lines = lines_of(
        {row: _with_tails(found, len(missing.get(row, {}))) for row, found in figures.items()}
    )
    if not lines:
        return None
    told = [
        _told(row, found, len({**scored[row], **missing.get(row, {})}), missing.get(row, {}))
        for row, found in figures.items()
        if found
    ]
    known = [f for f in (*FIGURES, FAILED) if any(line.figures.get(f) for line in lines)]
    return Table(NAME, TITLE, tuple(known), tuple(lines), (*notes, *told))


def _figures(pages: Mapping[Sample, Page]) -> dict[str, dict[str, Values]]:
    """Figures of each capture, by line."""
    lines: dict[str, dict[str, Values]] = {}
    for task, (part, prefix) in TASKS.items():
        for row in ORB_ROWS:
            take = partial(_named, part=part, prefix=f"{prefix}.{row}.")
            lines[f"{task}, {row}"] = _collected(pages, {s: take(p) for s, p in pages.items()})
    geometry = {
        sample: _named(page, NOVEL, "orb.geometry.") | page.get("capture", {})
        for sample, page in pages.items()
    }
    lines[f"geometry, {OFFICIAL}"] = _collected(pages, geometry)
    return {name: figures for name, figures in lines.items() if figures}


def _named(page: Page, part: str, prefix: str) -> dict[str, float]:
    means = mean_views(page, (part,), ASSET)
    return {n.removeprefix(prefix): v for n, v in means.items() if n.startswith(prefix)}


def _collected(
    pages: Mapping[Sample, Page], found: Mapping[Sample, Mapping[str, float]]
) -> dict[str, Values]:
    figures = {f: {s: found[s][f] for s in pages if f in found[s]} for f in FIGURES}
    return {name: values for name, values in figures.items() if values}


def _with_tails(lines: dict[str, dict[str, Values]], failed: int) -> dict[str, dict[str, Values]]:
    """Each official line with its count of failures, its worst capture and its bad tail."""
    if not lines:
        return {}
    spreads = _spreads(lines).rows
    with_tails: dict[str, dict[str, Values]] = {}
    for name, figures in lines.items():
        if not name.endswith(OFFICIAL):
            with_tails[name] = figures
            continue
        found = spreads[name]
        with_tails[name] = figures | {FAILED: {ALL: float(failed)}}
        # One capture each, which the paired difference of two rows needs to be the same.
        worst = {f: {(s.worst_capture, 0): s.worst} for f, s in found.items()}
        with_tails[f"{name}, {WORST}"] = worst
        with_tails[f"{name}, {TAIL}"] = {f: {ALL: s.p10} for f, s in found.items()}
    return with_tails


def _spreads(lines: Mapping[str, Mapping[str, Values]]) -> "BenchmarkScore":
    from stages.score_summary import benchmark, by_object

    means = {
        name: {figure: by_object(values) for figure, values in figures.items()}
        for name, figures in lines.items()
    }
    return benchmark(means, ())


def _told(row: str, lines: Mapping[str, Mapping[str, Values]], every: int, missing: Missing) -> str:
    """How many are missing of every one, and which captures are worst."""
    unknown = [name for (name, _), page in missing.items() if page is None]
    told = f"{row}: {len(missing)} of {every} without an asset"
    if missing:
        names = ", ".join(dict.fromkeys(name for name, _ in missing))
        told += f" ({names}), scored as white pictures"
    if unknown:
        told += f" but for {', '.join(dict.fromkeys(unknown))}, whose truth cannot be read"
    spreads = _spreads(lines).rows
    worst = [
        f"{name.removesuffix(f', {OFFICIAL}')} {next(iter(figures.values())).worst_capture}"
        for name, figures in spreads.items()
        if name.endswith(OFFICIAL)
    ]
    return f"{told}. Worst by the first figure: {', '.join(worst)}."
