"""Charts of reports, as SVG inside the page: no script, legible in light and dark."""

import html
import math
from collections.abc import Sequence
from dataclasses import dataclass

MOST_POINTS = 160  # of a curve; more than pixels shows nothing
SMOOTHED = 1.0 / 24.0  # share of the curve that the strong line averages over
SPARK = (240.0, 72.0, 6.0)  # width, height and margin, pixels
LOG_FROM = 20.0  # a curve that falls by more is drawn over a logarithmic scale
CHART = (440.0, 220.0)
LEFT, RIGHT, TOP, BOTTOM = 44.0, 16.0, 14.0, 34.0  # margins of a chart with axes

Points = Sequence[tuple[float, float]]


@dataclass(frozen=True)
class Line:
    """A line of a chart.

    Attributes:
        name: said in the legend and to who cannot see.
        points: x and y.
        style: class of the line, which colours it.
    """

    name: str
    points: Points
    style: str


def sparkline(title: str, curve: Points) -> str:
    """A curve without axes: every value faintly, what it does on the whole strongly."""
    finite = [(x, y) for x, y in curve if math.isfinite(y)]
    if len(finite) < 2:
        return ""
    width, height, margin = SPARK
    values = [y for _, y in finite]
    low, high = min(values), max(values)
    is_log = low > 0.0 and high > LOG_FROM * low
    if is_log:
        finite = [(x, math.log(y)) for x, y in finite]
        low, high = math.log(low), math.log(high)
    span, first, last = (high - low) or 1.0, finite[0][0], finite[-1][0]

    def path(points: Points) -> str:
        return " ".join(
            f"{margin + (x - first) / ((last - first) or 1.0) * (width - 2 * margin):.1f},"
            f"{height - margin - (y - low) / span * (height - 2 * margin):.1f}"
            for x, y in points
        )

    label = html.escape(f"{title}{', logarithmic' if is_log else ''}")
    return (
        f'<svg class="spark" role="img" aria-label="{label}" viewBox="0 0 {width:g} {height:g}">'
        f'<polyline class="raw" points="{path(thinned(finite))}"/>'
        f'<polyline class="smooth" points="{path(thinned(smoothed(finite)))}"/></svg>'
    )


def smoothed(curve: Points) -> Points:
    """Means over a window around each point, narrower at the ends."""
    reach = max(0, int(len(curve) * SMOOTHED))
    sums = [0.0]
    for _, y in curve:
        sums.append(sums[-1] + y)
    found = []
    for index, (x, _) in enumerate(curve):
        own = min(reach, index, len(curve) - 1 - index)
        total = sums[index + own + 1] - sums[index - own]
        found.append((x, total / (2 * own + 1)))
    return found


def thinned(curve: Points) -> Points:
    """At most `MOST_POINTS` of the points at even steps, the last one among them."""
    count = min(len(curve), MOST_POINTS)
    if count < 2:
        return curve
    return [curve[round(i * (len(curve) - 1) / (count - 1))] for i in range(count)]


def line_chart(title: str, lines: Sequence[Line], *, unit: str, ticks: Sequence[float]) -> str:
    """Lines over the same few places, evenly spaced, with axes and a legend.

    Args:
        title: what is shown, for who cannot see it.
        lines: at least one, with points at some of the places.
        unit: of y.
        ticks: all places, rising.
    """
    width, height = CHART
    values = [y for line in lines for _, y in line.points]
    low, high = math.floor(min(values)) - 1, math.ceil(max(values)) + 1
    step = nice_step((high - low) / 4.0)
    marks = [m * step for m in range(math.ceil(low / step), math.floor(high / step) + 1)]

    def at_x(place: float) -> float:
        share = ticks.index(place) / max(1, len(ticks) - 1)
        return LEFT + share * (width - LEFT - RIGHT)

    def at_y(value: float) -> float:
        return height - BOTTOM - (value - low) / (high - low) * (height - TOP - BOTTOM)

    parts = [
        f'<line class="grid" x1="{LEFT:g}" x2="{width - RIGHT:g}" y1="{at_y(m):.1f}" '
        f'y2="{at_y(m):.1f}"/><text x="{LEFT - 8:g}" y="{at_y(m) + 4:.1f}" '
        f'text-anchor="end">{m:g}</text>'
        for m in marks
    ]
    parts += [
        f'<text x="{at_x(t):.1f}" y="{height - 12:g}" text-anchor="middle">{t:g}</text>'
        for t in ticks
    ]
    for line in lines:
        points = [(at_x(x), at_y(y)) for x, y in line.points]
        path = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
        name = html.escape(line.name)
        parts.append(f'<g class="{line.style}"><title>{name}</title><polyline points="{path}"/>')
        parts += [f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3.5"/>' for x, y in points]
        parts.append("</g>")
    label = html.escape(title)
    keys = "".join(
        f'<span class="key {line.style}">{html.escape(line.name)}</span>' for line in lines
    )
    return (
        f'<figure class="chart"><svg role="img" aria-label="{label}" '
        f'viewBox="0 0 {width:g} {height:g}">{"".join(parts)}</svg>'
        f"<figcaption>{label}, {html.escape(unit)} {keys}</figcaption></figure>"
    )


def nice_step(least: float) -> float:
    """The smallest of 1, 2, 5 times a power of ten that is no smaller."""
    power = 10.0 ** math.floor(math.log10(max(least, 1e-9)))
    return next(m * power for m in (1.0, 2.0, 5.0, 10.0) if m * power >= least * (1.0 - 1e-9))
