"""Camera paths and the distance that fits an object into all views."""

import itertools
import math

import pytest
import torch

from svim3d.cameras import orbit_cameras
from svim3d.synthesis.bodies import random_body
from svim3d.synthesis.dice import Dice
from svim3d.synthesis.trajectories import (
    BORDER,
    FILL,
    HIGHEST_DEG,
    LOWEST_DEG,
    MAX_ELEVATION_DEG,
    STATIC_SHARE,
    fitting_distance,
    random_trajectory,
)

FOV_DEG = 33.8


def draws(count):
    return [random_trajectory(Dice.of(0, i), 21) for i in range(count)]


def is_static(path):
    return len(set(path.elevation_deg)) == 1


def test_static_paths_are_the_plain_orbit():
    path = next(p for p in draws(20) if is_static(p))
    expected = [360.0 * (k + 1) / 21 for k in range(20)] + [0.0]
    assert path.azimuth_deg == pytest.approx(expected)
    assert LOWEST_DEG <= path.elevation_deg[0] <= HIGHEST_DEG


def test_dynamic_paths_ascend_and_end_at_the_reference():
    for path in draws(60):
        azimuth = path.azimuth_deg
        assert azimuth[-1] == 0.0
        assert all(a < b for a, b in itertools.pairwise(azimuth[:-1]))
        assert azimuth[0] > 0.0 and azimuth[-2] < 360.0
        assert max(map(abs, path.elevation_deg)) <= MAX_ELEVATION_DEG


def test_most_paths_are_static():
    share = sum(map(is_static, draws(400))) / 400
    # Three standard deviations of a binomial of 400.
    assert abs(share - STATIC_SHARE) < 3.0 * math.sqrt(STATIC_SHARE * (1 - STATIC_SHARE) / 400)


def projected(vertices, angles, radius):
    cameras = orbit_cameras(angles, radius=radius, fov_y_deg=FOV_DEG, size=64)
    clip = cameras.project(vertices)
    return clip[..., :2] / clip[..., 3:]


@pytest.mark.parametrize("seed", range(8))
def test_the_object_fills_the_reference_view_or_touches_the_border(seed):
    vertices = random_body(Dice.of(1, seed)).vertices
    angles = random_trajectory(Dice.of(2, seed), 21).angles
    near = orbit_cameras(angles, radius=1.0, fov_y_deg=FOV_DEG, size=64)
    radius = fitting_distance(vertices, near.c2w[:, :3, :3], FOV_DEG)
    ndc = projected(vertices, angles, radius)
    reach = float(ndc.abs().max())
    fill = float((ndc[-1].amax(0) - ndc[-1].amin(0)).max()) / 2.0
    assert reach <= BORDER + 1e-4
    assert fill <= FILL + 1e-4
    assert fill == pytest.approx(FILL, abs=1e-4) or reach == pytest.approx(BORDER, abs=1e-4)


def test_a_centred_sphere_fills_exactly():
    # Points of a sphere of radius 1/2; its outline has the half angle asin(1 / (2 r)).
    generator = torch.Generator().manual_seed(0)
    points = 0.5 * torch.nn.functional.normalize(torch.randn(20000, 3, generator=generator), dim=1)
    near = orbit_cameras([(0.0, 90.0), (0.0, 0.0)], radius=1.0, fov_y_deg=FOV_DEG, size=64)
    radius = fitting_distance(points, near.c2w[:, :3, :3], FOV_DEG)
    half = math.atan(FILL * math.tan(math.radians(FOV_DEG) / 2.0))
    # Random points miss the outline by a little, which lets the camera come nearer.
    assert radius == pytest.approx(0.5 / math.sin(half), rel=2e-3)
