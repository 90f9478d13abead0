"""Meshes cut so fine that their corners can carry what a picture shows of their materials.

Source: Cook, Carpenter and Catmull 1987, "The Reyes image rendering architecture", section 2.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor


@dataclass(frozen=True)
class Micropolygons:
    """Triangles with materials at their corners, for programs that know no others.

    Attributes:
        position: of the three corners of each triangle, counter-clockwise from outside.
        normal: unit shading normals.
        basecolor: linear.
        roughness: perceptual.
        metallic: in [0, 1].
    """

    position: Float[Tensor, "F 3 3"]
    normal: Float[Tensor, "F 3 3"]
    basecolor: Float[Tensor, "F 3 3"]
    roughness: Float[Tensor, "F 3 1"]
    metallic: Float[Tensor, "F 3 1"]


def cut_long_edges(
    corners: Float[Tensor, "F 3 C"], longest: float
) -> tuple[Float[Tensor, "F2 3 C"], Int[Tensor, "F2"]]:
    """Halve triangles across their longest edge until no edge is longer than wanted.

    Both sides of an edge are halved at the same points, so that no gap opens. Slender triangles
    fall into few pieces, which an even grid over each would not give.

    Args:
        corners: position in the first three channels, then what is interpolated with it.
        longest: length that edges may have.

    Returns:
        Corners, and the index of the face that each triangle is a piece of.
    """
    face = torch.arange(len(corners), device=corners.device)
    done = []
    while len(corners):
        lengths = (corners[..., :3].roll(-1, 1) - corners[..., :3]).norm(dim=-1)
        length, edge = lengths.max(1)
        is_long = length > longest  # False for what is not a number, so that this ends
        done.append((corners[~is_long], face[~is_long]))
        corners, face, edge = corners[is_long], face[is_long], edge[is_long]
        # Start with the longest edge: a, b, then the corner c opposite.
        order = (edge[:, None] + torch.arange(3, device=edge.device)) % 3
        a, b, c = corners.gather(1, order[..., None].expand_as(corners)).unbind(1)
        middle = 0.5 * (a + b)
        halves = [torch.stack([a, middle, c], 1), torch.stack([middle, b, c], 1)]
        corners, face = torch.cat(halves), face.repeat(2)
    pieces, faces = zip(*done, strict=True)
    return torch.cat(pieces), torch.cat(faces)
