"""The surface seen from its texture: which point of which face each texel shows.

Texel centres lie at (column + 0.5, row + 0.5) / size with row 0 at v = 0, the top, as in glTF.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numba import prange
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from svim3d.compiled import kernel

BANDS = 16  # of rows, rasterised independently; fixed, so that threads never change a result
REACH_TEXELS = 0.75  # texels whose square a face touches at a corner have their centre this near
STRICTLY_INSIDE = 0.02  # texels from an edge, below which two faces may share a texel centre


@dataclass(frozen=True)
class Texels:
    """The texels of a square texture that show a surface, in row-major order.

    Attributes:
        pixel: flat index of the texel.
        face: the face it shows: the one that holds its centre, else the nearest within
            `REACH_TEXELS`, so that bilinear lookups near a chart's border meet its own texels.
        barycentric: weights of the face's corners at the centre, or at the face's nearest point.
        size: texels per side.
        overlaps: texels whose centre lies inside more than one face.
        overlapping: one face per such texel: the last that claimed it.
    """

    pixel: Int[Tensor, "P"]
    face: Int[Tensor, "P"]
    barycentric: Float[Tensor, "P 3"]
    size: int
    overlaps: int
    overlapping: Int[Tensor, "Q"]

    def interpolate(
        self, faces: Int[Tensor, "F 3"], attribute: Float[Tensor, "N C"]
    ) -> Float[Tensor, "P C"]:
        """A vertex attribute at every texel."""
        corners = faces[self.face].long()
        weight = self.barycentric
        total = weight[:, :1] * attribute[corners[:, 0]]
        total = total + weight[:, 1:2] * attribute[corners[:, 1]]
        return total + weight[:, 2:] * attribute[corners[:, 2]]


def rasterize_uv(uv: Float[Tensor, "N 2"], faces: Int[Tensor, "F 3"], size: int) -> Texels:
    """Find the face and barycentric coordinates behind each texel of a size x size texture."""
    points = (uv.detach().cpu().double() * size).numpy()
    triangles = faces.cpu().numpy().astype(np.int64)
    face = np.full((size, size), -1, np.int32)
    weights = np.zeros((size, size, 3), np.float32)
    loser = np.full((size, size), -1, np.int32)
    _rasterize(points, triangles, face, weights, loser)
    pixel = np.flatnonzero(face.reshape(-1) >= 0)
    losers = loser[loser >= 0]
    return Texels(
        pixel=torch.from_numpy(pixel),
        face=torch.from_numpy(face.reshape(-1)[pixel].astype(np.int64)),
        barycentric=torch.from_numpy(weights.reshape(-1, 3)[pixel]),
        size=size,
        overlaps=len(losers),
        overlapping=torch.from_numpy(losers.astype(np.int64)),
    )


@kernel()
def _nearest_on_segment(px: Any, py: Any, ax: Any, ay: Any, bx: Any, by: Any) -> Any:
    """Parameter of the nearest point from a to b, and its squared distance."""
    dx, dy = bx - ax, by - ay
    squared = dx * dx + dy * dy
    t = ((px - ax) * dx + (py - ay) * dy) / squared if squared > 0.0 else 0.0
    t = min(max(t, 0.0), 1.0)
    qx, qy = ax + t * dx - px, ay + t * dy - py
    return t, qx * qx + qy * qy


@kernel(fastmath=False)
def _locate(px: Any, py: Any, a: Any, b: Any, c: Any) -> Any:
    """Corner weights of a triangle's point nearest to a texel centre, and how far off that is.

    The last is the squared distance outside, minus the squared distance to the border inside.
    """
    wa, wb, wc = -1.0, -1.0, -1.0
    area = (b[0] - a[0]) * (c[1] - a[1]) - (c[0] - a[0]) * (b[1] - a[1])
    if area != 0.0:
        wa = ((b[0] - px) * (c[1] - py) - (c[0] - px) * (b[1] - py)) / area
        wb = ((c[0] - px) * (a[1] - py) - (a[0] - px) * (c[1] - py)) / area
        wc = 1.0 - wa - wb
    along_ab, to_ab = _nearest_on_segment(px, py, a[0], a[1], b[0], b[1])
    along_bc, to_bc = _nearest_on_segment(px, py, b[0], b[1], c[0], c[1])
    along_ca, to_ca = _nearest_on_segment(px, py, c[0], c[1], a[0], a[1])
    edge = min(to_ab, to_bc, to_ca)
    if wa >= 0.0 and wb >= 0.0 and wc >= 0.0:
        return wa, wb, wc, -edge
    if edge == to_ab:
        return 1.0 - along_ab, along_ab, 0.0, edge
    if edge == to_bc:
        return 0.0, 1.0 - along_bc, along_bc, edge
    return along_ca, 0.0, 1.0 - along_ca, edge


@kernel(parallel=True, fastmath=False)
def _rasterize(
    points: NDArray[np.float64],
    faces: NDArray[np.int64],
    face: NDArray[np.int32],
    weights: NDArray[np.float32],
    loser: NDArray[np.int32],
) -> None:
    """Each task owns a band of rows; faces are visited in order, nearer ones replace others."""
    size = face.shape[0]
    rows = (size + BANDS - 1) // BANDS
    for band in prange(BANDS):
        first, last = band * rows, min(size, (band + 1) * rows) - 1
        nearest = np.full((rows, size), REACH_TEXELS * REACH_TEXELS)
        for f in range(faces.shape[0]):
            a, b, c = points[faces[f, 0]], points[faces[f, 1]], points[faces[f, 2]]
            y0 = max(first, int(np.floor(min(a[1], b[1], c[1]) - 0.5 - REACH_TEXELS)))
            y1 = min(last, int(np.ceil(max(a[1], b[1], c[1]) - 0.5 + REACH_TEXELS)))
            x0 = max(0, int(np.floor(min(a[0], b[0], c[0]) - 0.5 - REACH_TEXELS)))
            x1 = min(size - 1, int(np.ceil(max(a[0], b[0], c[0]) - 0.5 + REACH_TEXELS)))
            for y in range(y0, y1 + 1):
                for x in range(x0, x1 + 1):
                    wa, wb, wc, off = _locate(x + 0.5, y + 0.5, a, b, c)
                    before = nearest[y - first, x]
                    if max(before, off) < -STRICTLY_INSIDE * STRICTLY_INSIDE:
                        loser[y, x] = f
                    # The deeper face wins a centre that two share.
                    elif off < before:
                        nearest[y - first, x] = off
                        face[y, x] = f
                        weights[y, x, 0], weights[y, x, 1], weights[y, x, 2] = wa, wb, wc


def to_image(values: Float[Tensor, "P C"], texels: Texels) -> Float[Tensor, "T T C"]:
    """Scatter texel values into a texture and continue them over its empty texels.

    Every empty texel takes the value of the nearest filled one, so that neither bilinear lookups
    nor mip levels mix in a foreign colour.
    """
    size = texels.size
    image = values.new_zeros(size * size, values.shape[1])
    image[texels.pixel] = values
    filled = torch.zeros(size * size, dtype=torch.bool)
    filled[texels.pixel] = True
    return fill_empty(image.view(size, size, -1), filled.view(size, size))


def fill_empty(
    image: Float[Tensor, "H W C"], filled: Bool[Tensor, "H W"]
) -> Float[Tensor, "H W C"]:
    """Give each empty pixel the value of the nearest filled one; all empty stays as it is."""
    if bool(filled.all()) or not bool(filled.any()):
        return image
    nearest = distance_transform_edt(
        ~filled.numpy(force=True), return_distances=False, return_indices=True
    )
    row, column = torch.from_numpy(nearest.astype(np.int64)).to(image.device)
    return image[row, column]


def average_down(
    values: Float[Tensor, "P C"], texels: Texels, factor: int
) -> tuple[Float[Tensor, "Q C"], Texels]:
    """Mean over factor x factor blocks of the texels that show the surface: supersampling.

    Returns:
        The means and the coarser texels; `face` and `barycentric` are those of each block's first.
    """
    if factor == 1:
        return values, texels
    size = texels.size // factor
    row, column = texels.pixel // texels.size // factor, texels.pixel % texels.size // factor
    block, inverse = torch.unique(row * size + column, return_inverse=True)
    count = torch.bincount(inverse, minlength=len(block))
    total = values.new_zeros(len(block), values.shape[1]).index_add(0, inverse, values)
    order = torch.argsort(inverse, stable=True)
    first = order[torch.cumsum(count, 0) - count]
    coarse = Texels(
        pixel=block,
        face=texels.face[first],
        barycentric=texels.barycentric[first],
        size=size,
        overlaps=texels.overlaps,
        overlapping=texels.overlapping,
    )
    return total / count[:, None], coarse
