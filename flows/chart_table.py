"""From results of cases to what is told of each point: a table, and files of settings."""

import csv
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

import yaml

from flows.cases import Outcome
from flows.chart_front import (
    AXES,
    COMPARED,
    CPU,
    PANELS,
    QUALITIES,
    RELIGHT,
    Axis,
    Figures,
    Standing,
    State,
    difference,
    knee,
    ladder,
    mean_badness,
    repeat_noise,
    standings,
)
from flows.chart_points import Case, Point
from flows.config import ABOUT, PipelineConfig

FAST, BALANCED, BEST = "fast", "balanced", "best"


@dataclass(frozen=True)
class Summary:
    """What is known of all points.

    Attributes:
        points: all of them by name, the base first.
        base: name of the point that others are held against.
        orbits: names.
        figures: of points that made an asset of each orbit.
        failures: of other points that are known: what went wrong, orbit by orbit.
        noise: of each axis, from the base's repeats.
        panels: standings by names of cost and quality.
        overall: standings by CPU seconds and all qualities at once.
    """

    points: Mapping[str, Point]
    base: str
    orbits: Sequence[str]
    figures: Figures
    failures: Mapping[str, str]
    noise: Mapping[str, float]
    panels: Mapping[tuple[str, str], Mapping[str, Standing]]
    overall: Mapping[str, Standing]

    @property
    def steps(self) -> list[str]:
        """Points that a preset can be made of, each clearly better relit than the one before."""
        kept = {n: f for n, f in self.figures.items() if self.points[n].is_preset}
        return ladder(kept, CPU, RELIGHT, self.noise)

    @property
    def recommended(self) -> dict[str, str]:
        """Points for the presets that are written."""
        steps = self.steps
        if not steps:
            return {}
        return {
            FAST: steps[0],
            BALANCED: knee(self.figures, steps, CPU, RELIGHT),
            BEST: steps[-1],
        }

    def level(self, point: str, axis: Axis) -> float:
        """Median over orbits."""
        return median(values[axis.name] for values in self.figures[point].values())

    def mean(self, point: str, axis: Axis) -> float:
        """Mean over orbits, geometric where factors count; charts are drawn of it."""
        return axis.value(mean_badness(self.figures, point, axis))


def summarised(
    points: Sequence[Point], orbits: Sequence[str], results: Mapping[Case, Mapping[str, Any]]
) -> Summary:
    """What the results say; the first point is the base."""
    figures: dict[str, dict[str, dict[str, float]]] = {}
    failures: dict[str, str] = {}
    for point in points:
        found = {o: results.get(Case(point.name, o, 0)) for o in orbits}
        known = {o: result for o, result in found.items() if result is not None}
        wrong = {o: r for o, r in known.items() if r["outcome"] != Outcome.ASSET}
        if wrong:
            failures[point.name] = "; ".join(f"{o}: {_reason(r)}" for o, r in wrong.items())
        elif len(known) == len(orbits):
            figures[point.name] = {o: _values(result) for o, result in known.items()}
    base = points[0].name
    seeds: dict[str, list[dict[str, float]]] = {orbit: [] for orbit in orbits}
    for case, result in results.items():
        if case.point == base and result["outcome"] == Outcome.ASSET and case.orbit in seeds:
            seeds[case.orbit].append(_values(result))
    noise = {axis.name: repeat_noise(seeds.values(), axis) for axis in AXES}
    return Summary(
        points={point.name: point for point in points},
        base=base,
        orbits=orbits,
        figures=figures,
        failures=failures,
        noise=noise,
        panels={(c.name, q.name): standings(figures, (c, q), noise) for c, q in PANELS},
        overall=standings(figures, COMPARED, noise),
    )


def _values(result: Mapping[str, Any]) -> dict[str, float]:
    known = {**result["costs"], **result["figures"]}
    return {axis.name: float(known[axis.name]) for axis in AXES}


def _reason(result: Mapping[str, Any]) -> str:
    lines = str(result.get("error", "")).strip().splitlines()
    return f"{result['outcome']}{f' ({lines[-1]})' if lines else ''}"


def rows_of(summary: Summary) -> list[dict[str, Any]]:
    """A row for each point that is known, from cheap to dear."""
    known = sorted(summary.figures, key=lambda name: mean_badness(summary.figures, name, CPU))
    return [_row(summary, name) for name in known]


def _row(summary: Summary, name: str) -> dict[str, Any]:
    point = summary.points[name]
    row: dict[str, Any] = {"point": name, "group": point.group, "orbits": len(summary.orbits)}
    row |= {axis.name: summary.level(name, axis) for axis in AXES}
    for axis in AXES if summary.base in summary.figures else ():
        apart = difference(summary.figures, name, summary.base, axis)
        ends = sorted((axis.change(apart.low), axis.change(apart.high)))
        row[f"{axis.name}_change"] = axis.change(apart.mean)
        row[f"{axis.name}_change_low"], row[f"{axis.name}_change_high"] = ends
    standing = summary.overall[name]
    row |= {"overall": str(standing.state), "overall_by": standing.by}
    for quality in QUALITIES:
        standing = summary.panels[CPU.name, quality.name][name]
        row[f"{quality.name}_standing"] = str(standing.state)
        row[f"{quality.name}_by"] = standing.by
    row["settings"] = settings_of(point)
    return row


def settings_of(point: Point) -> str:
    """What a point is, as a command line would say it."""
    given = [f"{point.views} views"] if point.views else []
    given += [f"views of {point.size} px"] if point.size else []
    return " ".join([f"--preset {point.preset}", *(f"--set {o}" for o in point.overrides), *given])


def write_csv(rows: Sequence[Mapping[str, Any]], file: Path) -> None:
    """All rows with all columns."""
    names = list(dict.fromkeys(name for row in rows for name in row))
    with file.open("w", newline="") as stream:
        writer = csv.DictWriter(stream, names, lineterminator="\n")
        writer.writeheader()
        for row in rows:
            writer.writerow({n: f"{v:.6g}" if isinstance(v, float) else v for n, v in row.items()})


def write_cases(results: Mapping[Case, Mapping[str, Any]], file: Path) -> None:
    """Every case with all its costs and figures, and the CPU seconds of each stage."""
    lines = [
        {"point": case.point, "orbit": case.orbit, "seed": case.seed, "outcome": result["outcome"]}
        | dict(result.get("costs", {}))
        | dict(result.get("figures", {}))
        | {f"{stage}_cpu_s": value for stage, value in result.get("stage_cpu_s", {}).items()}
        for case, result in results.items()
    ]
    write_csv(lines, file)


def shown_level(axis: Axis, value: float) -> str:
    """A value in a table."""
    return f"{value * axis.scale:.{axis.digits}f}"


def shown_change(axis: Axis, row: Mapping[str, Any], *, with_interval: bool = True) -> str:
    """A difference to the base in a table, with its interval."""
    mean, low, high = (row.get(f"{axis.name}_change{end}") for end in ("", "_low", "_high"))
    if mean is None or low is None or high is None or math.isnan(mean):
        return "-"
    if axis.is_ratio:
        text, ends = f"{mean:+.0%}", f"{low:+.0%}, {high:+.0%}"
    else:
        text, ends = f"{mean:+.{axis.digits}f}", f"{low:+.{axis.digits}f}, {high:+.{axis.digits}f}"
    return f"{text} [{ends}]" if with_interval else text


def stands(state: str, by: str) -> str:
    """Where a point stands, in words, and by which other point."""
    return f"{state} by {by}" if state == State.DOMINATED else f"{state}{f' of {by}' if by else ''}"


def markdown(summary: Summary, rows: Sequence[Mapping[str, Any]], told: Iterable[str]) -> str:
    """The page of tables."""
    levels = ["point", *(axis.title for axis in AXES), "stands"]
    changes = ["point", CPU.title, *(axis.title for axis in QUALITIES)]
    lines = ["# Speed against accuracy", "", *told, "", "Medians over orbits.", ""]
    lines += _table(
        levels,
        [
            [
                str(row["point"]),
                *(shown_level(axis, row[axis.name]) for axis in AXES),
                stands(row["overall"], row["overall_by"]),
            ]
            for row in rows
        ],
    )
    if summary.base in summary.figures:
        noise = ", ".join(
            f"{axis.title} {_shown_noise(axis, summary.noise[axis.name])}"
            for axis in COMPARED
            if summary.noise[axis.name] > 0.0
        )
        repeats = f"What repeats differ by: {noise}." if noise else "The base was not repeated."
        lines += [
            "",
            f"Paired differences to `{summary.base}`: means over orbits, with intervals of 95 % "
            f"(bootstrap over orbits). {repeats}",
            "",
            *_table(
                changes,
                [
                    [str(row["point"]), *(shown_change(axis, row) for axis in (CPU, *QUALITIES))]
                    for row in rows
                ],
            ),
        ]
    lines += ["", *conclusions(summary)]
    return "\n".join(lines) + "\n"


def _shown_noise(axis: Axis, noise: float) -> str:
    return f"{math.expm1(noise):.1%}" if axis.is_ratio else f"{noise:.{axis.digits}f}"


def _table(head: Sequence[str], body: Iterable[Sequence[str]]) -> list[str]:
    rule = f"|{'---|' * len(head)}"
    return [f"| {' | '.join(head)} |", rule, *(f"| {' | '.join(row)} |" for row in body)]


def conclusions(summary: Summary) -> list[str]:
    """What the figures come to, in lines of Markdown."""
    lines = [
        f"- dominated in all figures at once: `{name}`, by `{standing.by}`"
        for name, standing in summary.overall.items()
        if standing.state is State.DOMINATED
    ]
    for quality in QUALITIES:
        stand = summary.panels[CPU.name, quality.name]
        front = [name for name, standing in stand.items() if standing.state is State.FRONT]
        front.sort(key=lambda name: mean_badness(summary.figures, name, CPU))
        if front:
            lines.append(f"- front of {quality.title}: {', '.join(f'`{name}`' for name in front)}")
    lines += [
        f"- recommended, {role}: `{name}`: {settings_of(summary.points[name])}"
        for role, name in summary.recommended.items()
    ]
    lines += [f"- failed: `{name}`: {reason}" for name, reason in summary.failures.items()]
    missing = [n for n in summary.points if n not in summary.figures and n not in summary.failures]
    return lines + ([f"- not measured: {', '.join(missing)}"] if missing else [])


def write_presets(summary: Summary, folder: Path) -> list[Path]:
    """A file of settings for each recommended preset, that `--preset` reads."""
    files = []
    for role, name in summary.recommended.items():
        figures = ", ".join(
            f"{axis.title} {shown_level(axis, summary.level(name, axis))}" for axis in COMPARED
        )
        about = f"{name}; {figures}; medians of {', '.join(summary.orbits)}"
        page = {ABOUT: about, **changed_settings(summary.points[name].config)}
        file = folder / f"recommended-{role}.yaml"
        file.write_text(yaml.safe_dump(page, sort_keys=False, width=1000))
        files.append(file)
    return files


def changed_settings(config: PipelineConfig) -> dict[str, Any]:
    """What differs from the code's defaults, as a preset file has it."""
    ours, plain = (c.model_dump(mode="json") for c in (config, PipelineConfig()))
    page: dict[str, Any] = {"skip": sorted(config.skip)}
    for stage, settings in ours.items():
        if stage != "skip":
            changed = {n: v for n, v in settings.items() if v != plain[stage].get(n)}
            changed.pop("digests", None)  # read anew of the files
            page |= {stage: changed} if changed else {}
    return page
