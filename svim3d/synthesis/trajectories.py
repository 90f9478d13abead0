"""Camera paths of training clips, and the distance from which the object fills the picture."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from svim3d.cameras import orbit_angles
from svim3d.synthesis.dice import Dice

STATIC_SHARE = 0.7
LOWEST_DEG, HIGHEST_DEG = -5.0, 30.0  # mean elevation. Source: SV3D, appendix B
MAX_ELEVATION_DEG = 80.0  # keeps the camera's up axis well defined
WAVES = 5  # sinusoids of a dynamic path, periods of 1 to 5 per orbit
AMPLITUDE_DEG = (0.5, 10.0)
SWING_SHARE, MAX_SWING_DEG = 0.5, 30.0  # of dynamic paths that rise and sink once, by how much
JITTER = 0.35  # of the azimuth step
FILL = 0.9  # of the picture's side that the object takes in the reference view, as photos have it
BORDER = 0.96  # of the half side that no view may leave: more than a pixel stays free at 64


@dataclass(frozen=True)
class Trajectory:
    """Where the cameras stand; the last one is the reference, at azimuth 0.

    Attributes:
        elevation_deg: up from the horizon.
        azimuth_deg: counter-clockwise from above, ascending but for the last.
    """

    elevation_deg: tuple[float, ...]
    azimuth_deg: tuple[float, ...]

    @property
    def angles(self) -> list[tuple[float, float]]:
        """(elevation, azimuth) pairs."""
        return list(zip(self.elevation_deg, self.azimuth_deg, strict=True))


def random_trajectory(dice: Dice, views: int) -> Trajectory:
    """An orbit at one elevation, or one that rises and sinks with uneven steps."""
    mean = dice.uniform(LOWEST_DEG, HIGHEST_DEG)
    even = [azimuth for _, azimuth in orbit_angles(views, 0.0, 0.0)]
    if dice.chance(STATIC_SHARE):
        return Trajectory((mean,) * views, tuple(even))
    step = 360.0 / views
    azimuths = [a + step * dice.uniform(-JITTER, JITTER) for a in even[:-1]] + [0.0]
    swing = dice.uniform(0.0, MAX_SWING_DEG) if dice.chance(SWING_SHARE) else 0.0
    share = dice.uniform(0.0, 1.0)
    waves = [
        (share * dice.uniform(*AMPLITUDE_DEG), period, dice.uniform(0.0, 2.0 * math.pi))
        for period in range(1, WAVES + 1)
    ]

    def elevation(azimuth_deg: float) -> float:
        angle = math.radians(azimuth_deg)
        value = mean + swing * math.sin(angle)
        value += sum(a * math.sin(period * angle + phase) for a, period, phase in waves)
        return min(max(value, -MAX_ELEVATION_DEG), MAX_ELEVATION_DEG)

    return Trajectory(tuple(elevation(a) for a in azimuths), tuple(azimuths))


def fitting_distance(
    vertices: Float[Tensor, "N 3"], rotations: Float[Tensor, "V 3 3"], fov_deg: float
) -> float:
    """Distance at which the object fills the reference view, or farther if another view needs it.

    Args:
        vertices: world positions; cameras look at the origin.
        rotations: camera axes in their columns, one per view; the last is the reference.
        fov_deg: field of view.

    Returns:
        Distance at which the projected box's longer side takes `FILL` of the reference picture
        and no vertex of any view leaves `BORDER`.
    """
    focal = 1.0 / math.tan(math.radians(fov_deg) / 2.0)
    local = vertices @ rotations  # [V, N, 3]; a point at z stands r - z before the camera
    x, y, z = local.unbind(-1)
    # focal |x| / (r - z) <= BORDER, solved for r.
    needed = float((z + focal * torch.maximum(x.abs(), y.abs()) / BORDER).max())

    def filled(radius: float) -> float:
        inverse = focal / (radius - z[-1])
        sides = [(c[-1] * inverse).max() - (c[-1] * inverse).min() for c in (x, y)]
        return float(torch.stack(sides).max()) / 2.0

    # The filled share falls with the distance, so that bisection finds where it is FILL.
    low, high = float(z[-1].max()) + 1e-3, needed + 10.0
    for _ in range(40):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if filled(middle) > FILL else (low, middle)
    return max(needed, high)
