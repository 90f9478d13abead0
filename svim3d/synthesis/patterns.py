"""Where on an object a layer of its material lies: masks over space, in object coordinates.

Every pattern maps positions (and normals, where it is a decal or dust) to coverage in [0, 1]. The
object's longest side is 1 and its centre is the origin.
"""

import math
from dataclasses import dataclass
from typing import Protocol

import torch
from jaxtyping import Float
from torch import Tensor

from svim3d.numerics import dot, normalize, smoothstep
from svim3d.synthesis.noise import fractal_noise

DECAL_FACING = 0.25  # cosine to a decal's axis below which paint sprayed along it does not stick


class Pattern(Protocol):
    """Coverage of a layer."""

    def __call__(
        self, position: Float[Tensor, "P 3"], normal: Float[Tensor, "P 3"]
    ) -> Float[Tensor, "P 1"]:
        """Coverage in [0, 1] at points of the surface."""
        ...


@dataclass(frozen=True)
class Patches:
    """Noise above a threshold: rust, dirt, worn paint, marble, mottling.

    Attributes:
        frequency: cells per unit along each axis; uneven ones stretch the patches, as in wood.
        octaves: of the noise.
        threshold: noise value at half coverage; 0.5 covers half of the object.
        softness: width of the transition, in noise values.
        seed: of the noise.
    """

    frequency: tuple[float, float, float]
    octaves: int
    threshold: float
    softness: float
    seed: int

    def __call__(self, position: Tensor, normal: Tensor) -> Tensor:
        """Coverage of each point."""
        value = _noise(position, self.frequency, self.octaves, self.seed)
        return smoothstep(0.5 + (value - self.threshold) / self.softness)


@dataclass(frozen=True)
class Veins:
    """Thin lines where noise crosses its mean: cracks, scratches, marble's veins.

    Attributes:
        frequency: cells per unit along each axis.
        octaves: of the noise.
        width: of the lines, in noise values.
        seed: of the noise.
    """

    frequency: tuple[float, float, float]
    octaves: int
    width: float
    seed: int

    def __call__(self, position: Tensor, normal: Tensor) -> Tensor:
        """Coverage of each point."""
        value = _noise(position, self.frequency, self.octaves, self.seed)
        return smoothstep(1.0 - (value - 0.5).abs() / self.width)


@dataclass(frozen=True)
class Bands:
    """Stripes across a direction, bent by noise: paint rings, wood grain, layered stone.

    Attributes:
        direction: unit, across the stripes.
        frequency: stripes per unit length.
        phase: of the first stripe, in stripes.
        share: of a period that is covered.
        softness: of the edges, in periods.
        bend: how far noise moves the stripes, in units of length.
        seed: of the noise.
    """

    direction: tuple[float, float, float]
    frequency: float
    phase: float
    share: float
    softness: float
    bend: float
    seed: int

    def __call__(self, position: Tensor, normal: Tensor) -> Tensor:
        """Coverage of each point."""
        along = position @ position.new_tensor(self.direction)
        if self.bend > 0.0:
            along = along + self.bend * (
                fractal_noise(4.0 * position, octaves=2, seed=self.seed) - 0.5
            )
        return _periodic(along * self.frequency + self.phase, self.share, self.softness)[:, None]


@dataclass(frozen=True)
class Rings:
    """Year rings of a log: bands by the distance to a line that leans through the object.

    Attributes:
        axis: unit, along the log.
        centre: a point of the log's heart.
        frequency: rings per unit length.
        seed: of the noise that bends them.
    """

    axis: tuple[float, float, float]
    centre: tuple[float, float, float]
    frequency: float
    seed: int

    def __call__(self, position: Tensor, normal: Tensor) -> Tensor:
        """Coverage of each point."""
        axis = position.new_tensor(self.axis)
        arm = position - position.new_tensor(self.centre)
        distance = (arm - (arm @ axis)[:, None] * axis).norm(dim=1)
        bent = distance + 0.06 * fractal_noise(3.0 * position, octaves=3, seed=self.seed)
        saw = (bent * self.frequency) % 1.0
        # Late wood darkens slowly and ends at once.
        return (saw * smoothstep((1.0 - saw) * 6.0))[:, None]


@dataclass(frozen=True)
class Checks:
    """A chessboard in space, or a grid of lines where `share` is below one half.

    Attributes:
        rotation: rows are the board's axes.
        frequency: fields per unit length.
        line: width of grid lines in fields; None fills every other field.
    """

    rotation: tuple[tuple[float, float, float], ...]
    frequency: float
    line: float | None

    def __call__(self, position: Tensor, normal: Tensor) -> Tensor:
        """Coverage of each point."""
        # The offset keeps field borders off the faces of boxes, where they would flicker.
        local = position @ position.new_tensor(self.rotation).T * self.frequency + 0.137
        if self.line is None:
            return (local.floor().sum(1) % 2.0)[:, None]
        near = ((local - local.round()).abs() < 0.5 * self.line).any(1)
        return near.to(position)[:, None]


@dataclass(frozen=True)
class Dots:
    """Balls on a cubic lattice, each moved a little: polka dots, speckles, terrazzo.

    Attributes:
        frequency: lattice cells per unit length.
        radius: of the dots, in cells.
        scatter: how far dots move from their cells' centres, in cells.
        seed: of the places.
    """

    frequency: float
    radius: float
    scatter: float
    seed: int

    def __call__(self, position: Tensor, normal: Tensor) -> Tensor:
        """Coverage of each point."""
        local = position * self.frequency + 0.371
        cell = local.floor()
        centre = torch.stack(
            [
                # Halves lie between the noise's lattice points, where neighbours differ well.
                fractal_noise(cell + 0.5, octaves=1, seed=self.seed + axis) - 0.5
                for axis in range(3)
            ],
            1,
        )
        offset = local - cell - 0.5 - 2.0 * self.scatter * centre
        return smoothstep(0.5 + (self.radius - offset.norm(dim=1, keepdim=True)) / 0.08)


@dataclass(frozen=True)
class Decal:
    """A figure sprayed onto the object along an axis, on the side that faces it.

    Attributes:
        axis: unit, from the object towards the stencil.
        up: unit, across the axis.
        centre: of the figure, across the axis, in units of length (right, up).
        radius: of the figure.
        figure: disc, ring, star, square, cross, triangle or text (rows of blocks).
    """

    axis: tuple[float, float, float]
    up: tuple[float, float, float]
    centre: tuple[float, float]
    radius: float
    figure: str

    def __call__(self, position: Tensor, normal: Tensor) -> Tensor:
        """Coverage of each point."""
        axis, up = position.new_tensor(self.axis), position.new_tensor(self.up)
        right = torch.linalg.cross(up, axis)
        x = (position @ right - self.centre[0]) / self.radius
        y = (position @ up - self.centre[1]) / self.radius
        inside = _figure(self.figure, x, y)
        sticks = smoothstep((normal @ axis - DECAL_FACING) / 0.1)
        return (smoothstep(0.5 + inside / 0.08) * sticks)[:, None]


@dataclass(frozen=True)
class Half:
    """One side of a plane, its border frayed by noise: two-tone paint, a dipped handle.

    Attributes:
        direction: unit, into the covered side.
        start: distance of the plane from the origin.
        fray: how far noise moves the border.
        softness: width of the border.
        seed: of the noise.
    """

    direction: tuple[float, float, float]
    start: float
    fray: float
    softness: float
    seed: int

    def __call__(self, position: Tensor, normal: Tensor) -> Tensor:
        """Coverage of each point."""
        along = position @ position.new_tensor(self.direction) - self.start
        if self.fray > 0.0:
            along = along + self.fray * (
                fractal_noise(6.0 * position, octaves=3, seed=self.seed) - 0.5
            )
        return smoothstep(0.5 + along / self.softness)[:, None]


@dataclass(frozen=True)
class Settled:
    """Surfaces that face a direction, broken by noise: dust and snow from above, grime below.

    Attributes:
        direction: unit.
        threshold: cosine at half coverage.
        seed: of the noise.
    """

    direction: tuple[float, float, float]
    threshold: float
    seed: int

    def __call__(self, position: Tensor, normal: Tensor) -> Tensor:
        """Coverage of each point."""
        facing = dot(normal, normal.new_tensor(self.direction).expand_as(normal))
        grain = fractal_noise(9.0 * position, octaves=3, seed=self.seed)[:, None]
        return smoothstep(0.5 + (facing - self.threshold + 0.8 * (grain - 0.5)) / 0.3)


def _noise(
    position: Float[Tensor, "P 3"], frequency: tuple[float, float, float], octaves: int, seed: int
) -> Float[Tensor, "P 1"]:
    scaled = position * position.new_tensor(frequency)
    return fractal_noise(scaled, octaves=octaves, seed=seed)[:, None]


def _periodic(x: Tensor, share: float, softness: float) -> Tensor:
    """1 over `share` of every unit of x, with soft edges."""
    distance = (x - x.round()).abs()
    return smoothstep(0.5 + (0.5 * share - distance) / max(softness, 1e-3))


def _figure(name: str, x: Tensor, y: Tensor) -> Tensor:
    """Depth inside a figure of about unit radius; negative outside, never more than about 1."""
    radius = (x * x + y * y).sqrt()
    if name == "disc":
        return 1.0 - radius
    if name == "ring":
        return 0.25 - (radius - 0.75).abs()
    if name == "square":
        return 0.8 - torch.maximum(x.abs(), y.abs())
    if name == "cross":
        arms = torch.maximum(0.28 - x.abs(), 0.28 - y.abs())
        return torch.minimum(arms, 0.95 - torch.maximum(x.abs(), y.abs()))
    if name == "triangle":
        return torch.minimum(0.5 + y, 0.5 - 0.5 * y - 0.866 * x.abs())
    if name == "star":
        angle = torch.atan2(x, y)
        folded = (angle / (2.0 * math.pi / 5.0) - (angle / (2.0 * math.pi / 5.0)).round()).abs()
        return 1.0 - 1.2 * folded - radius
    # Text: rows of blocks of uneven length, as lettering looks from afar.
    row = ((y + 1.0) * 2.5).floor()
    ends = 0.55 + 0.4 * torch.sin(row * 12.9 + 1.0)
    lines = 0.13 - ((y + 1.0) * 0.4 % 0.4 / 0.4 - 0.5).abs() * 0.4
    letters = 0.35 - ((x * 3.7 + row * 0.3) % 1.0 - 0.5).abs()
    inside = torch.minimum(torch.minimum(lines, letters * 0.27), ends - x.abs())
    return torch.minimum(inside, 1.0 - y.abs())


def unit(x: float, y: float, z: float) -> tuple[float, float, float]:
    """A direction as a plain unit triple."""
    a, b, c = normalize(torch.tensor([x, y, z])).tolist()
    return a, b, c
