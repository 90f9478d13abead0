import math

import pytest
from scipy.stats import binomtest

from flows.stability_figures import breakdown, quantile, wilson, worst_tenth


@pytest.mark.parametrize(("failures", "cases"), [(0, 1), (1, 1), (0, 5), (2, 5), (5, 5), (17, 40)])
def test_wilson_is_scipys(failures, cases):
    expected = binomtest(failures, cases).proportion_ci(0.95, method="wilson")
    assert wilson(failures, cases) == pytest.approx((expected.low, expected.high), abs=1e-12)


def test_nothing_is_known_without_cases():
    assert wilson(0, 0) == (0.0, 1.0)


def test_quantiles_lie_between_values():
    values = [4.0, 1.0, 3.0, 2.0]
    assert [quantile(values, q) for q in (0.0, 0.5, 1.0)] == [1.0, 2.5, 4.0]
    assert quantile(values, 0.05) == pytest.approx(1.15)
    assert math.isnan(quantile([], 0.5))


def test_the_worst_tenth_is_a_mean_of_the_lowest():
    assert worst_tenth([5.0, 2.0, 9.0]) == 2.0
    assert worst_tenth([float(i) for i in range(20)]) == 0.5
    # One and a half of fifteen values: the second counts half.
    assert worst_tenth([float(i) for i in range(15)]) == pytest.approx(0.5 / 1.5)
    assert math.isnan(worst_tenth([]))


def test_breakdown_is_the_first_severity_with_more_failures_than_not():
    assert breakdown({3.0: 0.6, 0.0: 0.0, 2.0: 0.5, 5.0: 0.2}) == 3.0
    assert breakdown({0.0: 0.0, 1.0: 0.5}) is None
