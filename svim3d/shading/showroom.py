"""Lights to look at an asset in: analytic, each showing what another one hides.

A sun over a blue sky shows normals and gloss, an overcast sky the basecolor, lamps in the dark the
outline and how sharp the reflections are.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from svim3d.numerics import normalize, smoothstep

GROUND = (0.10, 0.085, 0.07)
ZENITH, HORIZON = (0.16, 0.33, 0.72), (0.62, 0.72, 0.85)
SUN_DIRECTION, SUN_RADIUS_DEG = (0.55, 0.62, 0.56), 3.0
SUN_IRRADIANCE = (2.9, 2.65, 2.3)  # on a surface that faces it
CLOUDS = 0.85  # radiance at the zenith; the horizon has a third of it (Moon and Spencer 1942)
NIGHT = (0.012, 0.014, 0.02)
# Direction, half angle in degrees, radiance: a warm key, a cool rim on either side.
LAMPS = (
    ((0.75, 0.45, 0.70), 13.0, (9.0, 6.2, 3.6)),
    ((-0.95, 0.25, -0.45), 11.0, (3.0, 5.2, 9.5)),
    ((0.80, 0.10, -0.85), 8.0, (7.0, 2.6, 5.6)),
)
EDGE_DEG = 2.5  # half width of a lamp's edge


def noon(direction: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """Linear radiance of a small sun in a clear sky above dull ground."""
    height = direction[..., 1:2]
    sky = _between(direction, HORIZON, ZENITH, height.clamp_min(0.0).sqrt())
    radiance = torch.where(height > 0.0, sky, direction.new_tensor(GROUND))
    radius = math.radians(SUN_RADIUS_DEG)
    solid_angle = 2.0 * math.pi * (1.0 - math.cos(radius))
    disc = _disc(direction, SUN_DIRECTION, SUN_RADIUS_DEG, edge_deg=0.8)
    return radiance + disc * direction.new_tensor(SUN_IRRADIANCE) / solid_angle


def overcast(direction: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """Linear radiance of even clouds above dull ground."""
    height = direction[..., 1:2]
    clouds = CLOUDS * (1.0 + 2.0 * height.clamp_min(0.0)) / 3.0
    share = smoothstep(0.5 + 5.0 * height)
    return _between(direction, GROUND, (1.0, 1.0, 1.0), share) * torch.where(
        height > 0.0, clouds, torch.full_like(height, CLOUDS / 3.0)
    )


def night(direction: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """Linear radiance of three coloured lamps in the dark."""
    radiance = direction.new_tensor(NIGHT).expand_as(direction)
    for centre, half_angle_deg, colour in LAMPS:
        disc = _disc(direction, centre, half_angle_deg, edge_deg=EDGE_DEG)
        radiance = radiance + disc * direction.new_tensor(colour)
    return radiance


def _disc(
    direction: Float[Tensor, "*batch 3"],
    centre: tuple[float, float, float],
    half_angle_deg: float,
    *,
    edge_deg: float,
) -> Float[Tensor, "*batch 1"]:
    """1 inside a round lamp, 0 outside, smooth between."""
    cosine = (direction @ normalize(direction.new_tensor(centre)))[..., None].clamp(-1.0, 1.0)
    angle_deg = torch.rad2deg(torch.acos(cosine))
    return smoothstep(0.5 - (angle_deg - half_angle_deg) / (2.0 * edge_deg))


def _between(
    like: Tensor,
    low: tuple[float, float, float],
    high: tuple[float, float, float],
    share: Float[Tensor, "*batch 1"],
) -> Float[Tensor, "*batch 3"]:
    """Colours between two."""
    start, end = like.new_tensor(low), like.new_tensor(high)
    return start + share * (end - start)
