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
    (0.02, 0.02, 0.01, 0.00, 0.00, 0.00, 0.00, 0.00, 0.00),
    (0.10, 0.10, 0.07, 0.03, 0.01, 0.00, 0.00, 0.00, 0.00),
    (0.22, 0.22, 0.19, 0.13, 0.07, 0.02, 0.00, 0.01, 0.01),
    (0.33, 0.33, 0.31, 0.26, 0.20, 0.13, 0.08, 0.06, 0.06),
    (0.43, 0.43, 0.41, 0.38, 0.33, 0.28, 0.23, 0.21, 0.21),
    (0.52, 0.52, 0.51, 0.50, 0.47, 0.45, 0.44, 0.44, 0.44),
    (0.62, 0.62, 0.62, 0.62, 0.62, 0.64, 0.68, 0.71, 0.71),
    (0.71, 0.71, 0.72, 0.75, 0.78, 0.84, 0.91, 0.96, 0.96),
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
