"""Layouts in which files hold the sphere of directions: lat-long, octahedral, unfolded cube.

All are told in the frame of the lat-long picture: its centre looks along -z ("front"), +x lies to
the right, +y is up. Whoever calls the front of a cube +Z (OpenGL's cube maps, cmft) means the same
pictures: only the letter differs, as cube maps are left-handed.

Cube crosses, every face as seen from inside:

    horizontal, 4:3                     vertical, 3:4

             up                                  up
      left  front  right  back            left  front  right
            down                                down
                                                back, upside down

The edges that touch in the picture touch on the sphere: the lower edge of "up" is the upper edge
of "front". In the vertical cross "back" hangs from "down" and is turned by 180 degrees.
A strip, 6:1 or 1:6, holds right, left, up, down, front, back (OpenGL's +X -X +Y -Y +Z -Z), each
upright as in the horizontal cross. OpenEXR's own cube maps are oriented otherwise; not read.

Source: Debevec, "Image-based lighting", in Reinhard et al., "High Dynamic Range Imaging", 9.4.4
(vertical cross); cmft (horizontal cross and strips).
"""

import math
from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

from svim3d.shading.environment import downsample_latlong, latlong_cells
from svim3d.shading.octahedral import bilinear_taps, texel_solid_angles
from svim3d.shading.resampling import SphereCells, octahedral_from_cells, weighted_blocks

Layout = Literal["latlong", "octahedral", "cube cross"]

FACES = ("right", "left", "up", "down", "front", "back")
# Of every face: where its middle looks, and the directions of its columns and rows.
FACE_AXES = (
    ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
    ((-1, 0, 0), (0, 0, -1), (0, -1, 0)),
    ((0, 1, 0), (1, 0, 0), (0, 0, -1)),
    ((0, -1, 0), (1, 0, 0), (0, 0, 1)),
    ((0, 0, -1), (1, 0, 0), (0, -1, 0)),
    ((0, 0, 1), (-1, 0, 0), (0, -1, 0)),
)
# (row, column) of the faces in the order of FACES, by the picture's (rows, columns) of faces.
FACE_PLACES = {
    (3, 4): ((1, 2), (1, 0), (0, 1), (2, 1), (1, 1), (1, 3)),
    (4, 3): ((1, 2), (1, 0), (0, 1), (2, 1), (1, 1), (3, 1)),
    (1, 6): tuple((0, i) for i in range(6)),
    (6, 1): tuple((i, 0) for i in range(6)),
}
VERTICAL_CROSS = (4, 3)
MIN_SIZE, MAX_AUTOMATIC_SIZE = 16, 512  # of octahedral maps; beyond, only mirrors gain
MAX_EXCESS = 1.4  # how much finer a picture may be than the map before it is shrunk by blocks


def detected_layout(height: int, width: int) -> tuple[Layout, bool]:
    """The layout that a picture's shape suggests, and whether the shape fits it.

    2:1 is lat-long, 1:1 octahedral, 4:3, 3:4, 6:1 and 1:6 a cube. Anything else is taken as a
    lat-long picture of uneven scale and does not fit.
    """
    if width == 2 * height:
        return "latlong", True
    if width == height:
        return "octahedral", True
    if _face_grid(height, width) is not None:
        return "cube cross", True
    return "latlong", False


def octahedral_light(
    picture: Float[Tensor, "H W 3"], layout: Layout, size: int | None = None
) -> Float[Tensor, "size size 3"]:
    """The light as an octahedral map; its integral over the sphere is that of the picture.

    An octahedral picture of this very size passes through unchanged.

    Args:
        picture: linear radiance, finite.
        layout: how the picture holds the sphere.
        size: side of the map, a power of two; None takes `automatic_size`.

    Raises:
        ValueError: the layout does not fit the picture, or the size is no power of two.
    """
    size = size or automatic_size(picture.shape[0], picture.shape[1], layout)
    if size < 2 or size & (size - 1):
        raise ValueError(f"wanted the side of the light as a power of two, got {size}")
    if layout == "octahedral":
        if picture.shape[0] != picture.shape[1]:
            raise ValueError(_misfit(picture, layout, "as high as wide"))
        if picture.shape[0] == size:
            return picture
        return octahedral_from_cells(_octahedral_cells(picture, size), size)
    if layout == "cube cross":
        return octahedral_from_cells(_cube_cells(_faces(picture), size), size)
    rows = round(size / math.sqrt(2.0))  # of a lat-long picture of as many texels
    factor = _shrink_factor(rows, picture.shape[0], picture.shape[1])
    return octahedral_from_cells(latlong_cells(downsample_latlong(picture, factor)), size)


def automatic_size(height: int, width: int, layout: Layout) -> int:
    """The power of two whose square is nearest the number of texels, from 16 to 512."""
    texels = height * width / (2.0 if layout == "cube cross" and _is_cross(height, width) else 1.0)
    # A tie, H x 2 H with H a power of two, goes down to H: its texels are 1/9 wider than the rows.
    size = 1 << max(0, math.ceil(0.5 * math.log2(texels) - 0.5))
    return min(max(size, MIN_SIZE), MAX_AUTOMATIC_SIZE)


def _octahedral_cells(picture: Float[Tensor, "n n c"], size: int) -> SphereCells:
    """The texels of an octahedral picture of any side."""
    n = picture.shape[0]
    if n % 2:
        # Solid angles are known for even sides; four equal texels are one.
        picture, n = picture.repeat_interleave(2, 0).repeat_interleave(2, 1), 2 * n
    factor = _shrink_factor(size, n, n)
    factor = factor if n // factor % 2 == 0 else 1
    omega = texel_solid_angles(n, picture.double())[..., None]
    small = weighted_blocks(picture.double(), omega, factor).to(picture)
    n //= factor
    omega = texel_solid_angles(n, picture.double())
    return SphereCells(
        small.reshape(n * n, -1),
        omega.view(-1, 1),
        lambda d: bilinear_taps(d, n),
        math.sqrt(float(omega.min())),
    )


def _faces(picture: Float[Tensor, "H W c"]) -> Float[Tensor, "6 n n c"]:
    """Cut a cross or strip into upright faces in the order of FACES."""
    grid = _face_grid(picture.shape[0], picture.shape[1])
    if grid is None:
        raise ValueError(_misfit(picture, "cube cross", "4:3, 3:4, 6:1 or 1:6"))
    n = picture.shape[0] // grid[0]
    faces = [picture[r * n : (r + 1) * n, c * n : (c + 1) * n] for r, c in FACE_PLACES[grid]]
    if grid == VERTICAL_CROSS:
        faces[-1] = faces[-1].flip((0, 1))
    return torch.stack(faces)


def _cube_cells(faces: Float[Tensor, "6 n n c"], size: int) -> SphereCells:
    """The texels of a cube."""
    n = faces.shape[1]
    factor = _shrink_factor(round(size / math.sqrt(6.0)), n, n)
    omega = cube_solid_angles(n, faces.double())[..., None]
    small = torch.stack([weighted_blocks(face.double(), omega, factor).to(faces) for face in faces])
    n //= factor
    omega = cube_solid_angles(n, faces.double())
    return SphereCells(
        small.reshape(6 * n * n, -1),
        omega.view(1, -1, 1).expand(6, -1, 1).reshape(-1, 1),
        lambda d: _cube_taps(d, n),
        math.sqrt(float(omega.min())),
    )


def cube_solid_angles(n: int, like: Tensor) -> Float[Tensor, "n n"]:
    """Exact solid angles of the texels of one cube face, steradian; they sum to 2 pi / 3."""
    axis = torch.linspace(-1.0, 1.0, n + 1, dtype=torch.float64)
    y, x = torch.meshgrid(axis, axis, indexing="ij")
    # The solid angle of the rectangle between the face's middle and a corner.
    corner = torch.atan2(x * y, torch.sqrt(x * x + y * y + 1.0))
    return (corner[1:, 1:] - corner[:-1, 1:] - corner[1:, :-1] + corner[:-1, :-1]).to(like)


def _cube_taps(d: Float[Tensor, "P 3"], n: int) -> tuple[Int[Tensor, "P 4"], Float[Tensor, "P 4"]]:
    """Bilinear lookup; a tap beyond its face is the texel of the neighbour in that direction."""
    face, x, y = _face_coordinates(d)
    x, y = (x * 0.5 + 0.5) * n - 0.5, (y * 0.5 + 0.5) * n - 0.5
    x0, y0 = x.floor(), y.floor()
    fx, fy = x - x0, y - y0
    indices, weights = [], []
    for dy, wy in ((0, 1.0 - fy), (1, fy)):
        for dx, wx in ((0, 1.0 - fx), (1, fx)):
            indices.append(_cube_texel(face, x0 + dx, y0 + dy, n))
            weights.append(wx * wy)
    return torch.stack(indices, -1), torch.stack(weights, -1)


def _cube_texel(
    face: Int[Tensor, "P"], x: Float[Tensor, "P"], y: Float[Tensor, "P"], n: int
) -> Int[Tensor, "P"]:
    """Flat index of the texel at column x, row y of a face, at most one beyond its edge."""
    index = face * (n * n) + (y.clamp(0, n - 1) * n + x.clamp(0, n - 1)).long()
    outside = torch.nonzero((x < 0) | (x >= n) | (y < 0) | (y >= n))[:, 0]
    if len(outside):
        axes = torch.tensor(FACE_AXES, device=x.device).to(x)[face[outside]]
        right = ((x[outside] + 0.5) * 2.0 / n - 1.0)[:, None]
        down = ((y[outside] + 0.5) * 2.0 / n - 1.0)[:, None]
        other, u, v = _face_coordinates(axes[:, 0] + right * axes[:, 1] + down * axes[:, 2])
        column = ((u * 0.5 + 0.5) * n).floor().clamp(0, n - 1)
        row = ((v * 0.5 + 0.5) * n).floor().clamp(0, n - 1)
        index[outside] = other * (n * n) + (row * n + column).long()
    return index


def _face_coordinates(
    d: Float[Tensor, "P 3"],
) -> tuple[Int[Tensor, "P"], Float[Tensor, "P"], Float[Tensor, "P"]]:
    """Face that directions of any length meet, and their place on it in [-1, 1]."""
    largest = d.abs().argmax(-1)
    negative = d.gather(1, largest[:, None])[:, 0] < 0
    # In FACES: right, left | up, down | front (-z), back (+z).
    face = 2 * largest + torch.where(largest == 2, ~negative, negative).long()
    axes = torch.tensor(FACE_AXES, device=d.device).to(d)[face]
    ahead, right, down = (axes * d[:, None]).sum(-1).unbind(-1)
    return face, right / ahead, down / ahead


def _face_grid(height: int, width: int) -> tuple[int, int] | None:
    """Rows and columns of faces, if the picture's shape is one of a cube."""
    for rows, columns in FACE_PLACES:
        if height % rows == 0 and height // rows * columns == width:
            return rows, columns
    return None


def _is_cross(height: int, width: int) -> bool:
    """Half of a cross is paper."""
    return _face_grid(height, width) in ((3, 4), VERTICAL_CROSS)


def _shrink_factor(wanted: int, *sides: int) -> int:
    """Largest whole factor by which all sides divide and the first stays finer than wanted."""
    limit = max(1, int(sides[0] / (MAX_EXCESS * wanted)))
    return next(f for f in range(limit, 0, -1) if all(side % f == 0 for side in sides))


def _misfit(picture: Tensor, layout: Layout, wanted: str) -> str:
    height, width = picture.shape[:2]
    return f"wanted {layout} light {wanted}, got {width} x {height} pixels; choose another layout"
