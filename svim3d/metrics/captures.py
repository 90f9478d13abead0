"""From scores of pictures to those of captures, and from captures to a table's row.

Every capture counts alike, however many pictures it has. Beside the mean stand what it hides:
the worst capture by name, the tenth percentile on the bad side, and how much was missing.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from svim3d.metrics.stanford_orb import PictureScore

BAD_TAIL = 10.0  # percentile that is told of the bad side

# Whether more is better, by figure.
IS_BETTER_HIGH = {
    "psnr_hdr_db": True,
    "psnr_ldr_db": True,
    "ssim": True,
    "lpips": False,
    "normal": False,
    "depth": False,
    "shape": False,
}


@dataclass(frozen=True)
class CaptureScore:
    """Means over the pictures of one capture.

    Attributes:
        name: of the capture.
        rows: by row, then by figure.
        pictures: that were scored.
        missing: of them, those without a prediction.
    """

    name: str
    rows: Mapping[str, Mapping[str, float]]
    pictures: int
    missing: int


@dataclass(frozen=True)
class Spread:
    """One figure over captures.

    Attributes:
        mean: every capture alike.
        std: of the captures (divided by their number, as Stanford-ORB prints it).
        p10: a tenth of the captures is worse than this.
        worst: of all captures.
        worst_capture: its name.
        captures: how many have the figure.
    """

    mean: float
    std: float
    p10: float
    worst: float
    worst_capture: str
    captures: int


@dataclass(frozen=True)
class BenchmarkScore:
    """A table's row, in each variant.

    Attributes:
        rows: by row, then by figure.
        pictures: that were scored.
        missing: of them, those without a prediction.
        failed_captures: names of captures that lack all predictions.
    """

    rows: Mapping[str, Mapping[str, Spread]]
    pictures: int
    missing: int
    failed_captures: tuple[str, ...]


def score_capture(name: str, scores: Sequence[PictureScore]) -> CaptureScore:
    """Mean over a capture's pictures.

    Raises:
        ValueError: there are none.
    """
    if not scores:
        raise ValueError(f"wanted at least one picture of capture {name}, got none")
    rows = {
        row: {f: float(np.mean([s.rows[row][f] for s in scores])) for f in figures}
        for row, figures in scores[0].rows.items()
    }
    return CaptureScore(name, rows, len(scores), sum(s.is_missing for s in scores))


def score_benchmark(captures: Sequence[CaptureScore]) -> BenchmarkScore:
    """Mean, spread and tail over captures; a figure that is NaN in a capture is left out there.

    Raises:
        ValueError: there are no captures.
    """
    if not captures:
        raise ValueError("wanted at least one capture, got none")
    named: dict[str, list[str]] = {}
    for capture in captures:
        for row, figures in capture.rows.items():
            named[row] = list(dict.fromkeys([*named.get(row, []), *figures]))
    rows: dict[str, dict[str, Spread]] = {row: {} for row in named}
    for row, names in named.items():
        for figure in names:
            values = {c.name: c.rows.get(row, {}).get(figure, math.nan) for c in captures}
            rows[row][figure] = spread(values, is_better_high=IS_BETTER_HIGH[figure])
    return BenchmarkScore(
        rows,
        sum(c.pictures for c in captures),
        sum(c.missing for c in captures),
        tuple(c.name for c in captures if c.missing == c.pictures),
    )


def spread(values: Mapping[str, float], *, is_better_high: bool) -> Spread:
    """Of a figure by capture; NaN is left out.

    Raises:
        ValueError: there is no figure that is not NaN.
    """
    known = {name: value for name, value in values.items() if not math.isnan(value)}
    if not known:
        raise ValueError(f"wanted at least one figure, got none in {len(values)} captures")
    array = np.array(list(known.values()))
    worst = (
        min(known, key=known.__getitem__) if is_better_high else max(known, key=known.__getitem__)
    )
    tail = BAD_TAIL if is_better_high else 100.0 - BAD_TAIL
    return Spread(
        float(array.mean()),
        float(array.std()),
        float(np.percentile(array, tail)),
        known[worst],
        worst,
        len(known),
    )
