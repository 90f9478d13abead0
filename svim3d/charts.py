"""The matplotlib door: points of cost against quality, their front, as PNG or SVG.

matplotlib belongs to the extra `chart` and is imported when something is drawn.
"""

import io
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

COLUMNS = 3
PANEL_INCHES = (5.4, 4.3)
LEGEND_INCHES = 0.5  # below all panels, for each row of groups
LEGEND_COLUMNS = 8
DOTS_PER_INCH = 110
POINTS_PER_PIXEL = 72.0 / DOTS_PER_INCH
STYLE = {
    "font.size": 9.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "svg.hashsalt": "svim3d",  # equal pictures give equal bytes
    "svg.fonttype": "none",
}
FRONT_COLOUR = "0.25"
NAME_POINTS = 7
LETTER_PX, LINE_PX = 6.0, 11.0  # of a name at that size, about
PLACES = ((7, 4), (-7, 4), (7, -13), (-7, -13), (12, 14), (-12, 14))  # right and up of a point
SHAPES = ("o", "s", "^", "v", "D", "P", "X", "<", ">", "p")


@dataclass(frozen=True)
class Mark:
    """A point of a panel.

    Attributes:
        name: written beside it, where `is_named`.
        group: decides colour and shape; the same in all panels.
        x: cost.
        y: quality.
        y_range: ends of the interval of y.
        is_front: whether it is filled; others are hollow.
        is_named: whether its name is written, where there is room; first ones come first.
    """

    name: str
    group: str
    x: float
    y: float
    y_range: tuple[float, float]
    is_front: bool
    is_named: bool


@dataclass(frozen=True)
class Panel:
    """Cost against quality.

    Attributes:
        x_title: with unit.
        y_title: with unit.
        marks: all points.
        is_log_y: whether quality counts by factors; costs always do.
        more_is_better: of quality; a scale on which less is better is turned upside down.
    """

    x_title: str
    y_title: str
    marks: Sequence[Mark]
    is_log_y: bool
    more_is_better: bool


def is_available() -> bool:
    """Whether matplotlib is installed."""
    import importlib.util

    return importlib.util.find_spec("matplotlib") is not None


def draw_panels(panels: Sequence[Panel], title: str, form: Literal["png", "svg"]) -> bytes:
    """All panels in one picture; up and left is better in each."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    groups = list(dict.fromkeys(mark.group for panel in panels for mark in panel.marks))
    looks = {g: (f"C{i % 10}", SHAPES[(i + i // 10) % len(SHAPES)]) for i, g in enumerate(groups)}
    rows = -(-len(panels) // COLUMNS)
    legend_rows = -(-len(groups) // LEGEND_COLUMNS)
    size = (
        PANEL_INCHES[0] * min(COLUMNS, len(panels)),
        PANEL_INCHES[1] * rows + LEGEND_INCHES * legend_rows,
    )
    with pyplot.rc_context(STYLE):
        figure, axes = pyplot.subplots(
            rows,
            min(COLUMNS, len(panels)),
            figsize=size,
            dpi=DOTS_PER_INCH,
            layout="constrained",
            squeeze=False,
        )
        for axis in axes.flat[len(panels) :]:
            axis.set_visible(False)
        for axis, panel in zip(axes.flat, panels, strict=False):
            _draw(axis, panel, looks)
        handles = [
            pyplot.Line2D([], [], linestyle="", color=colour, marker=shape, label=group)
            for group, (colour, shape) in looks.items()
        ]
        figure.legend(
            handles=handles,
            loc="outside lower center",
            ncols=min(LEGEND_COLUMNS, max(1, len(groups))),
            frameon=False,
        )
        figure.suptitle(title)
        figure.canvas.draw()  # places the panels; names are laid out in pixels
        figure.set_layout_engine("none")
        for axis, panel in zip(axes.flat, panels, strict=False):
            _name_marks(axis, [mark for mark in panel.marks if mark.is_named])
        stream = io.BytesIO()
        # Without a date; the program's version stays out of PNG as well.
        metadata: dict[str, Any] = {"Date": None} if form == "svg" else {"Software": None}
        figure.savefig(stream, format=form, dpi=DOTS_PER_INCH, metadata=metadata)
        pyplot.close(figure)
    return stream.getvalue()


def _draw(axis: Any, panel: Panel, looks: dict[str, tuple[str, str]]) -> None:
    """One panel."""
    from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

    for mark in panel.marks:
        colour, shape = looks[mark.group]
        low, high = mark.y_range
        axis.plot([mark.x, mark.x], [low, high], color=colour, lw=0.8, alpha=0.35, zorder=1)
        axis.plot(
            mark.x,
            mark.y,
            shape,
            color=colour,
            markerfacecolor=colour if mark.is_front else "white",
            alpha=1.0 if mark.is_front else 0.75,
            markersize=6,
            zorder=3 if mark.is_front else 2,
        )
    steps = front_line([(mark.x, mark.y) for mark in panel.marks], panel.more_is_better)
    axis.plot(*zip(*steps, strict=True), color=FRONT_COLOUR, lw=1.0, drawstyle="steps-post")
    axis.set(xscale="log", xlabel=panel.x_title, ylabel=panel.y_title)
    if panel.is_log_y:
        axis.set_yscale("log")
    if not panel.more_is_better:
        axis.invert_yaxis()
    for each in (axis.xaxis, *([axis.yaxis] if panel.is_log_y else [])):
        each.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        each.set_major_formatter(StrMethodFormatter("{x:g}"))
        each.set_minor_formatter(NullFormatter())
    axis.grid(alpha=0.25)


def _name_marks(axis: Any, marks: Sequence[Mark]) -> None:
    """Write names beside points where there is room; one that finds none is left out."""
    taken: list[tuple[float, float, float, float]] = []
    to_pixels = axis.transData.transform
    frame = axis.get_window_extent()
    for mark in marks:
        x, y = (float(side) for side in to_pixels((mark.x, mark.y)))
        width = len(mark.name) * LETTER_PX
        for right, up in PLACES:
            left = x + (right if right > 0 else right - width)
            box = (left, y + up, left + width, y + up + LINE_PX)
            inside = frame.x0 <= box[0] and box[2] <= frame.x1 and box[1] >= frame.y0
            if inside and not any(_overlap(box, other) for other in taken):
                taken.append(box)
                # In points: SVG counts other pixels than PNG.
                offset = (POINTS_PER_PIXEL * (left - x), POINTS_PER_PIXEL * up)
                axis.annotate(
                    mark.name,
                    (mark.x, mark.y),
                    xytext=offset,
                    textcoords="offset points",
                    fontsize=NAME_POINTS,
                )
                break


def _overlap(
    one: tuple[float, float, float, float], other: tuple[float, float, float, float]
) -> bool:
    """Whether two boxes (left, bottom, right, top) share an area."""
    return one[0] < other[2] and other[0] < one[2] and one[1] < other[3] and other[1] < one[3]


def front_line(
    points: Sequence[tuple[float, float]], more_is_better: bool
) -> list[tuple[float, float]]:
    """Of (cost, quality) the points that no cheaper or equal one reaches, from cheap to dear."""
    sign = -1.0 if more_is_better else 1.0
    found: list[tuple[float, float]] = []
    for cost, quality in sorted(points, key=lambda point: (point[0], sign * point[1])):
        if not found or sign * quality < sign * found[-1][1]:
            found.append((cost, quality))
    return found
