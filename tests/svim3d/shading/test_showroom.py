import math

import pytest
import torch

from svim3d.numerics import normalize
from svim3d.shading.environment import direction_from_latlong
from svim3d.shading.showroom import (
    CLOUDS,
    GROUND,
    LAMPS,
    NIGHT,
    SUN_DIRECTION,
    SUN_IRRADIANCE,
    night,
    noon,
    overcast,
)


def sphere(rows=400):
    """Directions over the sphere and the solid angle of each."""
    v, u = torch.meshgrid(
        (torch.arange(rows) + 0.5) / rows,
        (torch.arange(2 * rows) + 0.5) / (2 * rows),
        indexing="ij",
    )
    cell = math.pi / rows
    return direction_from_latlong(torch.stack([u, v], -1)), torch.sin(v * math.pi)[
        ..., None
    ] * cell**2


def test_the_sun_brings_the_irradiance_that_is_promised():
    direction, omega = sphere()
    sun = normalize(torch.tensor(SUN_DIRECTION))
    near = (direction @ sun)[..., None] > math.cos(math.radians(6.0))
    cosine = (direction @ sun)[..., None].clamp_min(0.0)
    sky = noon(normalize(sun + torch.tensor([0.0, 0.0, 0.25])))  # beside the sun
    brought = ((noon(direction) - sky) * near * cosine * omega).sum((0, 1))
    # The smooth edge of 0.8 degrees leaves a few percent open.
    assert torch.allclose(brought, torch.tensor(SUN_IRRADIANCE), rtol=0.08)


def test_clouds_are_three_times_as_bright_above_as_at_the_horizon():
    up = overcast(torch.tensor([0.0, 1.0, 0.0]))
    side = overcast(normalize(torch.tensor([1.0, 0.2, 0.0])))
    assert torch.allclose(up, torch.full((3,), CLOUDS))
    height = 0.2 / math.sqrt(1.04)
    assert torch.allclose(side, torch.full((3,), CLOUDS * (1.0 + 2.0 * height) / 3.0), rtol=1e-5)
    down = overcast(torch.tensor([0.0, -1.0, 0.0]))
    assert torch.allclose(down, torch.tensor(GROUND) * CLOUDS / 3.0)


@pytest.mark.parametrize("lamp", LAMPS)
def test_lamps_shine_where_they_hang_and_the_rest_is_dark(lamp):
    centre, half_angle_deg, colour = lamp
    middle = normalize(torch.tensor(centre))
    assert torch.allclose(night(middle), torch.tensor(colour) + torch.tensor(NIGHT))
    across = normalize(torch.linalg.cross(middle, torch.tensor([0.0, 1.0, 0.0])))
    beyond = math.radians(half_angle_deg + 3.0)
    outside = math.cos(beyond) * middle + math.sin(beyond) * across
    assert torch.allclose(night(outside), torch.tensor(NIGHT))


def test_radiance_is_never_negative():
    direction, _ = sphere(64)
    for light in (noon, overcast, night):
        assert float(light(direction).min()) >= 0.0
