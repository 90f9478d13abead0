"""How far views are to be trusted: pixel by pixel from the angle they are seen at, and as a whole.

A generator draws normals best where it looks straight at the surface. Whole views can be wrong
too: such a one differs from the fitted object, which the others agree on, more than they do.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from svim3d.cameras import Cameras
from svim3d.numerics import dot, normalize, smoothstep

TRUSTED_COSINE = 0.5  # of the best view's cosine: from here on wholly; Source: SV3D's mask
FILTER_REACH = 2  # pixels on either side of the bilateral filter
FILTER_PX = 1.5  # its width
FILTER_ANGLE = 0.25  # its width in differences of unit normals: relief stays, noise goes
DEVIATIONS = 3.0  # robust standard deviations above the median from which on a view is an outlier
MIN_EXCESS = 1.5  # times the median: below it no view is, however alike the others are
MAD_TO_DEVIATION = 1.4826  # of a Gaussian


def facing_trust(
    normals: Float[Tensor, "V H W 3"],
    mask: Float[Tensor, "V H W 1"],
    cameras: Cameras,
    *,
    gamma: float,
) -> Float[Tensor, "V H W 1"]:
    """smoothstep(n.v / largest n.v of all views)^gamma with filtered normals; 1 off the object.

    The largest cosine is that of the camera which sees a surface of this normal best, hidden or
    not: what no camera faces, such as a top, is trusted as far as its best view.
    Source: SViM3D sec. 4 (A_i); the edges of the step are SV3D's.

    Args:
        normals: unit, world space, straight.
        mask: coverage.
        cameras: V poses around the origin.
        gamma: steepness.
    """
    towards = normalize(cameras.positions)
    trusts = []
    for view in range(len(cameras)):
        normal = normalize(bilateral_normals(normals[view], mask[view]))
        _, rays = cameras.rays(view)
        here = dot(normal, -rays.view_as(normal))
        best = (normal @ towards.T).amax(-1, keepdim=True)
        ratio = here / torch.maximum(best, here).clamp_min(torch.finfo(here.dtype).tiny)
        trust = smoothstep(ratio / TRUSTED_COSINE) ** gamma
        trusts.append(torch.where(mask[view] > 0.0, trust, 1.0))
    return torch.stack(trusts)


def bilateral_normals(
    normals: Float[Tensor, "H W 3"], mask: Float[Tensor, "H W 1"]
) -> Float[Tensor, "H W 3"]:
    """Means over neighbours on the object that have about the same normal; not of unit length.

    Source: Tomasi and Manduchi 1998.
    """
    height, width, _ = normals.shape
    reach = FILTER_REACH
    stacked = torch.cat([normals, mask], -1).permute(2, 0, 1)[None]
    padded = torch.nn.functional.pad(stacked, (reach,) * 4)[0].permute(1, 2, 0)
    total = torch.zeros_like(normals)
    for row in range(2 * reach + 1):
        for column in range(2 * reach + 1):
            shifted = padded[row : row + height, column : column + width]
            other, covered = shifted[..., :3], shifted[..., 3:]
            apart = (other - normals).square().sum(-1, keepdim=True) / FILTER_ANGLE**2
            distance = ((row - reach) ** 2 + (column - reach) ** 2) / FILTER_PX**2
            total = total + other * covered * torch.exp(-0.5 * (apart + distance))
    return total


def view_weights(residuals: Float[Tensor, "V"], reference: int) -> Float[Tensor, "V"]:
    """1 for views like the others; one that fights them counts by how far it is out, squared.

    Robust in the logarithm: median and mean absolute deviation from it are not moved by outliers.

    Args:
        residuals: mean squared difference of each view from the fitted object.
        reference: the view that the asset was asked for by; it always counts wholly.
    """
    tiny = torch.finfo(residuals.dtype).tiny
    level = residuals.clamp_min(tiny).log()
    excess = level - level.median()
    spread = MAD_TO_DEVIATION * excess.abs().median()
    allowed = (DEVIATIONS * spread).clamp_min(math.log(MIN_EXCESS))
    weights = torch.exp(-2.0 * (excess - allowed).clamp_min(0.0))
    weights[reference] = 1.0
    return weights
