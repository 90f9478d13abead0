"""Means over objects and paired differences, for flows that make tables of scores."""

import math
from collections.abc import Mapping

import numpy as np

from svim3d.metrics.statistics import Interval as Interval
from svim3d.metrics.statistics import bootstrap_interval, paired, paired_interval


def mean_over_objects(values: Mapping[str, float]) -> Interval:
    """Mean and 95 % bootstrap interval; values that are not finite are left out."""
    return bootstrap_interval(np.array(list(_finite(values).values()), np.float64))


def difference(one: Mapping[str, float], other: Mapping[str, float]) -> Interval:
    """By how much `one` lies above `other`, over the objects that both have."""
    one, other = _finite(one), _finite(other)
    if not paired(one, other):
        return Interval(math.nan, math.nan, math.nan, 0)
    return paired_interval(one, other)


def _finite(values: Mapping[str, float]) -> dict[str, float]:
    return {name: value for name, value in values.items() if math.isfinite(value)}
