"""From scores of single views to means over objects, their intervals, and tables of them."""

from collections.abc import Iterable
from dataclasses import asdict, dataclass, field

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from benchmarks.generator_scores import FIGURES, Turning
from svim3d.metrics.statistics import bootstrap_interval

STEP_DEG = 360.0 / 21  # of an even orbit; views are binned by it, both sides of the object alike
SHORT = (
    "rgb_psnr",
    "rgb_ssim",
    "basecolor_psnr",
    "basecolor_ssim",
    "roughness_rmse",
    "metallic_rmse",
    "normal_deg",
    "mask_iou",
)  # what a reader needs; all figures are in the results
OURS = "ours"


@dataclass
class Scores:
    """What one method scored on one set.

    Attributes:
        values: of each figure, an array [K] for each object.
        bins: of each object, the azimuth bin of each view, 0 for the reference alone.
        turning: of each object.
    """

    values: dict[str, list[NDArray[np.float64]]] = field(default_factory=dict)
    bins: list[NDArray[np.int64]] = field(default_factory=list)
    turning: list[Turning] = field(default_factory=list)

    def add(
        self, scores: dict[str, Tensor], azimuth_deg: Tensor, turned: Turning, *, materials: bool
    ) -> None:
        """Take one object; figures of materials that mean nothing become NaN."""
        for name, value in scores.items():
            told = value.double().numpy()
            blank = FIGURES[name].is_material and not materials
            self.values.setdefault(name, []).append(np.full_like(told, np.nan) if blank else told)
        self.bins.append(azimuth_bins(azimuth_deg.numpy()))
        self.turning.append(turned)

    def per_object(self, name: str) -> NDArray[np.float64]:
        """Mean of each object over all views but the reference, [N]; squares stay squares."""
        return np.array([_mean(value[:-1]) for value in self.values[name]])


def azimuth_bins(azimuth_deg: NDArray[np.float64]) -> NDArray[np.int64]:
    """Steps away from the reference, left or right; the last view is the reference, bin 0."""
    away = 180.0 - np.abs(np.mod(azimuth_deg, 360.0) - 180.0)
    bins = np.clip(np.rint(away / STEP_DEG), 1, 10).astype(np.int64)
    bins[-1] = 0
    return bins


def _mean(values: NDArray[np.float64]) -> float:
    known = values[~np.isnan(values)]
    return float(known.mean()) if len(known) else float("nan")


def interval(
    per_object: NDArray[np.float64], *, root: bool = False, seed: int = 0
) -> dict[str, float]:
    """Mean over objects and its 95 % bootstrap interval over objects.

    Args:
        per_object: one value each; NaN is left out.
        root: take the root of means of squares.
        seed: of the resampling; equal seeds draw equal objects.
    """
    told = asdict(bootstrap_interval(per_object, seed=seed))
    del told["count"]
    return {name: value**0.5 for name, value in told.items()} if root else told


def summarize(rows: dict[str, Scores]) -> dict[str, dict]:
    """Every figure of every row: mean, interval, by azimuth, at the reference; and turning."""
    return {
        row: {
            "figures": {name: _summary(scores, name) for name in scores.values},
            "turning": summarize_turning(scores.turning),
        }
        for row, scores in rows.items()
    }


def _summary(scores: Scores, name: str) -> dict:
    root = FIGURES[name].is_square
    by_bin = []
    for place in range(11):
        pairs = zip(scores.values[name], scores.bins, strict=True)
        told = _mean(np.array([_mean(value[bins == place]) for value, bins in pairs]))
        by_bin.append(float(np.sqrt(told)) if root else told)
    return {
        **interval(scores.per_object(name), root=root),
        "reference": by_bin[0],
        "by_azimuth": by_bin[1:],
    }


def summarize_turning(turned: list[Turning]) -> dict[str, dict[str, float]]:
    """Means over all objects, and over the half whose true views differ most."""
    by_asymmetry = sorted(turned, key=lambda t: -t.asymmetry)
    chosen = {"all": by_asymmetry, "asymmetric": by_asymmetry[: max(1, (len(turned) + 1) // 2)]}
    return {
        label: {
            "objects": len(group),
            **{key: float(np.mean([asdict(t)[key] for t in group])) for key in asdict(group[0])},
        }
        for label, group in chosen.items()
    }


def paired_gains(rows: dict[str, Scores], baselines: Iterable[str]) -> dict[str, dict]:
    """By how much ours is better than each baseline on the same objects; positive is better."""
    return {
        row: {
            name: interval(
                (rows[OURS].per_object(name) - rows[row].per_object(name))
                * (1.0 if FIGURES[name].is_better_high else -1.0)
            )
            for name in rows[OURS].values
            if not FIGURES[name].is_square
        }
        for row in baselines
    }


def verdict(gains: dict[str, dict]) -> dict[str, str]:
    """Of each figure, which baselines ours does not clearly beat: the interval holds zero."""
    names = next(iter(gains.values()))
    told = {}
    for name in names:
        short = [row for row, gain in gains.items() if not gain[name]["low"] > 0.0]
        told[name] = "beats all" if not short else f"not clearly better than {', '.join(short)}"
    return told


def main_table(summary: dict[str, dict], names: Iterable[str] = SHORT) -> str:
    """Rows by figures as Markdown: mean and half the interval."""
    names = list(names)
    lines = [_line(["", *[FIGURES[n].title + _arrow(n) for n in names]])]
    lines.append(_line(["---", *["---:"] * len(names)]))
    for row, told in summary.items():
        cells = [_cell(told["figures"][name], FIGURES[name].digits) for name in names]
        lines.append(_line([row, *cells]))
    return "\n".join(lines)


def azimuth_table(summary: dict[str, dict], name: str) -> str:
    """One figure of all rows by azimuth as Markdown."""
    figure = FIGURES[name]
    degrees = [f"{round(STEP_DEG * place)}" for place in range(11)]
    lines = [_line([figure.title + _arrow(name), *degrees, "mean"])]
    lines.append(_line(["---", *["---:"] * 12]))
    for row, told in summary.items():
        value = told["figures"][name]
        numbers = [value["reference"], *value["by_azimuth"], value["mean"]]
        lines.append(_line([row, *[f"{number:.{figure.digits}f}" for number in numbers]]))
    return "\n".join(lines)


def turning_table(summary: dict[str, dict]) -> str:
    """Retrieval of the azimuth as Markdown."""
    first = next(iter(summary.values()))["turning"]["all"]
    titles = ["nearest is own, %", "mean rank", "error, deg"]
    titles = [*titles, *[f"{title} (asymmetric half)" for title in titles]]
    lines = [_line(["", *titles]), _line(["---", *["---:"] * 6])]
    for row, told in summary.items():
        cells = []
        for group in ("all", "asymmetric"):
            t = told["turning"][group]
            cells += [f"{100 * t['rank_1']:.0f}", f"{t['mean_rank']:.1f}", f"{t['error_deg']:.0f}"]
        lines.append(_line([row, *cells]))
    chance = [f"{100 * first['chance_rank_1']:.0f}", f"{first['chance_rank']:.1f}", ""]
    return "\n".join([*lines, _line(["chance", *chance, *chance])])


def gains_table(gains: dict[str, dict], names: Iterable[str] = SHORT) -> str:
    """How much better ours is than each baseline as Markdown, with the whole interval."""
    names = list(names)
    lines = [_line(["ours better by", *[FIGURES[n].title for n in names]])]
    lines.append(_line(["---", *["---:"] * len(names)]))
    for row, gain in gains.items():
        cells = []
        for name in names:
            digits, told = FIGURES[name].digits, gain[name]
            low, high = f"{told['low']:.{digits}f}", f"{told['high']:.{digits}f}"
            cells.append(f"{told['mean']:.{digits}f} [{low}, {high}]")
        lines.append(_line([f"than {row}", *cells]))
    return "\n".join(lines)


def _cell(told: dict[str, float], digits: int) -> str:
    half = max(told["high"] - told["mean"], told["mean"] - told["low"])
    return f"{told['mean']:.{digits}f} ± {half:.{digits}f}"


def _arrow(name: str) -> str:
    return " ↑" if FIGURES[name].is_better_high else " ↓"


def _line(cells: Iterable[str]) -> str:
    return f"| {' | '.join(cells)} |"
