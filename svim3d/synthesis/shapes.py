"""Closed shapes: rings of points lofted to a surface, and smooth solids cut from a distance grid.

All shapes are closed, wind outward and share their vertices, so that volume and neighbourhood are
defined; shading normals come later, with creases where two faces meet at a sharp angle.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from svim3d.mesh.mesh import face_normals_scaled, signed_volume
from svim3d.numerics import normalize

SHARP_CREASE_DEG = 35.0  # edges of bevels and rims stay visible, facets of 24 around do not
NO_CREASE_DEG = 180.0


@dataclass(frozen=True)
class Shape:
    """A closed surface.

    Attributes:
        vertices: positions, shared by neighbouring faces.
        faces: counter-clockwise seen from outside.
        crease_deg: faces that meet at a larger angle are shaded apart.
    """

    vertices: Float[Tensor, "N 3"]
    faces: Int[Tensor, "F 3"]
    crease_deg: float = SHARP_CREASE_DEG

    def placed(
        self,
        *,
        scale: Sequence[float] = (1.0, 1.0, 1.0),
        rotation: Float[Tensor, "3 3"] | None = None,
        offset: Sequence[float] = (0.0, 0.0, 0.0),
    ) -> "Shape":
        """Scaled, turned, then moved; a mirrored shape still winds outward."""
        vertices = self.vertices * self.vertices.new_tensor(scale)
        if rotation is not None:
            vertices = vertices @ rotation.T
        vertices = vertices + self.vertices.new_tensor(offset)
        faces = self.faces.flip(1) if math.prod(scale) < 0.0 else self.faces
        return replace(self, vertices=vertices, faces=faces)

    @property
    def bounds(self) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"]]:
        """Lowest and highest coordinates."""
        return self.vertices.amin(0), self.vertices.amax(0)


def loft(
    rings: Float[Tensor, "M S 3"], *, joined: bool = False, crease_deg: float = SHARP_CREASE_DEG
) -> Shape:
    """The surface through rings of equally many points, one after the other.

    Args:
        rings: positions; each ring runs around the body in the same sense.
        joined: the last ring goes on into the first; otherwise both ends are closed by a fan
            about the ring's mean, which must see all of the ring.
        crease_deg: see `Shape`.
    """
    count, around = rings.shape[:2]
    index = torch.arange(count * around).view(count, around)
    near = index if joined else index[:-1]
    far = index.roll(-1, 0) if joined else index[1:]
    a, b = near.reshape(-1), near.roll(-1, 1).reshape(-1)
    d, c = far.reshape(-1), far.roll(-1, 1).reshape(-1)
    faces = [torch.stack([a, b, c], 1), torch.stack([a, c, d], 1)]
    vertices = rings.reshape(-1, 3)
    if not joined:
        ends = torch.stack([rings[0].mean(0), rings[-1].mean(0)])
        first, last = torch.tensor(count * around), torch.tensor(count * around + 1)
        faces.append(torch.stack([index[0].roll(-1), index[0], first.expand(around)], 1))
        faces.append(torch.stack([index[-1], index[-1].roll(-1), last.expand(around)], 1))
        vertices = torch.cat([vertices, ends])
    return _outward(vertices, torch.cat(faces), crease_deg)


def _outward(vertices: Float[Tensor, "N 3"], faces: Int[Tensor, "F 3"], crease_deg: float) -> Shape:
    """The closed surface with its faces turned outward."""
    if float(signed_volume(vertices, faces)) < 0.0:
        faces = faces.flip(1)
    return Shape(vertices, faces.int(), crease_deg)


def circle(segments: int) -> Float[Tensor, "S 2"]:
    """Points of the unit circle."""
    angle = torch.arange(segments) * (2.0 * math.pi / segments)
    return torch.stack([angle.cos(), angle.sin()], 1)


def lathe(profile: Float[Tensor, "M 2"], outline: Float[Tensor, "S 2"]) -> Shape:
    """Turn a profile of (radius, height) about y; an outline other than a circle makes flutes."""
    radius, height = profile[:, :1, None], profile[:, 1:].expand(-1, len(outline))
    plane = radius * outline
    return loft(torch.stack([plane[..., 0], height, plane[..., 1]], -1))


def superquadric(squareness_up: float, squareness_around: float, segments: int) -> Shape:
    """Powers of an ellipsoid's sines and cosines; extent [-1, 1].

    x = c(eta, e1) c(omega, e2), y = s(eta, e1), z = c(eta, e1) s(omega, e2).

    Exponents of 1 make a sphere, towards 0 a cube, 2 a double cone. Source: Barr 1981,
    "Superquadrics and angle-preserving transformations".
    """
    eta = torch.linspace(-0.5, 0.5, segments + 2)[1:-1] * math.pi
    omega = torch.arange(2 * segments) * (math.pi / segments)

    def power(value: Tensor, exponent: float) -> Tensor:
        return value.sign() * value.abs().pow(exponent)

    across, up = power(eta.cos(), squareness_up), power(eta.sin(), squareness_up)
    plane = torch.stack(
        [power(omega.cos(), squareness_around), power(omega.sin(), squareness_around)], 1
    )
    rings = across[:, None, None] * plane
    return loft(
        torch.stack([rings[..., 0], up[:, None].expand(rings.shape[:2]), rings[..., 1]], -1)
    )


def extrusion(outline: Float[Tensor, "S 2"], height: float, bevel: float, rows: int = 1) -> Shape:
    """A slab over an outline in the x, z plane, its rims bevelled, centred at the origin.

    Args:
        outline: seen whole from the origin.
        height: along y.
        bevel: how far the rims stand back, in outline units and in height.
        rows: of faces along the side.
    """
    half = 0.5 * height
    bevel = min(bevel, 0.45 * height)
    inner = max(0.2, 1.0 - bevel / float(outline.norm(dim=1).mean()))
    side = torch.linspace(-half + bevel, half - bevel, rows + 1)
    levels = [(inner * 0.5, -half), (inner, -half), *((1.0, float(y)) for y in side)]
    levels += [(inner, half), (inner * 0.5, half)]
    rings = [
        torch.stack([s * outline[:, 0], torch.full((len(outline),), y), s * outline[:, 1]], 1)
        for s, y in levels
    ]
    return loft(torch.stack(rings))


def tube(
    path: Float[Tensor, "M 3"],
    radius: Float[Tensor, "M"],
    outline: Float[Tensor, "S 2"],
    *,
    joined: bool = False,
) -> Shape:
    """An outline swept along a curve, turning with it and never twisting around it.

    Args:
        path: points of the curve; a joined one should lie in a plane, or its ends will not match.
        radius: scale of the outline at each point.
        outline: around the curve.
        joined: the curve is closed.
    """
    if joined:
        tangent = normalize(path.roll(-1, 0) - path.roll(1, 0))
    else:
        extended = torch.cat([path[:1], path, path[-1:]])
        tangent = normalize(extended[2:] - extended[:-2])
    side = _untwisted_sides(tangent)
    across = torch.linalg.cross(tangent, side)
    around = outline[:, :1] * side[:, None] + outline[:, 1:] * across[:, None]
    return loft(path[:, None] + radius[:, None, None] * around, joined=joined)


def _untwisted_sides(tangent: Float[Tensor, "M 3"]) -> Float[Tensor, "M 3"]:
    """Unit vectors across a curve, each the one before it projected off the new tangent."""
    axis = torch.zeros(3)
    axis[int(tangent.abs().sum(0).argmin())] = 1.0
    sides = [normalize(torch.linalg.cross(tangent[0], axis))]
    for direction in tangent[1:]:
        sides.append(normalize(sides[-1] - (sides[-1] @ direction) * direction))
    return torch.stack(sides)


@dataclass(frozen=True)
class Assembly:
    """Several shapes with shading normals, ready to render.

    Attributes:
        vertices: positions, split along creases.
        faces: counter-clockwise seen from outside.
        normals: unit.
        face_part: which shape each face came from.
    """

    vertices: Float[Tensor, "N 3"]
    faces: Int[Tensor, "F 3"]
    normals: Float[Tensor, "N 3"]
    face_part: Int[Tensor, "F"]


def assemble(shapes: Sequence[Shape]) -> Assembly:
    """Put shapes side by side and give every corner its normal."""
    vertices, faces, normals, part = [], [], [], []
    start = 0
    for index, shape in enumerate(shapes):
        points, triangles, directions = creased(shape)
        vertices.append(points)
        normals.append(directions)
        faces.append(triangles + start)
        part.append(torch.full((len(triangles),), index))
        start += len(points)
    return Assembly(
        torch.cat(vertices), torch.cat(faces).int(), torch.cat(normals), torch.cat(part)
    )


def creased(
    shape: Shape,
) -> tuple[Float[Tensor, "V 3"], Int[Tensor, "F 3"], Float[Tensor, "V 3"]]:
    """Vertices, faces and normals of a shape whose vertices are split along its creases.

    A corner's normal is the area-weighted mean over the faces around its vertex that deviate from
    the corner's own face by less than the crease angle.
    """
    corners = shape.faces.reshape(-1).long()
    scaled = face_normals_scaled(shape.vertices, shape.faces)
    unit = normalize(scaled)
    order = torch.argsort(corners, stable=True)
    valence = torch.bincount(corners, minlength=len(shape.vertices))
    starts = valence.cumsum(0) - valence
    # Every pair of corners that share a vertex.
    pairs = valence[corners]
    own = torch.repeat_interleave(pairs)
    step = torch.arange(len(own)) - (pairs.cumsum(0) - pairs)[own]
    other = order[starts[corners[own]] + step]
    like = (unit[own // 3] * unit[other // 3]).sum(1) >= math.cos(math.radians(shape.crease_deg))
    summed = torch.zeros(len(corners), 3)
    summed.index_add_(0, own[like], scaled[other[like] // 3])
    return _merged(shape.vertices[corners], normalize(summed), corners)


def _merged(
    points: Float[Tensor, "C 3"], normals: Float[Tensor, "C 3"], corners: Int[Tensor, "C"]
) -> tuple[Float[Tensor, "V 3"], Int[Tensor, "F 3"], Float[Tensor, "V 3"]]:
    """Corners of one vertex whose normals agree to a thousandth become one again."""
    key = torch.cat([corners[:, None], (normals * 1000.0).round().long()], 1)
    _, index = torch.unique(key, dim=0, return_inverse=True)
    count = int(index.max()) + 1
    # The last corner of each group speaks for it; which one does not matter.
    chosen = torch.zeros(count, dtype=torch.long).scatter_reduce_(
        0, index, torch.arange(len(index)), "amax"
    )
    return points[chosen], index.view(-1, 3), normals[chosen]
