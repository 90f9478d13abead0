"""The round lobe that stands for a specular lobe when radiance was prefiltered about one direction.

A rough lobe leans from the mirror direction towards the normal, by a share that depends on
roughness and n.v. The table is the minimum of the exact mean squared error over all rotations of
HDR environments (benchmarks/fit_bend.py).
"""

import torch
from jaxtyping import Float
from torch import Tensor

# Share from the mirror direction to the normal. Rows: roughness 0 to 1, even steps; columns:
# sqrt(n.v) from 0 to 1, even steps. Without roughness the lobe is a mirror and must not bend.
BEND = (
    (0.00, 0.00, 0.00, 0.00, 0.00, 0.00, 0.00, 0.00, 0.00),
    (0.00, 0.00, 0.00, 0.00, 0.00, 0.00, 0.00, 0.00, 0.00),
    (0.02, 0.02, 0.02, 0.02, 0.02, 0.02, 0.02, 0.02, 0.02),
    (0.05, 0.05, 0.05, 0.05, 0.05, 0.05, 0.05, 0.05, 0.05),
    (0.12, 0.12, 0.12, 0.12, 0.12, 0.12, 0.12, 0.12, 0.12),
    (0.24, 0.24, 0.24, 0.24, 0.24, 0.24, 0.24, 0.24, 0.24),
    (0.42, 0.42, 0.42, 0.42, 0.42, 0.42, 0.42, 0.42, 0.42),
    (0.67, 0.67, 0.67, 0.67, 0.67, 0.67, 0.67, 0.67, 0.67),
    (1.00, 1.00, 1.00, 1.00, 1.00, 1.00, 1.00, 1.00, 1.00),
)


def bend_table(size: int) -> Float[Tensor, "size size"]:
    """`BEND` resampled bilinearly to size x size entries on the same axes, ends included."""
    coarse = torch.tensor(BEND, dtype=torch.float64)[None, None]
    resized = torch.nn.functional.interpolate(
        coarse, (size, size), mode="bilinear", align_corners=True
    )
    return resized[0, 0]


def dominant_direction(
    normal: Float[Tensor, "P 3"],
    wo: Float[Tensor, "P 3"],
    n_dot_v: Float[Tensor, "P 1"],
    bend: Float[Tensor, "P 1"],
) -> Float[Tensor, "P 3"]:
    """Direction about which the prefiltered lobe best stands for the true one; not unit."""
    mirror = 2.0 * n_dot_v * normal - wo
    return mirror + bend * (normal - mirror)
