"""Means over objects and paired differences, for flows that make tables or charts of scores.

A sample is an object with a seed: a mean counts each object alike, whatever its number of seeds.
"""

import math
from collections.abc import Collection, Mapping
from statistics import fmean

import numpy as np

from svim3d.metrics.captures import BenchmarkScore as BenchmarkScore
from svim3d.metrics.captures import CaptureScore, score_benchmark
from svim3d.metrics.statistics import Interval as Interval
from svim3d.metrics.statistics import (
    SampleSummary,
    bootstrap_interval,
    mean_and_interval,
    paired,
    summarize_samples,
)
from svim3d.metrics.statistics import paired_interval as paired_interval

Sample = tuple[str, int]
Values = Mapping[Sample, float]


def mean_over_objects(values: Values) -> Interval:
    """Mean over objects of means over seeds, with its 95 % bootstrap interval.

    Values that are not finite are left out. Intervals draw objects anew and, where some have
    several, their seeds.
    """
    known = _finite(values)
    objects = {name for name, _ in known}
    if len(objects) == len(known):
        return bootstrap_interval(np.array(list(known.values()), np.float64))
    mean, ends = mean_and_interval(known)
    low, high = ends or (mean, mean)
    return Interval(mean, low, high, len(objects))


def difference(one: Values, other: Values) -> Interval:
    """By how much `one` lies above `other`, over the objects and seeds that both have."""
    return mean_over_objects(paired(_finite(one), _finite(other)))


def by_object(values: Values) -> dict[str, float]:
    """Means over each object's seeds."""
    return {name: fmean(found) for name, found in _seeds(values).items()}


def over_seeds(values: Values, *, is_better_high: bool) -> dict[str, SampleSummary]:
    """Mean, best and deviation over the seeds of each object that has as many as any."""
    seeds = _seeds(values)
    most = max(map(len, seeds.values()), default=0)
    return {
        name: summarize_samples(found, is_better_high=is_better_high)
        for name, found in seeds.items()
        if len(found) == most
    }


def benchmark(
    rows: Mapping[str, Mapping[str, Mapping[str, float]]], failed: Collection[str]
) -> BenchmarkScore:
    """Mean, worst and tenth percentile over captures.

    Args:
        rows: figures by row, then by name, then by capture.
        failed: captures without an asset, which are scored as white.
    """
    captures: dict[str, dict[str, dict[str, float]]] = {}
    for row, figures in rows.items():
        for figure, values in figures.items():
            for name, value in values.items():
                captures.setdefault(name, {}).setdefault(row, {})[figure] = value
    return score_benchmark(
        [CaptureScore(name, rows, 1, int(name in failed)) for name, rows in captures.items()]
    )


def _seeds(values: Values) -> dict[str, list[float]]:
    found: dict[str, list[float]] = {}
    for (name, _), value in _finite(values).items():
        found.setdefault(name, []).append(value)
    return found


def _finite(values: Values) -> dict[Sample, float]:
    return {sample: value for sample, value in values.items() if math.isfinite(value)}
