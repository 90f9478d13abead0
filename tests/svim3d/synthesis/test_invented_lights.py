"""Invented surroundings."""

import pytest
import torch

from svim3d.shading.octahedral import texel_directions
from svim3d.synthesis.dice import Dice
from svim3d.synthesis.lights import random_light, sun, tint


@pytest.mark.parametrize("seed", range(12))
def test_lights_are_physical_and_shine(seed):
    radiance = random_light(Dice.of(0, seed))
    assert bool(torch.isfinite(radiance).all())
    assert float(radiance.min()) >= 0.0 and float(radiance.mean()) > 0.01


def test_lights_differ():
    maps = torch.stack([random_light(Dice.of(0, i)) for i in range(4)])
    assert len({float(m.mean()) for m in maps}) == 4


def test_tints_keep_brightness():
    for i in range(20):
        assert float(tint(Dice.of(0, i), 0.5).mean()) == pytest.approx(1.0, abs=1e-5)


def test_the_sun_stands_above_the_horizon():
    directions = texel_directions(32)
    for i in range(10):
        lamp = sun(Dice.of(3, i), directions).sum(-1)
        brightest = directions.reshape(-1, 3)[int(lamp.reshape(-1).argmax())]
        assert float(brightest[1]) > 0.0
