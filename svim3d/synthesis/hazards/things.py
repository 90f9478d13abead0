"""The things that trials show: closed bodies of known topology, painted by position."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from svim3d.mesh.source_mesh import SourceMaterial, SourceMesh, complete, merge, normalised
from svim3d.synthesis.bodies import turned
from svim3d.synthesis.dice import Dice
from svim3d.synthesis.shapes import Shape, circle, creased, superquadric, tube
from svim3d.synthesis.solids import (
    capsule,
    ellipsoid,
    grid_points,
    rounded_box,
    shape_from_distance,
    smooth_difference,
    smooth_union,
    torus,
)

Paint = Callable[[Float[Tensor, "N 3"]], Float[Tensor, "N 3"]]

PLASTIC = SourceMaterial(roughness_factor=0.5, metallic_factor=0.0)
STEEL = SourceMaterial(roughness_factor=0.35, metallic_factor=1.0)
STRIPES = 3.0  # of each colour across the object
EVEN = (0.45, 0.42, 0.4)  # linear colour of what has no pattern


def striped(dice: Dice) -> Paint:
    """Soft stripes of two random colours across a random direction, darkened in patches."""
    one, two = dice.uniforms(0.05, 0.8, 3), dice.uniforms(0.05, 0.8, 3)
    across, along = dice.direction(), dice.direction()
    phase = dice.uniform(0.0, math.tau)

    def paint(points: Tensor) -> Tensor:
        wave = torch.sin(math.tau * STRIPES * (points @ across) + phase)[:, None]
        share = (0.5 + 2.0 * wave).clamp(0.0, 1.0)
        shade = 0.75 + 0.25 * torch.sin(math.tau * 2.0 * (points @ along))[:, None]
        return (one + share * (two - one)) * shade

    return paint


def even(colour: Sequence[float] = EVEN) -> Paint:
    """One colour all over."""
    return lambda points: points.new_tensor(colour).expand(len(points), 3)


def painted(
    shapes: Sequence[Shape], paint: Paint, materials: Sequence[SourceMaterial] = (PLASTIC,)
) -> SourceMesh:
    """Shapes as one normalised mesh; each is of the material of its number, else of the last.

    Paint is asked at positions of the normalised mesh.
    """
    parts = []
    for index, shape in enumerate(shapes):
        vertices, faces, normals = creased(shape)
        material = min(index, len(materials) - 1)
        parts.append(
            complete(
                vertices, faces, material=material, materials=tuple(materials), normals=normals
            )
        )
    mesh = normalised(merge(parts), "thing")
    return replace(mesh, colors=paint(mesh.vertices).contiguous())


def toy_shape(dice: Dice) -> Shape:
    """A body with a head on one side and an arm on the other: no two views look alike."""
    points = grid_points()
    body = rounded_box(points, torch.tensor([0.55, 0.6, 0.45]), dice.uniform(0.15, 0.3))
    head = ellipsoid(
        points - torch.tensor([dice.uniform(-0.2, 0.2), 0.72, 0.15]), dice.uniforms(0.28, 0.36, 3)
    )
    arm = capsule(
        points - torch.tensor([0.6, dice.uniform(-0.3, 0.2), -0.1]),
        torch.tensor([0.3, 0.22, 0.0]),
        0.15,
    )
    return shape_from_distance(smooth_union(smooth_union(body, head, 0.15), arm, 0.15))


def toy(
    seed: int, paint: Paint | None = None, materials: Sequence[SourceMaterial] = (PLASTIC,)
) -> SourceMesh:
    """The toy that most trials show; its form and paint are drawn."""
    dice = Dice.of(seed, 0)
    shape = toy_shape(dice)
    return painted([shape], paint or striped(dice), materials)


def ball_on_rods(width: float, seed: int) -> SourceMesh:
    """A ball that three rods of a width, as a share of the whole, cross."""
    dice = Dice.of(seed, 0)
    ball = superquadric(1.0, 1.0, 24).placed(scale=(0.28, 0.28, 0.28))
    line = torch.linspace(-0.5, 0.5, 24)[:, None] * torch.tensor([[0.0, 1.0, 0.0]])
    rods = []
    for axis, tilt in ((0, 0.0), (2, 62.0), (0, 55.0)):
        rod = tube(line, torch.full((len(line),), 0.5 * width), circle(12))
        turn = turned(1, dice.uniform(0.0, 360.0)) @ turned(axis, tilt)
        rods.append(rod.placed(rotation=turn))
    return painted([ball, *rods], striped(dice))


def slab(height: float, seed: int) -> SourceMesh:
    """A rounded block of a height, as a share of its length, that stands upright."""
    dice = Dice.of(seed, 0)
    block = superquadric(0.3, 0.5, 40).placed(scale=(0.5, 0.5 * height, 0.4))
    return painted([block], striped(dice))


def pierced(kind: str, opening: float, seed: int) -> SourceMesh:
    """Bodies with holes: `ring`, `mug`, `eight` (two holes), and `shell` with a hidden cavity.

    Args:
        kind: which.
        opening: width of the holes in the unit of `grid_points`, where the body's is about 2.
        seed: of the paint.
    """
    points = grid_points()
    bite = 0.5 * opening
    if kind == "shell":
        body = ellipsoid(points, torch.tensor([0.9, 0.8, 0.8]))
        sdf = smooth_difference(body, ellipsoid(points, torch.full((3,), bite)), 0.02)
    elif kind == "mug":
        body = rounded_box(points + torch.tensor([0.25, 0.0, 0.0]), torch.full((3,), 0.55), 0.2)
        thick = 0.16
        handle = torus(points - torch.tensor([0.35, 0.0, 0.0]), bite + thick, thick)
        sdf = smooth_union(body, handle, 0.05)
    else:
        count = 2 if kind == "eight" else 1
        sdf = rounded_box(points, torch.tensor([0.95, 0.6 if count == 2 else 0.95, 0.3]), 0.15)
        for place in (-0.45, 0.45) if count == 2 else (0.0,):
            off = points - torch.tensor([place, 0.0, 0.0])
            drill = bite - off[..., :2].norm(dim=-1)
            sdf = smooth_difference(sdf, drill, 0.05)
    return painted([shape_from_distance(sdf)], striped(Dice.of(seed, 0)))
