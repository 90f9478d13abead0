"""A plateau is where a loss falls by less than it must: against losses with a formula."""

import itertools
import math

import pytest

from stages.plateau import COOLING, LEAST_SHARE, WINDOWS, Plateau

STEPS, LEAST = 320, 0.02
WINDOW = STEPS // WINDOWS


def walked(plateau, loss, ctx, first=0):
    """Steps that are made, when the loss before step s is `loss(s)`."""
    made, step = [], first
    while step < STEPS:
        plateau.observe(step, loss(step))
        made.append(step)
        step = plateau.after(step, ctx)
    return made


def falling(share):
    """A loss that falls by `share` in every window."""
    return lambda step: math.exp(math.log1p(-share) * step / WINDOW)


def test_a_loss_that_falls_by_enough_makes_every_step(make_context):
    ctx = make_context("nerf")
    made = walked(Plateau(STEPS, LEAST), falling(1.05 * LEAST), ctx)
    assert made == list(range(STEPS))
    assert ctx.events == []


def test_one_that_falls_by_less_goes_on_to_the_cooling_and_says_so(make_context):
    ctx = make_context("nerf")
    plateau = Plateau(STEPS, LEAST)
    made = walked(plateau, falling(0.95 * LEAST), ctx)
    first, last = round(LEAST_SHARE * STEPS), round(COOLING * STEPS)
    assert made == [*range(first), *range(last, STEPS)]
    plateau.tell(ctx)
    assert [event["kind"] for event in ctx.events] == ["plateau", "capacity"]
    assert "has fallen by 1.9%" in ctx.events[0]["message"]
    assert ctx.events[1]["message"].startswith(f"steps {len(made)} of {STEPS}")


def test_it_is_seen_two_windows_after_it_begins(make_context):
    bend = 150

    def loss(step):
        return falling(0.2)(min(step, bend))

    made = walked(Plateau(STEPS, LEAST), loss, make_context("nerf"))
    jump = next(step for step, after in itertools.pairwise(made) if after > step + 1)
    assert bend + 2 * WINDOW <= jump <= bend + 3 * WINDOW


def test_each_part_of_the_schedule_is_begun(make_context):
    parts = (0.0, 0.5, 0.7, 0.95)
    made = walked(Plateau(STEPS, LEAST, parts), lambda step: 1.0, make_context("nerf"))
    begun = [0, round(0.5 * STEPS), round(0.7 * STEPS), round(COOLING * STEPS)]
    assert set(begun) <= set(made)
    # A part has to fill its windows before it can be left.
    assert set(range(begun[1], begun[1] + 3 * WINDOW)) <= set(made)
    # What begins after the cooling has is not left out either.
    assert made[-1] == STEPS - 1
    assert len(made) < STEPS


def test_a_resumed_one_goes_the_same_way(make_context):
    def loss(step):
        return falling(0.5 * LEAST)(step) * (1.0 + 0.001 * math.sin(step))

    parts = (0.0, 0.6)
    whole = walked(Plateau(STEPS, LEAST, parts), loss, make_context("nerf"))
    for stop in (40, 79, 100):
        plateau, ctx = Plateau(STEPS, LEAST, parts), make_context("nerf")
        step = 0
        for _ in range(stop):
            plateau.observe(step, loss(step))
            step = plateau.after(step, ctx)
        resumed = Plateau(STEPS, LEAST, parts)
        resumed.load_state(plateau.state())
        assert whole[:stop] + walked(resumed, loss, ctx, first=step) == whole


def test_a_loss_below_what_is_seen_falls_for_nothing(make_context):
    made = walked(Plateau(STEPS, LEAST, unseen=100.0), falling(0.5), make_context("nerf"))
    assert len(made) < STEPS
    assert walked(Plateau(STEPS, LEAST), falling(0.5), make_context("nerf")) == list(range(STEPS))


def test_windows_hold_whole_epochs():
    for steps, epoch in ((150, 21), (1500, 21), (38, 21), (60, 9)):
        assert Plateau(steps, LEAST, window=epoch)._window % epoch == 0


@pytest.mark.parametrize("loss", [lambda step: 1.0, lambda step: 1.0 + step])  # noisy ones rise
def test_without_a_least_fall_nothing_is_watched(loss, make_context):
    plateau, ctx = Plateau(STEPS, 0.0), make_context("nerf")
    assert walked(plateau, loss, ctx) == list(range(STEPS))
    plateau.tell(ctx)
    assert (plateau.state(), ctx.events) == ({}, [])
    plateau.load_state({})


@pytest.mark.parametrize("loss", [0.0, float("nan")])
def test_a_loss_of_no_size_changes_nothing(loss, make_context):
    made = walked(Plateau(STEPS, LEAST), lambda step: loss, make_context("nerf"))
    assert made[-1] == STEPS - 1
