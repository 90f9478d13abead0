"""Means over samples, objects and seeds, and how far they can be trusted.

Objects are what a claim generalises over, so that intervals resample objects; of two methods on
the same objects the differences are resampled, since what objects have in common cancels.
Source: Efron and Tibshirani 1993, "An Introduction to the Bootstrap", chapters 8 and 13.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

DRAWS = 10_000  # of the bootstrap
LEVEL = (2.5, 97.5)  # percentiles

Key = TypeVar("Key")


@dataclass(frozen=True)
class Interval:
    """A mean with its 95 % bootstrap interval.

    Attributes:
        mean: NaN if there is no value.
        low: lower end; of a single object the mean itself, which tells nothing.
        high: upper end.
        count: of values that were there.
    """

    mean: float
    low: float
    high: float
    count: int


@dataclass(frozen=True)
class SampleSummary:
    """One figure over K predictions for the same input.

    Attributes:
        mean: what one draw scores on average; the figure to compare methods by.
        best: of all K. It rises with K even if nothing improves: name K beside it.
        std: of one draw (divided by K - 1); NaN for a single one.
        count: K.
    """

    mean: float
    best: float
    std: float
    count: int


def summarize_samples(values: Sequence[float], *, is_better_high: bool) -> SampleSummary:
    """Mean, best and deviation of the figures of K predictions.

    Raises:
        ValueError: there are none.
    """
    if not values:
        raise ValueError("wanted the figures of at least one sample, got none")
    array = np.array(values, np.float64)
    std = float(array.std(ddof=1)) if len(array) > 1 else float("nan")
    best = array.max() if is_better_high else array.min()
    return SampleSummary(float(array.mean()), float(best), std, len(array))


def bootstrap_interval(per_object: NDArray[np.float64], *, seed: int = 0) -> Interval:
    """Mean over objects and its 95 % bootstrap interval.

    Args:
        per_object: one value each; NaN is left out.
        seed: of the resampling; equal seeds draw equal objects.
    """
    known = per_object[~np.isnan(per_object)]
    if not len(known):
        return Interval(float("nan"), float("nan"), float("nan"), 0)
    generator = np.random.default_rng(seed)
    means = known[generator.integers(0, len(known), (DRAWS, len(known)))].mean(1)
    low, high = np.percentile(means, LEVEL)
    return Interval(float(known.mean()), float(low), float(high), len(known))


def paired_interval(one: Mapping[Key, float], other: Mapping[Key, float]) -> Interval:
    """By how much the mean of `one` lies above that of `other`, over objects that both have.

    One method is clearly better where the interval leaves zero out.
    """
    return bootstrap_interval(np.array(list(paired(one, other).values()), np.float64))


def paired(one: Mapping[Key, float], other: Mapping[Key, float]) -> dict[Key, float]:
    """One minus other, of what both have."""
    return {key: value - other[key] for key, value in one.items() if key in other}


def mean_and_interval(
    values: Mapping[tuple[str, int], float],
) -> tuple[float, tuple[float, float] | None]:
    """Mean over objects of the mean over seeds, and its bootstrap interval of 95 %.

    Objects are drawn with replacement and, for each, its seeds; without two of either there is no
    interval. A mean counts every object alike, however many of its seeds ended with a figure.
    """
    objects = list(dict.fromkeys(name for name, _ in values))
    by_object = [np.array([v for (o, _), v in values.items() if o == name]) for name in objects]
    mean = float(np.mean([seeds.mean() for seeds in by_object]))
    if len(values) < 2:
        return mean, None
    generator = np.random.default_rng(0)
    drawn = np.stack([_means_of_draws(seeds, len(objects), generator) for seeds in by_object])
    chosen = generator.integers(len(objects), size=(DRAWS, len(objects)))
    place = np.arange(len(objects))
    means = drawn[chosen, np.arange(DRAWS)[:, None], place].mean(1)
    low, high = np.percentile(means, LEVEL)
    return mean, (float(low), float(high))


def _means_of_draws(
    seeds: NDArray[np.float64], places: int, generator: np.random.Generator
) -> NDArray[np.float64]:
    """Means of an object's seeds drawn anew, for each draw and each place it may be chosen for."""
    index = generator.integers(len(seeds), size=(DRAWS, places, len(seeds)))
    return seeds[index].mean(-1)
