"""Turned and swept bodies: the shapes that a potter and a wire bender make.

Both surfaces are closed, wind outward, and carry glTF texture coordinates: u runs around the body,
v along the curve in units of its control points, scaled to [0, 1].
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from svim3d.numerics import normalize


@dataclass(frozen=True)
class Body:
    """A closed surface with normals and texture coordinates.

    Attributes:
        vertices: positions; the seam and the poles are split for their texture coordinates.
        faces: counter-clockwise seen from outside.
        normals: unit.
        uv: u around, v along.
    """

    vertices: Float[Tensor, "N 3"]
    faces: Int[Tensor, "F 3"]
    normals: Float[Tensor, "N 3"]
    uv: Float[Tensor, "N 2"]


def smooth_curve(
    points: Float[Tensor, "K D"], rounds: int
) -> tuple[Float[Tensor, "M D"], Float[Tensor, "M"]]:
    """Quadratic B-spline through both end points, and where each point lies between controls.

    A control point given twice makes a corner. Source: Chaikin 1974, "An algorithm for high-speed
    curve generation".

    Returns:
        Points of the curve and, for each, the control parameter in [0, K - 1].
    """
    parameter = torch.arange(len(points), dtype=points.dtype)[:, None]
    curve = torch.cat([points, parameter], 1)
    for _ in range(rounds):
        near, far = 0.75 * curve[:-1] + 0.25 * curve[1:], 0.25 * curve[:-1] + 0.75 * curve[1:]
        cut = torch.stack([near, far], 1).flatten(0, 1)
        curve = torch.cat([curve[:1], cut[1:-1], curve[-1:]])
    return curve[:, :-1], curve[:, -1]


def revolve(profile: Float[Tensor, "K 2"], *, rounds: int, segments: int) -> Body:
    """Turn a profile of (radius, height) about the y axis.

    Args:
        profile: control points from the bottom pole to the top pole, both at radius 0.
        rounds: smoothing rounds of the curve; each doubles its points.
        segments: facets around.
    """
    if float(profile[0, 0]) != 0.0 or float(profile[-1, 0]) != 0.0:
        raise ValueError("wanted a profile that starts and ends on the axis (radius 0)")
    curve, parameter = smooth_curve(profile, rounds)
    angle = torch.linspace(0.0, 2.0 * math.pi, segments + 1)
    # Counter-clockwise seen from above, from +z towards +x.
    around = torch.stack([angle.sin(), torch.zeros_like(angle), angle.cos()], 1)
    up = torch.tensor([0.0, 1.0, 0.0])
    # Beyond the axis the profile goes on as its mirror image, so that the poles are smooth.
    mirror = curve.new_tensor([-1.0, 1.0])
    tangent = _tangents(torch.cat([curve[1:2] * mirror, curve, curve[-2:-1] * mirror]))
    outward = normalize(torch.stack([tangent[:, 1], -tangent[:, 0]], 1))
    vertices = curve[:, :1, None] * around + curve[:, 1:, None] * up
    normals = outward[:, :1, None] * around + outward[:, 1:, None] * up
    return _grid_body(vertices, normals, parameter / (len(profile) - 1))


def sweep(path: Float[Tensor, "K 4"], *, rounds: int, segments: int) -> Body:
    """A round tube along a curve, closed by flat ends.

    Args:
        path: control points (x, y, z, radius).
        rounds: smoothing rounds of the curve.
        segments: facets around.
    """
    curve, parameter = smooth_curve(path, rounds)
    tangent = normalize(_tangents(torch.cat([curve[:1], curve, curve[-1:]])[:, :3]))
    side = _parallel_frames(tangent)
    across = torch.linalg.cross(tangent, side)
    angle = torch.linspace(0.0, 2.0 * math.pi, segments + 1)
    ring = angle.cos()[:, None] * side[:, None] + angle.sin()[:, None] * across[:, None]
    vertices = curve[:, None, :3] + curve[:, 3:, None] * ring
    # A rim of its own for each flat end keeps the ends' normals apart from the tube's.
    start, end = curve[:1, None, :3].expand_as(ring[:1]), curve[-1:, None, :3].expand_as(ring[:1])
    vertices = torch.cat([start, vertices[:1], vertices, vertices[-1:], end])
    first, last = -tangent[:1, None].expand_as(ring[:1]), tangent[-1:, None].expand_as(ring[:1])
    normals = torch.cat([first, first, ring, last, last])
    v = torch.nn.functional.pad(parameter[None] / (len(path) - 1), (2, 2), mode="replicate")[0]
    return _grid_body(vertices, normals, v)


def _tangents(extended: Float[Tensor, "E D"]) -> Float[Tensor, "E-2 D"]:
    """Central differences of a curve that is given with one more point at either end."""
    return extended[2:] - extended[:-2]


def _parallel_frames(tangent: Float[Tensor, "M 3"]) -> Float[Tensor, "M 3"]:
    """Unit vectors across a curve that turn with it and do not twist around it."""
    axis = torch.zeros(3)
    axis[int(tangent[0].abs().argmin())] = 1.0
    side = [normalize(torch.linalg.cross(tangent[0], axis))]
    for direction in tangent[1:]:
        side.append(normalize(side[-1] - (side[-1] @ direction) * direction))
    return torch.stack(side)


def _grid_body(
    vertices: Float[Tensor, "M S 3"], normals: Float[Tensor, "M S 3"], v: Float[Tensor, "M"]
) -> Body:
    """Triangulate a grid of M rings; triangles with two equal corners are left out."""
    rows, columns = vertices.shape[:2]
    u = torch.linspace(0.0, 1.0, columns)
    uv = torch.stack([u.expand(rows, columns), v[:, None].expand(rows, columns)], -1)
    index = torch.arange(rows * columns).view(rows, columns)
    a, b = index[:-1, :-1].reshape(-1), index[:-1, 1:].reshape(-1)
    c, d = index[1:, 1:].reshape(-1), index[1:, :-1].reshape(-1)
    faces = torch.stack([torch.stack([a, b, c], 1), torch.stack([a, c, d], 1)], 1).view(-1, 3)
    flat = vertices.reshape(-1, 3)
    corners = flat[faces]
    collapsed = (corners == corners.roll(1, 1)).all(2).any(1)
    faces = faces[~collapsed]
    return Body(flat, faces.int(), normals.reshape(-1, 3), uv.reshape(-1, 2))
