"""The built-in light: a photographer's studio of soft boxes in a dim room, exact and tiny."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from svim3d.numerics import normalize, smoothstep

FLOOR, CEILING = (0.06, 0.055, 0.05), (0.15, 0.16, 0.18)  # radiance of the room, bottom and top
EDGE_DEG = 4.0  # half width of a soft box's edge
# Direction to the centre, half angles across and up in degrees, radiance.
SOFT_BOXES = (
    ((0.70, 0.55, 0.60), (22.0, 16.0), (6.4, 5.8, 5.0)),
    ((-0.90, 0.30, 0.35), (12.0, 34.0), (1.6, 2.0, 2.6)),
    ((-0.15, 0.45, -1.00), (40.0, 8.0), (3.2, 3.0, 2.6)),
    ((0.10, 1.00, 0.05), (14.0, 14.0), (2.4, 2.4, 2.4)),
)


def studio_radiance(direction: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """Linear radiance from unit world directions."""
    height = direction[..., 1:2] * 0.5 + 0.5
    floor, ceiling = direction.new_tensor(FLOOR), direction.new_tensor(CEILING)
    radiance = floor + smoothstep(height) * (ceiling - floor)
    for centre, half_angles, colour in SOFT_BOXES:
        forward = normalize(direction.new_tensor(centre))
        # Leaning away from the world's up axis keeps the box upright wherever it hangs.
        right = normalize(torch.linalg.cross(direction.new_tensor([0.0, 1.0, 1e-3]), forward))
        up = torch.linalg.cross(forward, right)
        depth = (direction @ forward)[..., None]
        inside = (depth > 0.0).to(direction)
        for axis, half_angle in ((right, half_angles[0]), (up, half_angles[1])):
            angle = torch.atan2((direction @ axis)[..., None].abs(), depth) * (180.0 / math.pi)
            inside = inside * smoothstep(0.5 - (angle - half_angle) / (2.0 * EDGE_DEG))
        radiance = radiance + inside * direction.new_tensor(colour)
    return radiance
