"""Dominance, the front and its knee, where the answer is known."""

import itertools
import math
import random

import pytest

from flows.chart_front import (
    AXES,
    CHAMFER,
    CPU,
    NOISE_SPREADS,
    NORMALS,
    RELIGHT,
    State,
    difference,
    knee,
    ladder,
    repeat_noise,
    standings,
)

ORBITS = ("a", "b", "c")


def figures_of(points, spread=None):
    """Points of (cpu_s, relight) on three orbits; an orbit's own offset is shared by all points."""
    spread = spread or {}
    return {
        name: {
            orbit: {
                "cpu_s": cost * factor,
                "relight_delta_db": gain + offset + spread.get((name, orbit), 0.0),
            }
            for orbit, factor, offset in zip(ORBITS, (1.0, 3.0, 0.5), (0.0, -4.0, 2.0), strict=True)
        }
        for name, (cost, gain) in points.items()
    }


def states(figures, noise=None):
    found = standings(figures, (CPU, RELIGHT), noise or {})
    return {name: (standing.state, standing.by) for name, standing in found.items()}


@pytest.mark.parametrize("axis", AXES, ids=lambda axis: axis.name)
def test_badness_is_undone_and_falls_to_the_better(axis):
    assert axis.value(axis.badness(3.0)) == pytest.approx(3.0)
    assert (axis.badness(4.0) < axis.badness(3.0)) is axis.more_is_better


def test_a_known_front_is_found():
    found = states(
        figures_of(
            {"fast": (10, 1), "mid": (20, 3), "best": (80, 4), "bad": (30, 2), "worse": (90, 0)}
        )
    )
    assert {n for n, (state, _) in found.items() if state is State.FRONT} == {"fast", "mid", "best"}
    assert found["bad"] == (State.DOMINATED, "mid")
    # Everything is ahead of it; the cheapest of what nothing is ahead of is named.
    assert found["worse"] == (State.DOMINATED, "fast")


def test_ties_dominate_nothing_and_half_ties_do():
    found = states(
        figures_of({"one": (10, 1), "twin": (10, 1), "dear": (11, 1), "poor": (10, 0.5)})
    )
    assert found["one"][0] is found["twin"][0] is State.FRONT
    assert found["dear"][0] is found["poor"][0] is State.DOMINATED


def test_a_difference_within_the_noise_dominates_nothing():
    figures = figures_of({"base": (10, 1.0), "same": (10, 0.95)})
    assert states(figures)["same"] == (State.DOMINATED, "base")
    assert states(figures, {"relight_delta_db": 0.1})["same"] == (State.DOUBTFUL, "base")
    assert states(figures, {"relight_delta_db": 0.1})["base"] == (State.FRONT, "")


def test_orbits_that_disagree_decide_nothing():
    # Better by a decibel in the mean, but worse on one of three: a third of resamples' thirds.
    spread = {("maybe", "a"): -1.0, ("maybe", "b"): 3.0, ("maybe", "c"): 1.0}
    figures = figures_of({"base": (10, 1.0), "maybe": (10, 1.0)}, spread)
    assert states(figures)["base"] == (State.DOUBTFUL, "maybe")
    apart = difference(figures, "maybe", "base", RELIGHT)
    assert (apart.mean, apart.low, apart.high) == pytest.approx((-1.0, -3.0, 1.0))
    # Without the one that disagrees it is clear.
    spread["maybe", "a"] = 0.5
    figures = figures_of({"base": (10, 1.0), "maybe": (10, 1.0)}, spread)
    assert states(figures)["base"] == (State.DOMINATED, "maybe")


def test_orbits_may_differ_by_anything_that_points_share():
    # Paired differences: offsets of orbits up to 6 dB, and a factor of six in time, cancel.
    apart = difference(figures_of({"p": (20, 1.5), "q": (10, 1.0)}), "p", "q", CPU)
    assert (apart.low, apart.mean, apart.high) == pytest.approx((math.log(2),) * 3)


def test_dominance_has_no_circles_and_the_front_is_never_empty():
    dice = random.Random(3)
    for _ in range(20):
        points = {str(i): (dice.uniform(1, 100), dice.uniform(0, 5)) for i in range(12)}
        spread = {(n, o): dice.gauss(0, 2) for n, o in itertools.product(points, ORBITS)}
        found = states(figures_of(points, spread), {"relight_delta_db": 0.3})
        assert any(state is State.FRONT for state, _ in found.values())
        for name in points:
            seen = []
            while (by := found[name][1]) and name not in seen:
                seen.append(name)
                name = by
            assert name not in seen


def test_many_axes_dominate_only_where_all_agree():
    values = {"cpu_s": 10.0, "relight_delta_db": 1.0, "normal_deg": 5.0, "distance": 0.01}
    good = {o: values for o in ORBITS}
    dear = {o: values | {"cpu_s": 20.0} for o in ORBITS}
    mixed = {o: values | {"cpu_s": 20.0, "normal_deg": 4.9} for o in ORBITS}
    axes = (CPU, RELIGHT, NORMALS, CHAMFER)
    found = standings({"good": good, "dear": dear, "mixed": mixed}, axes, {})
    assert found["dear"].state is State.DOMINATED
    assert found["mixed"].state is found["good"].state is State.FRONT


def test_repeats_tell_the_noise_of_a_mean_of_differences():
    # Two seeds a decibel apart on each of four orbits: a variance of 1/2, of a difference of means
    # of four 2 * 1/2 / 4.
    repeats = [
        [{"relight_delta_db": level}, {"relight_delta_db": level + 1.0}] for level in range(4)
    ]
    assert repeat_noise(repeats, RELIGHT) == pytest.approx(NOISE_SPREADS * 0.5)
    assert repeat_noise([[{"relight_delta_db": 1.0}]], RELIGHT) == 0.0
    factors = [[{"cpu_s": 10.0}, {"cpu_s": 10.0 * math.e}]]
    assert repeat_noise(factors, CPU) == pytest.approx(NOISE_SPREADS * math.sqrt(0.5 * 2.0))


def test_repeated_measurements_exceed_their_own_noise_as_rarely_as_three_spreads_say():
    dice = random.Random(0)
    beyond = 0
    for _ in range(2000):
        repeats = [[{"relight_delta_db": dice.gauss(0, 1)} for _ in range(6)] for _ in range(5)]
        noise = repeat_noise(repeats, RELIGHT)
        apart = sum(dice.gauss(0, 1) - dice.gauss(0, 1) for _ in range(5)) / 5
        beyond += abs(apart) > noise
    # Beyond three by Student's law of 25 degrees of freedom: 0.6 %.
    assert 4 <= beyond <= 24


def test_a_ladder_leaves_out_steps_that_gain_too_little():
    figures = figures_of({"a": (10, 1.0), "b": (20, 1.05), "c": (40, 2.0), "off": (50, 1.5)})
    assert ladder(figures, CPU, RELIGHT, {}) == ["a", "b", "c"]
    assert ladder(figures, CPU, RELIGHT, {"relight_delta_db": 0.1}) == ["a", "c"]
    assert ladder({}, CPU, RELIGHT, {}) == []


def test_the_knee_is_farthest_above_the_chord():
    # Cost in octaves 0, 1, 2, 3; the chord rises by 1 an octave.
    figures = figures_of({"a": (10, 0.0), "b": (20, 2.0), "c": (40, 2.6), "d": (80, 3.0)})
    assert knee(figures, ["a", "b", "c", "d"], CPU, RELIGHT) == "b"
    figures = figures_of({"a": (10, 0.0), "b": (20, 1.1), "c": (40, 2.6), "d": (80, 3.0)})
    assert knee(figures, ["a", "b", "c", "d"], CPU, RELIGHT) == "c"
    assert knee(figures, ["a", "d"], CPU, RELIGHT) == "d"
