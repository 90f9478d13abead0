"""Random surroundings: skies, suns, soft boxes and rooms, as octahedral maps of radiance."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from svim3d.numerics import normalize, smoothstep
from svim3d.shading.octahedral import texel_directions
from svim3d.synthesis.dice import Dice

SIZE = 32  # texels per side; a texel is about 4 degrees wide


def random_light(dice: Dice, size: int = SIZE) -> Float[Tensor, "size size 3"]:
    """Linear radiance from all directions: a dim base and what shines in it."""
    directions = texel_directions(size)
    radiance = gradient(dice, directions)
    kind = dice.choice(("boxes", "sun", "soft", "mixture"), (3.0, 2.0, 1.0, 2.0))
    if kind in ("boxes", "mixture"):
        for _ in range(dice.integer(1, 6)):
            radiance = radiance + soft_box(dice, directions)
    if kind in ("sun", "mixture"):
        radiance = radiance + sun(dice, directions)
    return radiance.clamp_min(0.0)


def gradient(dice: Dice, directions: Float[Tensor, "n n 3"]) -> Float[Tensor, "n n 3"]:
    """From ground to sky, with a glow around the horizon and darker and brighter sides."""
    height = directions[..., 1:2]
    sky, ground = (
        tint(dice, 0.5) * dice.uniform(0.3, 1.2),
        tint(dice, 0.5) * dice.uniform(0.05, 0.5),
    )
    share = smoothstep(0.5 + height / dice.uniform(0.1, 1.5))
    radiance = ground + share * (sky - ground)
    glow = torch.exp(-((height / dice.uniform(0.08, 0.4)) ** 2))
    radiance = radiance + dice.uniform(0.0, 0.6) * glow * tint(dice, 0.5)
    for _ in range(2):
        side = (directions @ dice.direction())[..., None]
        radiance = radiance * (1.0 + dice.uniform(0.0, 0.7) * side)
    return radiance


def soft_box(dice: Dice, directions: Float[Tensor, "n n 3"]) -> Float[Tensor, "n n 3"]:
    """A rectangle with soft edges, mostly above the horizon."""
    centre = dice.direction()
    if dice.chance(0.8):
        centre = torch.stack([centre[0], centre[1].abs(), centre[2]])
    right = normalize(torch.linalg.cross(torch.tensor([0.0, 1.0, 1e-3]), centre))
    up = torch.linalg.cross(centre, right)
    depth = (directions @ centre)[..., None]
    inside = (depth > 0.0).to(directions)
    for axis in (right, up):
        angle = torch.atan2((directions @ axis)[..., None].abs(), depth)
        width = math.radians(dice.logarithmic(6.0, 45.0))
        inside = inside * smoothstep(0.5 - (angle - width) / math.radians(dice.uniform(6.0, 25.0)))
    return dice.logarithmic(1.0, 12.0) * inside * tint(dice, 0.5)


def sun(dice: Dice, directions: Float[Tensor, "n n 3"]) -> Float[Tensor, "n n 3"]:
    """A round lamp of random size: small and fierce, or broad and mild."""
    azimuth = dice.uniform(0.0, 2.0 * math.pi)
    elevation = math.radians(dice.uniform(5.0, 80.0))
    centre = torch.tensor(
        [
            math.cos(elevation) * math.sin(azimuth),
            math.sin(elevation),
            math.cos(elevation) * math.cos(azimuth),
        ]
    )
    radius = math.radians(dice.logarithmic(3.0, 25.0))
    cosine = (directions @ centre)[..., None].clamp(-1.0, 1.0)
    disc = smoothstep(0.5 - (torch.acos(cosine) - radius) / math.radians(5.0))
    # Irradiance of 0.5 to 4 whatever the size.
    solid_angle = 2.0 * math.pi * (1.0 - math.cos(radius + math.radians(1.0)))
    halo = 0.15 * torch.exp((cosine - 1.0) * 12.0)
    return (dice.logarithmic(0.5, 4.0) / solid_angle * disc + halo) * tint(dice, 0.4)


def tint(dice: Dice, strength: float) -> Float[Tensor, "3"]:
    """Colour of a lamp: from warm to cool, sometimes of any hue; its mean is 1."""
    if dice.chance(0.15):
        colour = 1.0 + strength * dice.uniforms(-1.0, 1.0, 3)
    else:
        warmth = dice.uniform(-strength, strength)
        colour = torch.tensor([1.0 + warmth, 1.0 + 0.15 * warmth, 1.0 - warmth])
    return colour.clamp_min(0.05) / colour.clamp_min(0.05).mean()
