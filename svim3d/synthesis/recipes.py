"""Recipes: how bodies are put together to pots, chairs, creatures, machines and heaps.

A recipe draws its parts anywhere and of any size; `objects` centres and scales the whole.
"""

import math
from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from svim3d.synthesis.bodies import Part, box, random_body, surface_point, turned, turned_at_random
from svim3d.synthesis.dice import Dice
from svim3d.synthesis.outlines import (
    SEGMENTS,
    handle_path,
    polygon,
    random_outline,
    random_path,
    random_profile,
    vessel_profile,
)
from svim3d.synthesis.shapes import Shape, circle, extrusion, lathe, superquadric, tube

Recipe = Callable[[Dice], list[Part]]


def single(dice: Dice) -> list[Part]:
    """One body, turned somehow; a knob or two so that it has a front."""
    body = random_body(dice).placed(rotation=turned_at_random(dice))
    parts = [Part(body, 0)]
    for _ in range(dice.integer(0, 3)):
        direction = dice.direction()
        place = surface_point(body, direction)
        knob = random_body(dice).placed(
            scale=[dice.uniform(0.15, 0.35)] * 3,
            rotation=turned_at_random(dice),
            offset=place.tolist(),
        )
        parts.append(Part(knob, dice.integer(0, 2)))
    return parts


def stack(dice: Dice) -> list[Part]:
    """Two to five bodies, one on top of the other, each turned about the upright axis."""
    parts, top = [], 0.0
    for _ in range(dice.integer(2, 5)):
        size = dice.uniform(0.35, 1.0)
        shape = random_body(dice).placed(
            scale=(size, size * dice.uniform(0.4, 0.9), size),
            rotation=turned(1, dice.uniform(0.0, 360.0)),
        )
        low, high = shape.bounds
        shift = dice.uniforms(-0.15, 0.15, 2).tolist()
        # A little overlap, so that no gap shows between curved ends.
        up = top - float(low[1]) - 0.06
        parts.append(Part(shape.placed(offset=(shift[0], up, shift[1])), dice.integer(0, 3)))
        top = up + float(high[1])
    return parts


def vessel(dice: Dice) -> list[Part]:
    """A pot, mug, jug or vase: hollow, with handles, a spout, a lid."""
    hollow = dice.chance(0.7)
    profile = vessel_profile(dice) if hollow else random_profile(dice)
    fluted = dice.chance(0.2)
    outline = circle(SEGMENTS)
    if fluted:
        wave = torch.cos(torch.arange(96) * (2.0 * math.pi / 96) * dice.integer(6, 14))
        outline = circle(96) * (0.96 + 0.04 * wave)[:, None]
    parts = [Part(lathe(profile, outline), 0)]
    outer = profile[profile[:, 1] < 0.95]
    handles = dice.choice((0, 1, 2), (0.25, 0.55, 0.2))
    low, high = dice.uniform(-0.6, -0.2), dice.uniform(0.2, 0.7)
    thickness = dice.uniform(0.05, 0.11)
    attach = min(_radius_at(outer, low), _radius_at(outer, high)) - 0.02
    path = handle_path(attach, low, high, dice.uniform(0.3, 0.6) * (high - low) + 0.1)
    rim = circle(10) * torch.tensor([1.0, dice.uniform(1.0, 2.0)])
    handle = tube(path, torch.full((len(path),), thickness), rim)
    material = dice.integer(0, 1)
    for index in range(handles):
        parts.append(Part(handle.placed(rotation=turned(1, 180.0 * index)), material))
    if dice.chance(0.35):
        parts.append(Part(_spout(dice, outer), dice.integer(0, 1)))
    if dice.chance(0.35):
        radius = float(profile[profile[:, 1] > 0.9][:, 0].max()) + 0.03
        lid = lathe(random_profile(dice), circle(SEGMENTS))
        width = float(lid.bounds[1][0])
        scale = (radius / width, dice.uniform(0.15, 0.4), radius / width)
        parts.append(Part(lid.placed(scale=scale, offset=(0.0, 1.0 + 0.8 * scale[1], 0.0)), 2))
    return parts


def _radius_at(profile: Float[Tensor, "M 2"], height: float) -> float:
    """Radius of the profile's point nearest in height."""
    return float(profile[int((profile[:, 1] - height).abs().argmin()), 0])


def _spout(dice: Dice, profile: Float[Tensor, "M 2"]) -> Shape:
    """A bent tube that narrows, on the side away from the first handle."""
    start = dice.uniform(-0.4, 0.1)
    attach = _radius_at(profile, start) - 0.08
    t = torch.linspace(0.0, 1.0, 16)
    x = attach + dice.uniform(0.5, 0.8) * t
    y = start + dice.uniform(0.7, 1.1) * t * t.sqrt()
    path = torch.stack([x, y, torch.zeros_like(x)], 1)
    shape = tube(path, 0.2 - 0.12 * t, circle(14))
    return shape.placed(rotation=turned(1, dice.choice((180.0, 90.0, 135.0))))


def furniture(dice: Dice) -> list[Part]:
    """A slab on legs: table, stool, chair, bench, bed; a back and arms at times."""
    wide, deep, tall = dice.uniform(0.5, 1.0), dice.uniform(0.4, 0.9), dice.uniform(0.3, 1.0)
    thick = dice.uniform(0.05, 0.18)
    if dice.chance(0.6):
        seat = box(wide, thick, deep, bevel=dice.uniform(0.01, 0.06))
    else:
        seat = extrusion(random_outline(dice), 2.0 * thick, 0.04).placed(scale=(wide, 1.0, deep))
    parts = [Part(seat, 0)]
    if dice.chance(0.5):
        leg_radius, spread = dice.uniform(0.04, 0.1), dice.uniform(1.0, 1.3)
        for sx in (-1, 1):
            for sz in (-1, 1):
                foot = [sx * wide * 0.8 * spread, -tall - thick, sz * deep * 0.8 * spread]
                path = torch.lerp(
                    torch.tensor([sx * wide * 0.7, 0.0, sz * deep * 0.7]),
                    torch.tensor(foot),
                    torch.linspace(0.0, 1.0, 8)[:, None],
                )
                radii = torch.linspace(leg_radius, leg_radius * 0.7, 8)
                parts.append(Part(tube(path, radii, circle(10)), 1))
    else:
        column = lathe(random_profile(dice), circle(SEGMENTS))
        width = dice.uniform(0.3, 0.6)
        scale = (width, 0.5 * tall, width)
        parts.append(Part(column.placed(scale=scale, offset=(0.0, -0.5 * tall - thick, 0.0)), 1))
    if dice.chance(0.6):
        height = dice.uniform(0.3, 0.9)
        back = box(wide * 0.95, 0.5 * height, thick * 0.7)
        parts.append(
            Part(
                back.placed(rotation=turned(0, -8.0), offset=(0.0, 0.5 * height, -deep)),
                dice.integer(0, 2),
            )
        )
        if dice.chance(0.5):
            for side in (-1, 1):
                arm = box(thick * 0.8, 0.25 * height, deep * 0.8)
                parts.append(Part(arm.placed(offset=(side * wide, 0.25 * height, 0.0)), 2))
    return parts


def creature(dice: Dice) -> list[Part]:
    """A body with a head and mirrored limbs: toy, animal, robot, aircraft."""
    size = dice.uniforms(0.4, 0.9, 3)
    body = superquadric(dice.logarithmic(0.3, 1.3), dice.logarithmic(0.3, 1.3), 18)
    parts = [Part(body.placed(scale=size.tolist()), 0)]
    head = random_body(dice).placed(rotation=turned(1, 90.0 * dice.integer(0, 3)))
    where = torch.tensor([0.0, float(size[1]) * dice.uniform(0.5, 1.2), float(size[2]) * 0.9])
    parts.append(Part(head.placed(scale=[dice.uniform(0.25, 0.5)] * 3, offset=where.tolist()), 1))
    for _ in range(dice.integer(1, 3)):
        limb = random_body(dice).placed(
            scale=(dice.uniforms(0.08, 0.3, 3) * torch.tensor([1.0, 2.0, 1.0])).tolist(),
            rotation=turned(dice.choice((0, 2)), dice.uniform(-60.0, 60.0)),
        )
        offset = torch.tensor(
            [
                float(size[0]) * 0.9,
                dice.uniform(-0.9, 0.4) * float(size[1]),
                dice.uniform(-0.7, 0.7) * float(size[2]),
            ]
        )
        material = dice.integer(1, 3)
        parts.append(Part(limb.placed(offset=offset.tolist()), material))
        mirrored = limb.placed(offset=offset.tolist()).placed(scale=(-1.0, 1.0, 1.0))
        parts.append(Part(mirrored, material))
    eye = superquadric(1.0, 1.0, 8).placed(scale=[dice.uniform(0.05, 0.1)] * 3)
    for side in (-1, 1):
        place = surface_point(parts[1].shape, torch.tensor([0.5 * side, 0.35, 1.0]))
        parts.append(Part(eye.placed(offset=place.tolist()), 3))
    return parts


def wire(dice: Dice) -> list[Part]:
    """A bent tube or spring on a foot, with a ball at its end."""
    path = random_path(dice)
    radius = dice.uniform(0.08, 0.22)
    swell = 1.0 + dice.uniform(-0.4, 0.4) * torch.linspace(-1.0, 1.0, len(path))
    outline = circle(16) * torch.tensor([1.0, dice.uniform(0.7, 1.6)])
    parts = [Part(tube(path, radius * swell, outline), 0)]
    for end in (path[0], path[-1]):
        if dice.chance(0.7):
            scale = [dice.uniform(1.5, 3.0) * radius] * 3
            cap = random_body(dice).placed(scale=scale, offset=end.tolist())
            parts.append(Part(cap, dice.integer(0, 2)))
    return parts


def rings(dice: Dice) -> list[Part]:
    """Closed loops through each other or about a core: chains, wheels, frames."""
    parts = []
    for _ in range(dice.integer(1, 3)):
        outline = random_outline(dice) * dice.uniform(0.55, 0.95)
        # Only the loop's length matters here, so an outline serves as a path.
        path = torch.stack([outline[:, 0], torch.zeros(len(outline)), outline[:, 1]], 1)
        section = polygon(dice.choice((4, 6, 16)), 2, 0.4)
        loop = tube(path, torch.full((len(path),), dice.uniform(0.08, 0.2)), section, joined=True)
        loop = loop.placed(
            rotation=turned_at_random(dice), offset=dice.uniforms(-0.3, 0.3, 3).tolist()
        )
        parts.append(Part(loop, dice.integer(0, 2)))
    if dice.chance(0.7):
        core = random_body(dice).placed(scale=[dice.uniform(0.25, 0.5)] * 3)
        parts.append(Part(core, dice.integer(0, 3)))
    return parts


def heap(dice: Dice) -> list[Part]:
    """Three to six bodies grown into each other anyhow."""
    parts = []
    for _ in range(dice.integer(3, 6)):
        shape = random_body(dice).placed(
            scale=[dice.uniform(0.25, 0.6)] * 3,
            rotation=turned_at_random(dice),
            offset=dice.uniforms(-0.5, 0.5, 3).tolist(),
        )
        parts.append(Part(shape, dice.integer(0, 3)))
    return parts


def machine(dice: Dice) -> list[Part]:
    """A box with things set into its sides: radio, camera, cart, house."""
    half = dice.uniforms(0.4, 1.0, 3)
    parts = [Part(box(*half.tolist(), bevel=dice.uniform(0.01, 0.12)), 0)]
    for _ in range(dice.integer(2, 6)):
        axis, side = dice.integer(0, 2), dice.choice((-1.0, 1.0))
        place = dice.uniforms(-0.65, 0.65, 3) * half
        place[axis] = side * half[axis]
        size = dice.uniform(0.12, 0.35)
        kind = dice.choice(("lathe", "extrusion", "box"))
        if kind == "lathe":
            detail = lathe(random_profile(dice), circle(24))
        elif kind == "extrusion":
            detail = extrusion(random_outline(dice), dice.uniform(0.3, 1.0), 0.08)
        else:
            detail = box(1.0, dice.uniform(0.2, 0.6), dice.uniform(0.4, 1.0))
        # Details stand along their own y axis.
        upright = {0: turned(2, -90.0), 1: torch.eye(3), 2: turned(0, 90.0)}[axis]
        detail = detail.placed(scale=[size] * 3, rotation=upright, offset=place.tolist())
        parts.append(Part(detail, dice.integer(0, 3)))
    return parts


RECIPES: tuple[tuple[Recipe, float], ...] = (
    (single, 2.0),
    (stack, 1.3),
    (vessel, 2.0),
    (furniture, 1.3),
    (creature, 1.6),
    (wire, 0.8),
    (rings, 0.8),
    (heap, 1.2),
    (machine, 1.8),
)
