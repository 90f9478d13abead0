"""Bodies: single shapes of any kind, the building blocks of objects."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from svim3d.synthesis.dice import Dice
from svim3d.synthesis.outlines import SEGMENTS, polygon, random_outline, random_profile
from svim3d.synthesis.shapes import Shape, circle, extrusion, lathe, superquadric
from svim3d.synthesis.solids import random_solid


@dataclass(frozen=True)
class Part:
    """A shape and which of the object's materials it is made of."""

    shape: Shape
    material: int


def turned(axis: int, degrees: float) -> Float[Tensor, "3 3"]:
    """Rotation about a coordinate axis."""
    angle = math.radians(degrees)
    c, s = math.cos(angle), math.sin(angle)
    matrix = torch.eye(3)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    matrix[i, i] = matrix[j, j] = c
    matrix[i, j], matrix[j, i] = -s, s
    return matrix


def turned_at_random(dice: Dice) -> Float[Tensor, "3 3"]:
    """Any rotation, or one about an axis by a multiple of a quarter turn."""
    if dice.chance(0.5):
        return turned(dice.integer(0, 2), 90.0 * dice.integer(0, 3))
    q, _ = torch.linalg.qr(torch.stack([dice.direction() for _ in range(3)]))
    return q * torch.linalg.det(q)


def random_body(dice: Dice) -> Shape:
    """One shape of any kind, within about the cube of half side 1."""
    kind = dice.choice(("lathe", "superquadric", "extrusion", "solid", "box"), (2, 2, 2, 2, 1.5))
    if kind == "lathe":
        return lathe(random_profile(dice), circle(SEGMENTS))
    if kind == "superquadric":
        shape = superquadric(dice.logarithmic(0.15, 2.2), dice.logarithmic(0.15, 2.2), 20)
        return shape.placed(scale=dice.uniforms(0.4, 1.0, 3).tolist())
    if kind == "extrusion":
        height = dice.logarithmic(0.3, 1.8)
        return extrusion(random_outline(dice), height, dice.uniform(0.02, 0.15))
    if kind == "solid":
        return random_solid(dice)
    return box(*dice.uniforms(0.3, 1.0, 3).tolist(), bevel=dice.uniform(0.02, 0.12))


def box(x: float, y: float, z: float, *, bevel: float = 0.03) -> Shape:
    """A bevelled box of half sides x, y, z about the origin."""
    # A square of circumradius sqrt 2 has half side 1.
    outline = polygon(4, 4, math.pi / 4) * math.sqrt(2.0) * torch.tensor([x, z])
    return extrusion(outline, 2.0 * y, min(bevel, 0.5 * min(x, y, z)), rows=3)


def surface_point(shape: Shape, direction: Float[Tensor, "3"]) -> Float[Tensor, "3"]:
    """The vertex that lies farthest along a direction."""
    return shape.vertices[int((shape.vertices @ direction).argmax())]
