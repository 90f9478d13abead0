"""`svim3d chart`: what presets and single settings cost, and what they give; the front of both."""

import argparse
import json
import os
import platform
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from rich.console import Console

from flows.cases import Outcome, Results, run_cases
from flows.chart_front import AXES, PANELS, RELIGHT, State, ladder
from flows.chart_knobs import KNOBS, SCALES, Knob, quick
from flows.chart_page import mean_range, write_page
from flows.chart_points import PRESET, Bench, Case, Point, points_of
from flows.chart_table import (
    Summary,
    conclusions,
    markdown,
    rows_of,
    settings_of,
    summarised,
    write_cases,
    write_csv,
    write_presets,
)
from flows.stopping import interrupt_on_stop
from stages.errors import InputError
from svim3d.charts import Mark, Panel, draw_panels, is_available

DONE, FAILED = 0, 1
INVENTED_PX = 128  # side of views that are rendered here, unless --size says otherwise
WRITTEN_EVERY_S = 300.0  # the pages, while cases are run
QUICK_PRESETS = ("standard",)
WARM_UP = Point(
    "warm-up",
    "",
    "compiles the kernels, so that no case pays for them",
    "standard",
    (
        *("env_preopt.steps=2", "nerf.steps=8", "nerf.rays_per_step=256", "dmtet.steps=2"),
        *("nerf.grid_nodes=[16, 24]", "nerf.grid_shares=[0.0, 0.5]", "dmtet.cells=16"),
        *("uv_bake.texture_size=64", "uv_bake.max_faces=500", "uv_bake.fit_iterations=1"),
    ),
)


def chart(options: argparse.Namespace) -> int:
    """Measure what is asked for, and draw; the exit code is 1 where a point failed."""
    console = Console()
    _check(options)
    orbits = _orbits(options)
    points = _points(options, _given_px(orbits, options))
    if options.list:
        for point in points:
            line = f"{point.name}: {point.about}: {settings_of(point)}"
            console.print(line, highlight=False, markup=False, soft_wrap=True)
        return DONE
    if not is_available():
        raise InputError("the chart is drawn by matplotlib: pip install 'svim3d[chart]'")
    interrupt_on_stop()
    bench = Bench(orbits, options.size, options.photos, options.store, options.limit)
    told = _told(options, bench)
    results: dict[Case, Mapping[str, Any]] = {}
    written_s = time.monotonic()
    for case, result in _measure(points, bench, options, console):
        results[case] = result
        if time.monotonic() - written_s > WRITTEN_EVERY_S:
            _write(summarised(points, list(orbits), results), told, options.output)
            written_s = time.monotonic()
    summary = summarised(points, list(orbits), results)
    _write(summary, told, options.output)
    write_cases(results, options.output / "cases.csv")
    for line in conclusions(summary):
        console.print(line.removeprefix("- "), highlight=False, markup=False, soft_wrap=True)
    console.print(
        f"{options.output / 'chart.html'}: {len(summary.figures)} points",
        highlight=False,
        soft_wrap=True,
    )
    return FAILED if summary.failures else DONE


def _check(options: argparse.Namespace) -> None:
    for name in ("invented", "repeats", "jobs"):
        if getattr(options, name) < 1:
            raise InputError(f"--{name} {getattr(options, name)}: wanted 1 or more")
    if options.size is not None and options.size < 16:
        raise InputError(f"--size {options.size}: wanted 16 pixels or more")
    if options.size is not None and options.photos:
        raise InputError("--size is for views, --photos are taken as they are; drop one of the two")
    for orbit in options.orbit:
        if not (orbit / "orbit.json").is_file():
            raise InputError(
                f"wanted orbit folders with their truth, but {orbit} has no orbit.json"
            )
    names = [orbit.resolve().name for orbit in options.orbit]
    if len(set(names)) < len(names):
        raise InputError(f"wanted orbit folders of different names, got {', '.join(names)}")


def _orbits(options: argparse.Namespace) -> dict[str, Path]:
    """Folders by name; invented ones are rendered if they are not there."""
    if options.orbit:
        return {orbit.resolve().name: orbit for orbit in options.orbit}
    from stages.invented_orbit import invented_orbit

    parent = options.output / "orbits"
    size = options.size or INVENTED_PX
    return {f"invented-{n}": invented_orbit(n, parent, size) for n in range(options.invented)}


def _given_px(orbits: Mapping[str, Path], options: argparse.Namespace) -> int | None:
    """Longest side of the given views, pixels; None where no orbit tells."""
    sides = [options.size] if options.size else []
    for orbit in orbits.values():
        camera = json.loads((orbit / "orbit.json").read_text()).get("camera", {})
        sides.append(max(int(camera.get("width", 0)), int(camera.get("height", 0))))
    return min((side for side in sides if side > 0), default=None)


def _points(options: argparse.Namespace, given_px: int | None) -> list[Point]:
    presets = list(QUICK_PRESETS) if options.quick else options.presets
    scales = options.scales if options.scales is not None else () if options.quick else SCALES
    return points_of(
        options.base,
        presets,
        chosen_knobs(options.knobs, is_quick=options.quick),
        scales=scales,
        changes=options.set,
        given_px=given_px,
        photos=options.photos,
    )


def chosen_knobs(wanted: Sequence[str] | None, *, is_quick: bool = False) -> list[Knob]:
    """Knobs by name, with all values or those that are named.

    Raises:
        InputError: there is no such knob or value.
    """
    if wanted is None:
        return quick(KNOBS) if is_quick else list(KNOBS)
    known = {knob.name: knob for knob in KNOBS}
    chosen = []
    for text in wanted:
        name, _, labels = text.partition(":")
        if name not in known:
            raise InputError(f"--knobs {name}: wanted some of {', '.join(known)}")
        knob = known[name]
        turns = {turn.label: turn for turn in knob.turns}
        kept = labels.split("+") if labels else list(turns)
        if unknown := [label for label in kept if label not in turns]:
            raise InputError(
                f"--knobs {text}: {name} has no value {unknown[0]}; it has {', '.join(turns)}"
            )
        chosen.append(replace(knob, turns=tuple(turns[label] for label in kept)))
    return chosen


def _measure(
    points: Sequence[Point], bench: Bench, options: argparse.Namespace, console: Console
) -> Iterator[tuple[Case, Mapping[str, Any]]]:
    """Results of all cases as they come: those that are known first, then point by point."""
    by_name = {point.name: point for point in points}
    # Point by point, the base first: all others are held against it. Its repeats come last.
    cases = [Case(point.name, orbit, 0) for point in points for orbit in bench.orbits]
    repeats = range(1, options.repeats)
    cases += [Case(points[0].name, orbit, seed) for seed in repeats for orbit in bench.orbits]
    kept = Results[Case](options.output, any_code=options.keep)
    keys = {case: bench.key(by_name[case.point], case) for case in cases}
    known = {case: _settled(kept.get(case, keys[case])) for case in cases}
    waiting = [case for case in cases if known[case] is None]
    console.print(f"{len(cases)} cases, {len(cases) - len(waiting)} known", highlight=False)
    for case, result in known.items():
        if result is not None:
            yield case, result
    if not waiting:
        return
    _warm_up(bench, console)
    start = time.monotonic()
    results = run_cases(waiting, lambda c: bench.start(by_name[c.point], c), options.jobs)
    for done, (case, result) in enumerate(results, 1):
        left_s = (time.monotonic() - start) / done * (len(waiting) - done)
        console.print(
            f"[{done}/{len(waiting)}] {case.name}: {_in_a_line(result)}, "
            f"{left_s / 60:.0f} min left",
            highlight=False,
            markup=False,
            soft_wrap=True,
        )
        yield case, kept.put(case, keys[case], result)


def _settled(result: Mapping[str, Any] | None) -> Mapping[str, Any] | None:
    """A result that another try would not change: memory and time may suffice the next time."""
    is_passing = result is not None and result["outcome"] in (Outcome.CRASHED, Outcome.TOO_LONG)
    return None if is_passing else result


def _warm_up(bench: Bench, console: Console) -> None:
    """Let kernels be compiled and kept, and prefilters computed, before anything is measured."""
    case = Case(WARM_UP.name, next(iter(bench.orbits)), 0)
    for _, result in run_cases([case], lambda c: bench.start(WARM_UP, c)):
        console.print(f"warm-up: {_in_a_line(result)}", highlight=False, markup=False)


def _in_a_line(result: Mapping[str, Any]) -> str:
    if result["outcome"] == Outcome.ASSET:
        costs, figures = result["costs"], result["figures"]
        return f"{costs['cpu_s']:.1f} CPU s, {figures[RELIGHT.name]:+.2f} dB to ideal"
    lines = str(result.get("error", "")).strip().splitlines()
    return f"{result['outcome']}: {lines[-1] if lines else ''}"


def _told(options: argparse.Namespace, bench: Bench) -> list[str]:
    """How it was measured."""
    start = "photos" if options.photos else "views"
    size = f" of {options.size} px" if options.size else ""
    return [
        f"`svim3d chart`: {start}{size} of {', '.join(bench.orbits)}; base `{options.base}`, one "
        "knob turned at a time. CPU seconds are those of the stages, kernels compiled; figures are "
        "taken at cameras that were not given, relighting under two lights that no view shows.",
        f"{time.strftime('%Y-%m-%d')}, {os.cpu_count()} cores, {platform.platform()}.",
    ]


def _write(summary: Summary, told: Sequence[str], folder: Path) -> None:
    """All pages, as far as things are known."""
    if not summary.figures:
        return
    rows = rows_of(summary)
    write_csv(rows, folder / "chart.csv")
    (folder / "chart.md").write_text(markdown(summary, rows, told))
    panels = panels_of(summary, rows)
    title = f"Speed against accuracy: means over {', '.join(summary.orbits)}"
    (folder / "chart.png").write_bytes(draw_panels(panels, title, "png"))
    drawn = draw_panels(panels, title, "svg")
    (folder / "chart.svg").write_bytes(drawn)
    write_page(summary, rows, told, drawn, folder / "chart.html")
    write_presets(summary, folder)


def panels_of(summary: Summary, rows: Sequence[Mapping[str, Any]]) -> list[Panel]:
    """What is drawn: means over orbits, which paired differences add up to."""
    axes = {axis.name: axis for axis in AXES}
    panels = []
    for cost, quality in PANELS:
        marks = []
        steps = ladder(summary.figures, cost, quality, summary.noise)
        for row in rows:
            name = str(row["point"])
            state = summary.panels[cost.name, quality.name][name].state
            point = summary.points[name]
            low, high = mean_range(summary, row, quality)
            marks.append(
                Mark(
                    name=name,
                    group=point.group,
                    x=summary.mean(name, cost) * cost.scale,
                    y=summary.mean(name, quality) * quality.scale,
                    y_range=(low * quality.scale, high * quality.scale),
                    is_front=state is State.FRONT,
                    is_named=name in steps or point.group == PRESET,
                )
            )
        marks.sort(key=lambda mark: (mark.group != PRESET, not mark.is_named, mark.x))
        is_log = axes[quality.name].is_ratio
        panels.append(Panel(cost.title, quality.title, marks, is_log, quality.more_is_better))
    return panels
