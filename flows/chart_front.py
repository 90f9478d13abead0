"""Which settings are worth their cost: paired differences, dominance beyond the noise, the front.

Every figure is first laid on a scale on which less is better and on which differences mean the same
everywhere: logarithms of times, bytes and distances, decibels and degrees as they are. Two points
are compared orbit by orbit. A point is dominated by another that is in the mean no worse on any
axis and better on one beyond the noise: that difference has one sign in the whole bootstrap
interval over orbits, and exceeds what repeats with other seeds differ by. Since means of paired
differences add up, this order has no circles.
"""

import functools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from stages.score_summary import Interval

# Standard errors that count as noise: repeats are few, and Student's t of 95 % is 3.2 for the three
# degrees of freedom that two seeds of three orbits leave.
NOISE_SPREADS = 3.0


@dataclass(frozen=True)
class Axis:
    """A figure that points are compared by.

    Attributes:
        name: in results and tables.
        title: for a person, with its unit.
        digits: after the point.
        is_cost: whether it is paid; otherwise it is got.
        is_ratio: whether factors count, not differences; values are positive.
        more_is_better: e.g. decibels.
        scale: factor from results to what is shown.
    """

    name: str
    title: str
    digits: int
    is_cost: bool = False
    is_ratio: bool = False
    more_is_better: bool = False
    scale: float = 1.0

    def badness(self, value: float) -> float:
        """On the scale on which less is better."""
        laid = math.log(value) if self.is_ratio else value
        return -laid if self.more_is_better else laid

    def value(self, badness: float) -> float:
        """Inverse of `badness`."""
        laid = -badness if self.more_is_better else badness
        return math.exp(laid) if self.is_ratio else laid

    def change(self, badness: float) -> float:
        """A difference of two values as a person reads it: in its unit, or as a share."""
        laid = 0.0 - badness if self.more_is_better else badness  # nothing is +0, not -0
        return math.expm1(laid) if self.is_ratio else laid


CPU = Axis("cpu_s", "CPU s", 1, is_cost=True, is_ratio=True)
SECONDS = Axis("seconds", "s", 1, is_cost=True, is_ratio=True)
MEMORY = Axis("peak_mib", "peak memory, MiB", 0, is_cost=True, is_ratio=True)
BYTES = Axis("bytes", "GLB, kB", 0, is_cost=True, is_ratio=True, scale=1e-3)
RELIGHT = Axis("relight_delta_db", "relit - ideal, dB", 2, more_is_better=True)
NORMALS = Axis("normal_deg", "normal error, deg", 2)
CHAMFER = Axis("distance", "surface distance", 5, is_ratio=True)
BASECOLOR = Axis("basecolor_db", "basecolor, dB", 2, more_is_better=True)
COSTS, QUALITIES = (CPU, SECONDS, MEMORY, BYTES), (RELIGHT, NORMALS, CHAMFER, BASECOLOR)
AXES = (*COSTS, *QUALITIES)
# Seconds of a clock depend on what else the machine does; CPU seconds stand for both.
COMPARED = (CPU, *QUALITIES)
PANELS = (*((CPU, quality) for quality in QUALITIES), (MEMORY, RELIGHT), (BYTES, RELIGHT))

# Figures of points by orbit: {point: {orbit: {axis: value}}}.
Values = Mapping[str, float]
Figures = Mapping[str, Mapping[str, Values]]


def laid(figures: Figures, point: str, axis: Axis) -> dict[str, float]:
    """A point's badness by orbit."""
    return {o: axis.badness(values[axis.name]) for o, values in figures[point].items()}


def mean_badness(figures: Figures, point: str, axis: Axis) -> float:
    """Mean over orbits of a point's badness."""
    values = laid(figures, point, axis).values()
    return math.fsum(values) / len(values)


def difference(figures: Figures, point: str, other: str, axis: Axis) -> "Interval":
    """How much worse `point` is than `other`, over the orbits that both have."""
    one, two = (tuple(sorted(laid(figures, name, axis).items())) for name in (point, other))
    return _interval(one, two)


@functools.lru_cache(maxsize=1 << 16)  # panels share axes, and pages are written again and again
def _interval(
    one: tuple[tuple[str, float], ...], other: tuple[tuple[str, float], ...]
) -> "Interval":
    from stages.score_summary import paired_interval

    return paired_interval(dict(one), dict(other))


def mean_difference(figures: Figures, point: str, other: str, axis: Axis) -> float:
    """The same without an interval."""
    return mean_badness(figures, point, axis) - mean_badness(figures, other, axis)


def is_gain(apart: "Interval", noise: float) -> bool:
    """Whether a difference is one to the better, beyond the noise."""
    return apart.high < 0.0 and apart.mean < -noise


def repeat_noise(repeats: Iterable[Sequence[Values]], axis: Axis) -> float:
    """What two equal points differ by, in the mean over orbits, by chance alone.

    Args:
        repeats: for each orbit, the figures of one point with several seeds.
        axis: by which.
    """
    squares, freedom, orbits = 0.0, 0, 0
    for seeds in repeats:
        laid = [axis.badness(values[axis.name]) for values in seeds]
        if len(laid) > 1:
            mean = math.fsum(laid) / len(laid)
            squares += math.fsum((value - mean) ** 2 for value in laid)
            freedom += len(laid) - 1
            orbits += 1
    if freedom == 0:
        return 0.0
    return NOISE_SPREADS * math.sqrt(squares / freedom * 2.0 / orbits)


class State(StrEnum):
    """Where a point stands."""

    FRONT = "front"
    DOUBTFUL = "within the noise"  # another is no worse in any mean, but not clearly better
    DOMINATED = "dominated"


@dataclass(frozen=True)
class Standing:
    """Where a point stands, and by which other point."""

    state: State
    by: str = ""


def standings(
    figures: Figures, axes: Sequence[Axis], noise: Mapping[str, float]
) -> dict[str, Standing]:
    """Where each point stands among all.

    Args:
        figures: of all points.
        axes: that count.
        noise: of each axis, as `repeat_noise` has it.
    """
    ahead = {point: _ahead_of(point, figures, axes, noise) for point in figures}
    found = {}
    for point, others in ahead.items():
        clear = [other for other, is_clear in others.items() if is_clear]
        chosen = clear or list(others)
        if not chosen:
            found[point] = Standing(State.FRONT)
            continue
        # Named is one that as few as can be are ahead of, and of those the cheapest.
        by = min(
            chosen, key=lambda other: (len(ahead[other]), mean_badness(figures, other, axes[0]))
        )
        found[point] = Standing(State.DOMINATED if clear else State.DOUBTFUL, by)
    return found


def _ahead_of(
    point: str, figures: Figures, axes: Sequence[Axis], noise: Mapping[str, float]
) -> dict[str, bool]:
    """Points that are in no mean worse and in one better; whether that one is clear."""
    found = {}
    for other in figures:
        if other == point:
            continue
        means = [mean_difference(figures, other, point, axis) for axis in axes]
        if all(mean <= 0.0 for mean in means) and any(mean < 0.0 for mean in means):
            found[other] = any(
                is_gain(difference(figures, other, point, axis), noise.get(axis.name, 0.0))
                for axis in axes
            )
    return found


def ladder(figures: Figures, cost: Axis, quality: Axis, noise: Mapping[str, float]) -> list[str]:
    """Points from cheap to good, each better than the one before beyond the noise.

    The cheapest point of the front begins; each dearer one is taken if its gain is clear.
    """
    where = standings(figures, (cost, quality), noise)
    front = [point for point, standing in where.items() if standing.state is State.FRONT]
    front.sort(key=lambda point: mean_badness(figures, point, cost))
    taken = front[:1]
    for point in front[1:]:
        apart = difference(figures, point, taken[-1], quality)
        if is_gain(apart, noise.get(quality.name, 0.0)):
            taken.append(point)
    return taken


def knee(figures: Figures, steps: Sequence[str], cost: Axis, quality: Axis) -> str:
    """Of a ladder the step farthest above the line from its first to its last.

    Source: Satopaa et al. 2011, with the cost on a logarithmic scale.
    """
    first, last = steps[0], steps[-1]
    if len(steps) < 3:
        return last
    span_cost = mean_difference(figures, last, first, cost)
    span_gain = -mean_difference(figures, last, first, quality)

    def above(point: str) -> float:
        spent = mean_difference(figures, point, first, cost) / span_cost
        return -mean_difference(figures, point, first, quality) / span_gain - spent

    return max(steps[1:-1], key=above)
