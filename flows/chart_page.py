"""The chart as a page: one file with its data, pictures drawn by its own few lines of script.

Any two figures can be laid against each other; points answer to mouse and keyboard. Without
scripts the page shows the drawn picture and the tables.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from flows.chart_front import AXES, COSTS, QUALITIES, Axis
from flows.chart_table import Summary, conclusions, settings_of, shown_change, shown_level, stands


def write_page(
    summary: Summary,
    rows: Sequence[Mapping[str, Any]],
    told: Sequence[str],
    drawn: bytes,
    file: Path,
) -> None:
    """Write the page.

    Args:
        summary: of all points.
        rows: of its table.
        told: lines on how all was measured.
        drawn: the chart as SVG, for who lets no scripts run.
        file: where to.
    """
    from flows.report.template import TEMPLATES, address, filled  # only who writes a page loads it

    page = filled(
        "chart.html.j2",
        title="Speed against accuracy",
        told=told,
        drawn=address(drawn, "image/svg+xml"),
        choices={"x": ("Cost", COSTS), "y": ("Quality", QUALITIES)},
        conclusions=[line.removeprefix("- ") for line in conclusions(summary)],
        head=["point", *(axis.title for axis in AXES), "stands"],
        rows=[_row(row) for row in rows],
        data=page_data(summary, rows),
        script=(TEMPLATES / "chart.js").read_text(),
    )
    file.write_text(page)


def page_data(summary: Summary, rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """What the script draws: axes, groups, and points with all their figures."""
    points = []
    for row in rows:
        name = str(row["point"])
        point = summary.points[name]
        standing = summary.overall[name]
        means = {axis.name: summary.mean(name, axis) for axis in AXES}
        points.append(
            {
                "name": name,
                "group": point.group,
                "about": point.about,
                "stands": f"all figures together: {stands(standing.state, standing.by)}",
                "settings": settings_of(point),
                "mean": means,
                "range": {axis.name: mean_range(summary, row, axis) for axis in AXES},
                "shown": {axis.name: shown_level(axis, means[axis.name]) for axis in AXES},
                "change": {axis.name: shown_change(axis, row) for axis in AXES},
            }
        )
    axes = [
        {
            "name": axis.name,
            "title": axis.title,
            "isRatio": axis.is_ratio,
            "moreIsBetter": axis.more_is_better,
            "scale": axis.scale,
        }
        for axis in AXES
    ]
    groups = list(dict.fromkeys(summary.points[str(row["point"])].group for row in rows))
    return {"axes": axes, "groups": sorted(groups), "points": points}


def mean_range(summary: Summary, row: Mapping[str, Any], axis: Axis) -> tuple[float, float]:
    """The interval of a point's difference to the base, laid about the base's mean."""
    name = str(row["point"])
    if f"{axis.name}_change_low" not in row:
        mean = summary.mean(name, axis)
        return mean, mean
    base = summary.mean(summary.base, axis)
    ends = (row[f"{axis.name}_change_low"], row[f"{axis.name}_change_high"])
    low, high = (base * (1.0 + end) if axis.is_ratio else base + end for end in ends)
    return low, high


def _row(row: Mapping[str, Any]) -> dict[str, Any]:
    """A point in the table: what is ordered by, and what is read."""
    return {
        "name": row["point"],
        "cells": [(row[axis.name], shown_level(axis, row[axis.name])) for axis in AXES],
        "stands": stands(row["overall"], row["overall_by"]),
    }
