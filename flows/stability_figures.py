"""Figures of many cases: failure rates with intervals, quantiles, the worst tenth, breakdown."""

import math
from collections.abc import Mapping, Sequence

Z_95 = 1.959963984540054  # two-sided quantile of the normal distribution
WORST_SHARE = 0.1
BREAKDOWN_RATE = 0.5  # of failures


def wilson(failures: int, cases: int) -> tuple[float, float]:
    """Interval of 95 % of a rate. Source: Wilson 1927; holds for few cases and for none failed."""
    if cases == 0:
        return 0.0, 1.0
    rate, z2 = failures / cases, Z_95**2
    middle = (rate + z2 / (2 * cases)) / (1 + z2 / cases)
    half = Z_95 * math.sqrt(rate * (1 - rate) / cases + z2 / (4 * cases**2)) / (1 + z2 / cases)
    # At the ends the interval is exact, which rounding would miss.
    low = 0.0 if failures == 0 else middle - half
    high = 1.0 if failures == cases else middle + half
    return low, high


def quantile(values: Sequence[float], share: float) -> float:
    """By linear interpolation between the ordered values; NaN of none."""
    if not values:
        return math.nan
    ordered = sorted(values)
    place = share * (len(ordered) - 1)
    below = math.floor(place)
    above = min(below + 1, len(ordered) - 1)
    return ordered[below] + (place - below) * (ordered[above] - ordered[below])


def worst_tenth(values: Sequence[float]) -> float:
    """Mean of the lowest tenth, of one value at least (CVaR of 10 %); NaN of none.

    Where a tenth is no whole number of values, the last one counts in part.
    """
    if not values:
        return math.nan
    ordered = sorted(values)
    wanted = max(1.0, WORST_SHARE * len(ordered))
    weights = [min(1.0, max(0.0, wanted - index)) for index in range(len(ordered))]
    return sum(w * v for w, v in zip(weights, ordered, strict=True)) / wanted


def breakdown(rates: Mapping[float, float]) -> float | None:
    """The first severity at which more than half of the cases fail; None where they never do."""
    return next((s for s in sorted(rates) if rates[s] > BREAKDOWN_RATE), None)
