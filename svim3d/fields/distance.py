"""Signed distances on a grid from sets of nodes and from other level functions.

Exact Euclidean distance transforms and connected components run on the CPU (scipy) whatever the
device: they are used a few times per object.
"""

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy.typing import NDArray
from scipy import ndimage
from torch import Tensor

MIN_SLOPE = 1e-6  # guards the division by the gradient of a flat level function
NEAR_CELLS = 1.5  # level / |gradient| is trusted this far from the zero, the transform beyond


def _node_distance(solid: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Distance in cells to the border, taken half a cell outside the last inside node."""
    if not solid.any():
        return np.full(solid.shape, -float(len(solid)), np.float32)
    inside: NDArray[np.float32] = ndimage.distance_transform_edt(solid)
    outside = ndimage.distance_transform_edt(~solid)
    return np.where(solid, inside - 0.5, 0.5 - outside).astype(np.float32)


def signed_distance(
    inside: Bool[Tensor, "n n n"], half_extent: float, *, smoothing_cells: float = 1.0
) -> Float[Tensor, "n n n"]:
    """Signed distance to the border of a set of nodes, positive inside, world units.

    A Gaussian of `smoothing_cells` removes the staircase.
    """
    solid = inside.cpu().numpy()
    spacing = 2.0 * half_extent / (len(solid) - 1)
    smooth = ndimage.gaussian_filter(_node_distance(solid), smoothing_cells, mode="nearest")
    return torch.from_numpy(smooth * np.float32(spacing)).to(inside.device)


def redistance(level: Float[Tensor, "n n n"], half_extent: float) -> Float[Tensor, "n n n"]:
    """A function of about unit gradient with the zero of `level`, positive where `level` is.

    Near the zero level / |gradient| (first order), further away the distance between nodes.
    """
    values = level.detach().cpu().numpy().astype(np.float32)
    slope = np.sqrt(sum(np.square(g) for g in np.gradient(values)))
    near = values / np.maximum(slope, MIN_SLOPE)
    far = _node_distance(values > 0.0)
    cells = np.where(np.abs(far) < NEAR_CELLS, np.clip(near, -NEAR_CELLS, NEAR_CELLS), far)
    spacing = np.float32(2.0 * half_extent / (len(values) - 1))
    return torch.from_numpy(cells.astype(np.float32) * spacing).to(level.device)


def without_hidden_parts(
    sdf: Float[Tensor, "n n n"], *, smallest_share: float
) -> Float[Tensor, "n n n"]:
    """Fill enclosed voids, which no camera can see, and drop specks of the solid.

    Args:
        sdf: positive inside.
        smallest_share: parts with fewer nodes than this share of the largest one are dropped.
    """
    values = sdf.detach().cpu().numpy().copy()
    air, _ = ndimage.label(values <= 0.0)
    outside = air == air[0, 0, 0]
    voids = (air > 0) & ~outside
    values[voids] = np.maximum(-values[voids], np.finfo(np.float32).tiny)
    parts, count = ndimage.label(values > 0.0)
    if count > 1:
        sizes = np.bincount(parts.ravel())
        sizes[0] = 0
        specks = (sizes < smallest_share * sizes.max())[parts] & (parts > 0)
        values[specks] = -values[specks]
    return torch.from_numpy(values).to(sdf.device)
