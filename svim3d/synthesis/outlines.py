"""Random curves: outlines seen whole from their centre, profiles of turned bodies, handles."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from svim3d.mesh.lathe import smooth_curve
from svim3d.synthesis.dice import Dice
from svim3d.synthesis.shapes import circle

SEGMENTS = 40  # around round bodies: facets of 9 degrees, smooth at 64 to 128 pixels


def polygon(sides: int, segments_per_side: int, turn: float) -> Float[Tensor, "S 2"]:
    """A regular polygon of circumradius 1, its sides cut evenly."""
    corners = circle(sides)
    cosine, sine = math.cos(turn), math.sin(turn)
    corners = corners @ torch.tensor([[cosine, sine], [-sine, cosine]])
    share = torch.arange(segments_per_side)[:, None] / segments_per_side
    sides_cut = torch.lerp(corners[:, None], corners.roll(-1, 0)[:, None], share)
    return sides_cut.reshape(-1, 2)


def radial(radii: Float[Tensor, "S"]) -> Float[Tensor, "S 2"]:
    """An outline by its distance from the centre."""
    return circle(len(radii)) * radii[:, None]


def random_outline(dice: Dice) -> Float[Tensor, "S 2"]:
    """Polygon, star, gear, flower, drop or rounded box; about unit radius."""
    kind = dice.choice(("polygon", "star", "gear", "flower", "drop", "box", "blob"))
    angle = torch.arange(96) * (2.0 * math.pi / 96)
    if kind == "polygon":
        return polygon(dice.integer(3, 8), 6, dice.uniform(0.0, 1.0))
    if kind == "star":
        points, depth = dice.integer(4, 8), dice.uniform(0.35, 0.7)
        radii = torch.ones(2 * points)
        radii[1::2] = depth
        star = radial(radii)
        share = torch.arange(5)[:, None] / 5.0
        return torch.lerp(star[:, None], star.roll(-1, 0)[:, None], share).reshape(-1, 2)
    if kind == "gear":
        teeth = dice.integer(6, 12)
        wave = (torch.sin(angle * teeth) * 4.0).clamp(-1.0, 1.0)
        return radial(0.9 + dice.uniform(0.06, 0.12) * wave)
    if kind == "flower":
        petals = dice.integer(3, 7)
        return radial(0.75 + dice.uniform(0.1, 0.25) * torch.cos(angle * petals))
    if kind == "drop":
        return radial(0.6 + 0.4 * (0.5 + 0.5 * angle.cos()).pow(dice.uniform(2.0, 8.0)))
    if kind == "box":
        # A superellipse, stretched.
        power = dice.uniform(0.15, 0.5)
        c, s = angle.cos(), angle.sin()
        x, z = c.sign() * c.abs().pow(power), s.sign() * s.abs().pow(power)
        return torch.stack([x, z * dice.uniform(0.3, 1.0)], 1)
    radii = torch.ones_like(angle)
    for harmonic in range(1, 5):
        amplitude = dice.uniform(0.0, 0.25) / harmonic
        radii = radii + amplitude * torch.sin(harmonic * angle + dice.uniform(0.0, 6.3))
    return radial(radii)


def random_profile(dice: Dice) -> Float[Tensor, "M 2"]:
    """(radius, height) of a solid turned body, height from -1 to 1, largest radius about 0.3 to 1.

    A few knots, some of them doubled to make sharp edges.
    """
    count = dice.integer(3, 7)
    heights = torch.linspace(-1.0, 1.0, count + 2)[1:-1]
    heights = (heights + dice.uniforms(-0.5, 0.5, count) / (count + 2)).sort().values
    knots = [(0.02, -1.0), (dice.uniform(0.2, 0.9), -1.0)]
    for height in heights.tolist():
        radius = dice.uniform(0.15, 1.0)
        knots.append((radius, height))
        if dice.chance(0.4):
            knots.append((radius, height))  # given twice: a corner
            if dice.chance(0.5):
                knots.extend([(radius * dice.uniform(0.55, 0.9), height)] * 2)
    knots += [(dice.uniform(0.05, 0.8), 1.0), (0.02, 1.0)]
    width = dice.logarithmic(0.35, 1.1)
    points = torch.tensor(knots) * torch.tensor([width, 1.0])
    return _without_repeats(smooth_curve(points, 2)[0])


def vessel_profile(dice: Dice) -> Float[Tensor, "M 2"]:
    """(radius, height) of a hollow pot: up the outside, over the rim, down the inside."""
    foot, belly, neck, rim = (dice.uniform(0.3, 0.7) for _ in range(4))
    belly, rim = belly + dice.uniform(0.0, 0.4), rim + dice.uniform(0.0, 0.3)
    wall, middle = dice.uniform(0.05, 0.1), dice.uniform(-0.5, 0.2)
    outside = [(0.02, -1.0), (foot, -1.0), (foot, -1.0), (belly, middle), (neck, 0.55), (rim, 1.0)]
    inside = [
        (rim - wall, 1.0),
        (neck - wall, 0.55),
        (belly - wall, middle),
        (max(0.1, foot - wall), -0.85),
        (0.02, -0.85),
    ]
    width = dice.logarithmic(0.45, 1.0)
    points = torch.tensor(outside + inside) * torch.tensor([width, 1.0])
    return _without_repeats(smooth_curve(points, 2)[0])


def handle_path(
    attach: float, low: float, high: float, reach: float, count: int = 24
) -> Float[Tensor, "M 3"]:
    """A bow in the x, y plane from (attach, low) out to `attach + reach` and back in at `high`."""
    t = torch.linspace(0.0, math.pi, count)
    x = attach + reach * t.sin().pow(0.7)
    y = 0.5 * (low + high) - 0.5 * (high - low) * t.cos()
    return torch.stack([x, y, torch.zeros_like(x)], 1)


def random_path(dice: Dice, count: int = 48) -> Float[Tensor, "M 3"]:
    """An open smooth curve through random points, or a spring."""
    if dice.chance(0.4):
        turns = dice.uniform(1.5, 4.0)
        t = torch.linspace(0.0, 1.0, int(count * 1.5))
        angle = 2.0 * math.pi * turns * t
        radius = 0.5 + dice.uniform(-0.35, 0.35) * t
        return torch.stack([radius * angle.cos(), 2.0 * t - 1.0, radius * angle.sin()], 1)
    controls = dice.uniforms(-1.0, 1.0, dice.integer(4, 6), 3)
    return smooth_curve(controls, 4)[0]


def _without_repeats(curve: Float[Tensor, "M 2"]) -> Float[Tensor, "m 2"]:
    """The curve without points that lie on the one before: their rings would have no area."""
    step = (curve[1:] - curve[:-1]).norm(dim=1)
    return torch.cat([curve[:1], curve[1:][step > 1e-4]])
