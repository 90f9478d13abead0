"""Smooth solids: a signed distance put together from primitives, then cut by marching."""

import numpy as np
import scipy.ndimage
import torch
from jaxtyping import Float
from torch import Tensor

from svim3d.mesh.marching import extract_surface
from svim3d.synthesis.dice import Dice
from svim3d.synthesis.shapes import NO_CREASE_DEG, Shape

GRID = 36  # nodes per side: about 6 000 triangles, each a pixel or two at 64 pixels
HALF_EXTENT = 1.15


def smooth_union(a: Tensor, b: Tensor, blend: float) -> Tensor:
    """Union of distances (positive inside) with a fillet. Source: Quilez, "smooth minimum"."""
    h = ((blend - (a - b).abs()) / blend).clamp_min(0.0)
    return torch.maximum(a, b) + h * h * (0.25 * blend)


def smooth_difference(a: Tensor, b: Tensor, blend: float) -> Tensor:
    """What of `a` lies outside `b`, with rounded edges."""
    return -smooth_union(-a, b, blend)


def ellipsoid(points: Float[Tensor, "... 3"], radii: Float[Tensor, "3"]) -> Tensor:
    """About the distance to an ellipsoid, positive inside."""
    scaled = (points / radii).norm(dim=-1)
    return (1.0 - scaled) * float(radii.min())


def rounded_box(
    points: Float[Tensor, "... 3"], half: Float[Tensor, "3"], rounding: float
) -> Tensor:
    """Distance to a box with rounded edges, positive inside."""
    q = points.abs() - (half - rounding).clamp_min(0.02)
    outside = q.clamp_min(0.0).norm(dim=-1)
    return rounding - outside - q.amax(-1).clamp_max(0.0)


def capsule(points: Float[Tensor, "... 3"], end: Float[Tensor, "3"], radius: float) -> Tensor:
    """Distance to a rod with round ends from -end to end, positive inside."""
    t = ((points @ end) / (end @ end)).clamp(-1.0, 1.0)
    return radius - (points - t[..., None] * end).norm(dim=-1)


def torus(points: Float[Tensor, "... 3"], major: float, minor: float) -> Tensor:
    """Distance to a ring in the x, y plane, positive inside."""
    around = points[..., :2].norm(dim=-1) - major
    return minor - torch.stack([around, points[..., 2]], -1).norm(dim=-1)


def grid_points() -> Float[Tensor, "n n n 3"]:
    """Nodes of the cube that solids are cut from."""
    axis = torch.linspace(-HALF_EXTENT, HALF_EXTENT, GRID)
    return torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1)


def shape_from_distance(sdf: Float[Tensor, "n n n"]) -> Shape:
    """The closed surface of the largest connected body of a distance over `grid_points`."""
    labels, count = scipy.ndimage.label((sdf > 0.0).numpy())
    if count > 1:
        largest = 1 + int(np.bincount(labels.ravel())[1:].argmax())
        crumbs = torch.from_numpy((labels != 0) & (labels != largest))
        sdf = torch.where(crumbs, -0.5 * HALF_EXTENT / GRID, sdf)
    vertices, faces = extract_surface(sdf, HALF_EXTENT)
    return Shape(vertices, faces, NO_CREASE_DEG)


def random_primitive(dice: Dice, points: Tensor, size: float) -> Tensor:
    """One primitive of about the given radius, turned at random about the origin of `points`."""
    rotation, _ = torch.linalg.qr(torch.stack([dice.direction() for _ in range(3)]))
    local = points @ rotation.T if dice.chance(0.6) else points
    kind = dice.choice(("ellipsoid", "box", "capsule", "torus"), (2.0, 2.0, 1.0, 1.0))
    if kind == "ellipsoid":
        return ellipsoid(local, size * dice.uniforms(0.5, 1.0, 3))
    if kind == "box":
        half = size * dice.uniforms(0.35, 0.9, 3)
        return rounded_box(local, half, float(half.min()) * dice.uniform(0.1, 0.7))
    if kind == "capsule":
        return capsule(local, size * dice.direction(), size * dice.uniform(0.25, 0.5))
    return torus(local, size * 0.75, size * dice.uniform(0.2, 0.35))


def random_solid(dice: Dice) -> Shape:
    """Two to five primitives grown together, up to three bites taken out."""
    points = grid_points()
    blend = dice.uniform(0.03, 0.3)
    sdf = random_primitive(dice, points, dice.uniform(0.5, 0.8))
    for _ in range(dice.integer(1, 4)):
        centre = dice.uniforms(-0.6, 0.6, 3)
        part = random_primitive(dice, points - centre, dice.uniform(0.25, 0.55))
        sdf = smooth_union(sdf, part, blend)
    for _ in range(dice.integer(0, 3)):
        centre = dice.direction() * dice.uniform(0.4, 0.8)
        bite = random_primitive(dice, points - centre, dice.uniform(0.2, 0.4))
        sdf = smooth_difference(sdf, bite, 0.5 * blend)
    return shape_from_distance(sdf)
