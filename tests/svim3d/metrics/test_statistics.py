import math

import numpy as np
import pytest
from scipy import stats

from svim3d.metrics.statistics import bootstrap_interval, paired_interval, summarize_samples


def test_samples_have_mean_best_and_the_deviation_of_one_draw():
    found = summarize_samples([1.0, 2.0, 4.0], is_better_high=True)
    assert (found.mean, found.best, found.count) == (pytest.approx(7 / 3), 4.0, 3)
    assert found.std == pytest.approx(math.sqrt((16 / 9 + 1 / 9 + 25 / 9) / 2))
    assert summarize_samples([1.0, 2.0], is_better_high=False).best == 1.0
    assert math.isnan(summarize_samples([1.0], is_better_high=True).std)
    with pytest.raises(ValueError, match="at least one"):
        summarize_samples([], is_better_high=True)


def test_interval_is_scipys():
    values = np.random.default_rng(5).normal(3.0, 1.0, 40)
    found = bootstrap_interval(values)
    expected = stats.bootstrap(
        (values,), np.mean, n_resamples=10_000, method="percentile", rng=np.random.default_rng(1)
    ).confidence_interval
    assert found.mean == pytest.approx(values.mean())
    # Ends of two bootstraps of 10k draws differ by some percent of the interval's width.
    width = expected.high - expected.low
    assert found.low == pytest.approx(expected.low, abs=0.05 * width)
    assert found.high == pytest.approx(expected.high, abs=0.05 * width)


def test_unknown_values_are_left_out():
    found = bootstrap_interval(np.array([2.0, math.nan, 2.0]))
    assert (found.mean, found.low, found.high, found.count) == (2.0, 2.0, 2.0, 2)
    assert bootstrap_interval(np.array([math.nan])).count == 0


def test_pairing_takes_out_what_objects_have_in_common():
    hard = np.random.default_rng(0).normal(20.0, 5.0, 12)
    other = {str(i): float(v) for i, v in enumerate(hard)}
    one = {name: value + 0.5 for name, value in other.items()} | {"alone": 99.0}
    found = paired_interval(one, other)
    assert (found.mean, found.low, found.high) == tuple([pytest.approx(0.5)] * 3)
    assert found.count == 12
