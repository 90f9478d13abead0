"""Which triangle is seen at which pixel.

Coverage is decided by homogeneous edge functions, linear in the pixel position, so that triangles
that reach behind the camera need no clipping: a point is inside exactly where all three agree in
sign with the determinant, and the near plane is a depth test per pixel. Edge functions of a shared
edge are exact negatives of each other, so each pixel centre on it belongs to one triangle.
Source: Olano and Greer 1997, "Triangle scan conversion using 2D homogeneous coordinates".
"""

from dataclasses import dataclass

import numba
import numpy as np
import torch
from jaxtyping import Float, Int
from numpy.typing import NDArray
from torch import Tensor

from svim3d.compiled import kernel

BACKGROUND = -1  # triangle index of a pixel that sees nothing
BOUNDS_MARGIN_PX = 1e-3  # rounding of a bounding box must not lose a pixel centre on its border
BANDS_PER_THREAD = 2  # evens out the load of bands that see little of the object
CANDIDATES_PER_CHUNK = 1 << 21  # pixel-triangle pairs of the torch twin held at once, ~200 MB

FloatArray = NDArray[np.float32]
IntArray = NDArray[np.int32]


@dataclass(frozen=True)
class Fragments:
    """What a camera sees at each pixel centre.

    Attributes:
        triangle: index of the visible face, `BACKGROUND` where there is none.
        depth: window depth of that face, (z/w + 1) / 2 in [0, 1]; infinite where there is none.
    """

    triangle: Int[Tensor, "H W"]
    depth: Float[Tensor, "H W"]

    @property
    def pixels(self) -> Int[Tensor, "P"]:
        """Flat indices of the pixels that see a face, ascending."""
        return torch.nonzero(self.triangle.reshape(-1) != BACKGROUND)[:, 0]


def rasterize(
    clip: Float[Tensor, "N 4"],
    faces: Int[Tensor, "F 3"],
    height: int,
    width: int,
    *,
    cull_backfaces: bool = True,
) -> Fragments:
    """Visible face of every pixel; of faces at equal depth the first one.

    Not differentiable: `interpolate` and `antialias` carry the gradients.

    Args:
        clip: vertices in clip space.
        faces: counter-clockwise seen from the front.
        height: image rows.
        width: image columns.
        cull_backfaces: leave out faces seen from behind. Closed meshes lose nothing by it; open
            ones, texture atlases and two-sided materials need False.
    """
    clip, faces = clip.detach(), faces.int().contiguous()
    if clip.device.type == "cpu":
        triangle, depth = _rasterize_bands(
            clip.contiguous().numpy(),
            faces.numpy(),
            height,
            width,
            cull_backfaces,
            BANDS_PER_THREAD * numba.get_num_threads(),
        )
        return Fragments(torch.from_numpy(triangle), torch.from_numpy(depth))
    return rasterize_scatter(clip, faces, height, width, cull_backfaces=cull_backfaces)


@kernel(fastmath=False)
def _grow(
    bounds: NDArray[np.float64], x: float, y: float, w: float, height: int, width: int
) -> None:
    """Extend a pixel-space box by one projected point; everything if it has no projection."""
    if w > 0.0:
        column = (0.5 + 0.5 * x / w) * width
        row = (0.5 - 0.5 * y / w) * height
        bounds[0] = min(bounds[0], column)
        bounds[1] = max(bounds[1], column)
        bounds[2] = min(bounds[2], row)
        bounds[3] = max(bounds[3], row)
    else:
        bounds[0] = bounds[2] = -np.inf
        bounds[1] = bounds[3] = np.inf


@kernel(fastmath=False)
def _pixel_box(
    v: NDArray[np.float64], height: int, width: int, bounds: NDArray[np.float64]
) -> None:
    """Box, in pixels, around the part of a triangle that lies before the near plane."""
    bounds[0] = bounds[2] = np.inf
    bounds[1] = bounds[3] = -np.inf
    for i in range(3):
        j = (i + 1) % 3
        near_i, near_j = v[i, 2] + v[i, 3], v[j, 2] + v[j, 3]
        if near_i > 0.0:
            _grow(bounds, v[i, 0], v[i, 1], v[i, 3], height, width)
        if (near_i > 0.0) != (near_j > 0.0):
            t = near_i / (near_i - near_j)
            x = v[i, 0] + t * (v[j, 0] - v[i, 0])
            y = v[i, 1] + t * (v[j, 1] - v[i, 1])
            w = v[i, 3] + t * (v[j, 3] - v[i, 3])
            _grow(bounds, x, y, w, height, width)


@kernel(fastmath=False)
def _pixel_range(low: float, high: float, count: int) -> tuple[int, int]:
    """First and last pixel whose centre lies in [low, high], clipped to the image."""
    # Clipping comes before the conversion: a projection may exceed every integer.
    first = min(max(np.ceil(low - 0.5 - BOUNDS_MARGIN_PX), 0.0), float(count))
    last = min(max(np.floor(high - 0.5 + BOUNDS_MARGIN_PX), -1.0), count - 1.0)
    return int(first), int(last)


@kernel(parallel=True, fastmath=False)
def _face_boxes(
    clip: FloatArray, faces: IntArray, height: int, width: int, cull: bool, boxes: IntArray
) -> None:
    """First and last column and row of each face; an empty range where it cannot be seen."""
    for f in numba.prange(faces.shape[0]):
        v = np.empty((3, 4))
        for k in range(3):
            for c in range(4):
                v[k, c] = clip[faces[f, k], c]
        determinant = (
            v[0, 0] * (v[1, 1] * v[2, 3] - v[1, 3] * v[2, 1])
            + v[0, 1] * (v[1, 3] * v[2, 0] - v[1, 0] * v[2, 3])
            + v[0, 3] * (v[1, 0] * v[2, 1] - v[1, 1] * v[2, 0])
        )
        boxes[f, 0], boxes[f, 1], boxes[f, 2], boxes[f, 3] = 0, -1, 0, -1
        # Written so that a NaN, which compares false, is left out.
        if np.isfinite(determinant) and (determinant > 0.0 or (determinant < 0.0 and not cull)):
            bounds = np.empty(4)
            _pixel_box(v, height, width, bounds)
            if bounds[0] <= bounds[1] and bounds[2] <= bounds[3]:
                boxes[f, 0], boxes[f, 1] = _pixel_range(bounds[0], bounds[1], width)
                boxes[f, 2], boxes[f, 3] = _pixel_range(bounds[2], bounds[3], height)


@kernel(fastmath=False)
def _edge_functions(clip: FloatArray, face: IntArray, e: NDArray[np.float64]) -> None:
    """Rows (A, B, C) of the three edge functions A x + B y + C, and (z0, z1, z2) / |det|.

    Positive inside for either winding.
    """
    for k in range(3):
        i, j = face[(k + 1) % 3], face[(k + 2) % 3]
        xi, yi, wi = np.float64(clip[i, 0]), np.float64(clip[i, 1]), np.float64(clip[i, 3])
        xj, yj, wj = np.float64(clip[j, 0]), np.float64(clip[j, 1]), np.float64(clip[j, 3])
        e[k, 0] = yi * wj - wi * yj
        e[k, 1] = wi * xj - xi * wj
        e[k, 2] = xi * yj - yi * xj
    o = face[0]
    determinant = clip[o, 0] * e[0, 0] + clip[o, 1] * e[0, 1] + clip[o, 3] * e[0, 2]
    sign = 1.0 if determinant > 0.0 else -1.0
    for k in range(3):
        for c in range(3):
            e[k, c] *= sign
        e[3, k] = clip[face[k], 2] / (sign * determinant)


@kernel(fastmath=False)
def _owns(value: float, a: float, b: float) -> bool:
    """Whether a point is inside an edge; one on it belongs to the side that the rule names."""
    return value > 0.0 or (value == 0.0 and (a > 0.0 or (a == 0.0 and b > 0.0)))


@kernel(parallel=True, fastmath=False)
def _rasterize_bands(
    clip: FloatArray, faces: IntArray, height: int, width: int, cull: bool, bands: int
) -> tuple[IntArray, FloatArray]:
    """Z-buffer; each horizontal band is one task and writes its own rows only."""
    triangle = np.full((height, width), BACKGROUND, np.int32)
    depth = np.full((height, width), np.inf, np.float32)
    boxes = np.empty((faces.shape[0], 4), np.int32)
    _face_boxes(clip, faces, height, width, cull, boxes)
    rows = (height + bands - 1) // bands
    for band in numba.prange(bands):
        e = np.empty((4, 3))
        first, last = band * rows, min(height, (band + 1) * rows) - 1
        for f in range(faces.shape[0]):
            top, bottom = max(first, boxes[f, 2]), min(last, boxes[f, 3])
            if top > bottom or boxes[f, 0] > boxes[f, 1]:
                continue
            _edge_functions(clip, faces[f], e)
            for row in range(top, bottom + 1):
                y = 1.0 - (row + 0.5) * (2.0 / height)
                r0 = e[0, 1] * y + e[0, 2]
                r1 = e[1, 1] * y + e[1, 2]
                r2 = e[2, 1] * y + e[2, 2]
                for column in range(boxes[f, 0], boxes[f, 1] + 1):
                    x = (column + 0.5) * (2.0 / width) - 1.0
                    e0 = e[0, 0] * x + r0
                    e1 = e[1, 0] * x + r1
                    e2 = e[2, 0] * x + r2
                    if (
                        _owns(e0, e[0, 0], e[0, 1])
                        and _owns(e1, e[1, 0], e[1, 1])
                        and _owns(e2, e[2, 0], e[2, 1])
                    ):
                        z = e0 * e[3, 0] + e1 * e[3, 1] + e2 * e[3, 2]
                        window = np.float32(0.5 * z + 0.5)
                        if -1.0 <= z <= 1.0 and window < depth[row, column]:
                            depth[row, column] = window
                            triangle[row, column] = f
    return triangle, depth


def rasterize_scatter(
    clip: Float[Tensor, "N 4"],
    faces: Int[Tensor, "F 3"],
    height: int,
    width: int,
    *,
    cull_backfaces: bool = True,
) -> Fragments:
    """`rasterize` in plain torch, for any device; the same fragments to the bit.

    Every face is expanded over its pixel box; the nearest wins by a scattered minimum over
    (depth, face) packed into one 64-bit integer, which no order of execution can change.
    """
    corners = clip.detach().double()[faces.long()]
    planes, determinant = _edge_functions_torch(corners)
    facing = determinant > 0.0 if cull_backfaces else determinant != 0.0
    box = _face_boxes_torch(corners, height, width)
    columns = (box[:, 1] - box[:, 0] + 1).clamp_min(0)
    count = columns * (box[:, 3] - box[:, 2] + 1).clamp_min(0)
    count = torch.where(facing & determinant.isfinite(), count, 0)
    kept = torch.nonzero(count)[:, 0]
    empty = torch.iinfo(torch.int64).max
    packed = torch.full((height * width,), empty, dtype=torch.int64, device=clip.device)
    chunk = torch.cumsum(count[kept], 0) // CANDIDATES_PER_CHUNK
    sizes = torch.unique_consecutive(chunk, return_counts=True)[1].tolist()
    for part in torch.split(kept, sizes):
        pixel, key = _cover(
            planes[part], part, box[part], columns[part], count[part], (height, width)
        )
        packed.scatter_reduce_(0, pixel, key, "amin", include_self=True)
    hit = packed != empty
    triangle = torch.where(hit, packed & 0xFFFFFFFF, BACKGROUND).int()
    depth = (packed >> 32).int().view(torch.float32)
    depth = torch.where(hit, depth, torch.inf)
    return Fragments(triangle.view(height, width), depth.view(height, width))


def _face_boxes_torch(
    corners: Float[Tensor, "F 3 4"], height: int, width: int
) -> Int[Tensor, "F 4"]:
    """First and last column and row of each face; an empty range where it cannot be seen."""
    following = corners.roll(-1, 1)
    near = corners[..., 2] + corners[..., 3]
    near_following = near.roll(-1, 1)
    crosses = (near > 0.0) != (near_following > 0.0)
    t = torch.where(crosses, near / (near - near_following), 0.0)[..., None]
    points = torch.cat([corners, corners + t * (following - corners)], 1)
    used = torch.cat([near > 0.0, crosses], 1)
    unprojectable = used & ~(points[..., 3] > 0.0)
    column = (0.5 + 0.5 * points[..., 0] / points[..., 3]) * width
    row = (0.5 - 0.5 * points[..., 1] / points[..., 3]) * height
    box = []
    for value, pixels in ((column, width), (row, height)):
        low = torch.where(used, value, torch.inf).masked_fill(unprojectable, -torch.inf).amin(1)
        high = torch.where(used, value, -torch.inf).masked_fill(unprojectable, torch.inf).amax(1)
        first = torch.ceil(low - 0.5 - BOUNDS_MARGIN_PX).clamp(0, pixels)
        last = torch.floor(high - 0.5 + BOUNDS_MARGIN_PX).clamp(-1, pixels - 1)
        box += [first.nan_to_num(0.0).long(), last.nan_to_num(-1.0).long()]
    return torch.stack(box, 1)


def _edge_functions_torch(
    corners: Float[Tensor, "F 3 4"],
) -> tuple[Float[Tensor, "F 4 3"], Float[Tensor, "F"]]:
    """As `_edge_functions`, in the same order of operations; and the determinant."""
    xyw, z = corners[..., [0, 1, 3]], corners[..., 2]
    i, j = xyw[:, [1, 2, 0]], xyw[:, [2, 0, 1]]
    rows = torch.stack(
        [
            i[..., 1] * j[..., 2] - i[..., 2] * j[..., 1],
            i[..., 2] * j[..., 0] - i[..., 0] * j[..., 2],
            i[..., 0] * j[..., 1] - i[..., 1] * j[..., 0],
        ],
        -1,
    )
    o, first = xyw[:, 0], rows[:, 0]
    determinant = o[:, 0] * first[:, 0] + o[:, 1] * first[:, 1] + o[:, 2] * first[:, 2]
    sign = torch.where(determinant > 0.0, 1.0, -1.0).to(corners.dtype)
    depths = z / (sign * determinant)[:, None]
    return torch.cat([rows * sign[:, None, None], depths[:, None]], 1), determinant


def _cover(
    planes: Float[Tensor, "F 4 3"],
    face: Int[Tensor, "F"],
    box: Int[Tensor, "F 4"],
    columns: Int[Tensor, "F"],
    count: Int[Tensor, "F"],
    image_size: tuple[int, int],
) -> tuple[Int[Tensor, "C"], Int[Tensor, "C"]]:
    """Flat pixel and packed (depth, face) of every pixel centre inside a face."""
    height, width = image_size
    owner = torch.repeat_interleave(count)
    offset = torch.arange(len(owner), device=face.device) - (count.cumsum(0) - count)[owner]
    column = box[owner, 0] + offset % columns[owner]
    row = box[owner, 2] + offset // columns[owner]
    x = (column.double() + 0.5) * (2.0 / width) - 1.0
    y = 1.0 - (row.double() + 0.5) * (2.0 / height)
    plane = planes[owner]
    a, b, c = plane[:, :3, 0], plane[:, :3, 1], plane[:, :3, 2]
    e = a * x[:, None] + (b * y[:, None] + c)
    inside = ((e > 0.0) | ((e == 0.0) & ((a > 0.0) | ((a == 0.0) & (b > 0.0))))).all(1)
    z = e[:, 0] * plane[:, 3, 0] + e[:, 1] * plane[:, 3, 1] + e[:, 2] * plane[:, 3, 2]
    inside &= (z >= -1.0) & (z <= 1.0)
    window = (0.5 * z + 0.5).float()[inside]
    # Bits of non-negative floats order as integers do.
    key = (window.view(torch.int32).long() << 32) | face[owner][inside]
    return (row * width + column)[inside], key
