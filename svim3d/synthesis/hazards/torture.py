"""Meshes that no unwrapper likes, for the functions of atlas and cleanup themselves."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from svim3d.synthesis.dice import Dice
from svim3d.synthesis.shapes import superquadric

KINDS = ("noisy", "sliver-fan", "non-manifold", "zero-area")
FACES = (200, 2_000, 20_000, 100_000)  # by severity
ROUGHNESS = 0.02  # deviation of a noisy vertex, of a body of half side 1: edges turn over
FLAT_SHARE = 0.3  # of the faces that have no area
SHARED_BY = 5  # faces on an edge that should have two


def torture_mesh(
    kind: str, severity: float, seed: int
) -> tuple[Float[Tensor, "N 3"], Int[Tensor, "F 3"]]:
    """Vertices and faces of a kind, about `FACES` of the severity."""
    count, dice = FACES[int(severity)], Dice.of(seed, 0)
    vertices, faces = _ball(count)
    if kind == "noisy":
        noise = torch.randn(vertices.shape, generator=dice.generator)
        return vertices + ROUGHNESS * noise, faces
    if kind == "sliver-fan":
        return _fan(count)
    if kind == "non-manifold":
        return _with_fins(vertices, faces, dice)
    flat = faces.clone()
    chosen = torch.rand(len(faces), generator=dice.generator) < FLAT_SHARE
    flat[chosen, 2] = flat[chosen, 1]  # onto an edge
    return vertices, flat


def _ball(count: int) -> tuple[Tensor, Tensor]:
    """A ball of about so many faces: a superquadric of n segments has 4 n^2."""
    shape = superquadric(1.0, 1.0, max(3, round((count / 4) ** 0.5)))
    return shape.vertices, shape.faces


def _fan(count: int) -> tuple[Tensor, Tensor]:
    """Slivers about one point, far thinner than a texel, as a closed double cone."""
    angle = torch.arange(count // 2) * (2.0 * torch.pi / (count // 2))
    rim = torch.stack([angle.cos(), torch.zeros_like(angle), angle.sin()], 1)
    tips = torch.tensor([[0.0, 1e-3, 0.0], [0.0, -1e-3, 0.0]])
    here = torch.arange(len(rim))
    there = here.roll(-1)
    top, bottom = torch.full_like(here, len(rim)), torch.full_like(here, len(rim) + 1)
    faces = torch.cat([torch.stack([there, here, top], 1), torch.stack([here, there, bottom], 1)])
    return torch.cat([rim, tips]), faces.int()


def _with_fins(vertices: Tensor, faces: Tensor, dice: Dice) -> tuple[Tensor, Tensor]:
    """A ball of which some edges carry more faces than two."""
    count = max(1, len(faces) // 50)
    chosen = torch.randperm(len(faces), generator=dice.generator)[:count]
    fins = []
    points = [vertices]
    start = len(vertices)
    for _ in range(SHARED_BY - 2):
        edge = faces[chosen, :2]
        tip = vertices[edge.long()].mean(1) * dice.uniform(1.1, 1.4)
        points.append(tip + 0.05 * torch.randn(tip.shape, generator=dice.generator))
        index = torch.arange(start, start + count, dtype=faces.dtype)[:, None]
        fins.append(torch.cat([edge, index], 1))
        start += count
    return torch.cat(points), torch.cat([faces, *fins])
