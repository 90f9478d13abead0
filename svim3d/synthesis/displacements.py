"""Displacements of pictures: random homographies, smooth warps, and resampling under both.

Coordinates of a picture are normalised: x to the right and y down, from -1 to 1 between its outer
edges, so that pixel (row i, column j) is centred at ((2j + 1)/W - 1, (2i + 1)/H - 1). A length in
`px` is one of pixels of a picture 256 wide: the same share of the picture at any size.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from svim3d.synthesis.dice import Dice

NOMINAL_WIDTH = 256  # pixels of the picture that lengths are told for
# Half side of the smallest box whose corners are moved. Corners of smaller boxes could pass each
# other; eight pixels are an eighth of this one's side.
MIN_HALF_PX = 32.0
SHARED_MOTION = 0.6  # of each corner's displacement: the object is off as a whole, and distorted
BOX_POINTS = 9  # along each side of the box, where displacements are looked at
REACH_ROUNDS = 3  # brings the largest displacement within a per cent of what was drawn
MIN_REACH_PX = 1e-6  # guards a ratio of displacements where there is none
LEAST_SHARE = 0.5  # of the largest displacement, that a view has at least


def nominal_px(shape: tuple[int, int]) -> Float[Tensor, "2"]:
    """Normalised lengths along x and y of one nominal pixel in a picture of (rows, columns)."""
    height, width = shape
    return torch.tensor([2.0 / NOMINAL_WIDTH, 2.0 * width / (height * NOMINAL_WIDTH)])


def pixel_centres(shape: tuple[int, int], like: Tensor) -> Float[Tensor, "H W 2"]:
    """Normalised coordinates of all pixels."""
    height, width = shape
    y_axis = (2.0 * torch.arange(height).to(like) + 1.0) / height - 1.0
    x_axis = (2.0 * torch.arange(width).to(like) + 1.0) / width - 1.0
    y, x = torch.meshgrid(y_axis, x_axis, indexing="ij")
    return torch.stack([x, y], -1)


def object_box(mask: Float[Tensor, "H W 1"]) -> Float[Tensor, "4 2"]:
    """Normalised corners, in turn, of the square about the middle of what is covered that holds it.

    A square, because corners of a slender box that move as far bend the picture far more. It is no
    smaller than `MIN_HALF_PX` allows; for an empty mask it is about the whole picture.
    """
    height, width, _ = mask.shape
    covered = mask[..., 0].cpu() > 0.5
    if not bool(covered.any()):
        low, high = torch.tensor([-1.0, -1.0]), torch.tensor([1.0, 1.0])
    else:
        row, column = torch.nonzero(covered).unbind(1)
        size = torch.tensor([width, height])
        low = 2.0 * torch.stack([column.min(), row.min()]) / size - 1.0
        high = 2.0 * torch.stack([column.max() + 1, row.max() + 1]) / size - 1.0
    unit = nominal_px((height, width))
    half = unit * (0.5 * (high - low) / unit).max().clamp_min(MIN_HALF_PX)
    middle = 0.5 * (low + high)
    corners = torch.tensor([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    return middle + corners * half


def random_homography(
    mask: Float[Tensor, "H W 1"], largest_px: float, dice: Dice
) -> Float[Tensor, "3 3"]:
    """Map from points of the true picture to where they are displaced, normalised, double.

    Each corner of the object's box moves, in part as the others do and in part by itself. The point
    of the box that moves farthest does so by a share of `largest_px` that is drawn between a half
    and one. The draws do not depend on `largest_px`.
    """
    corners = object_box(mask).double()
    together, alone = dice.uniforms(0.0, math.tau, 1), dice.uniforms(0.0, math.tau, 4)
    motion = SHARED_MOTION * _unit(together) + (1.0 - SHARED_MOTION) * _unit(alone)
    reach = largest_px * dice.uniform(LEAST_SHARE, 1.0)
    motion = (motion * reach * nominal_px((mask.shape[0], mask.shape[1]))).double()
    homography = homography_between(corners, corners + motion)
    # Perspective moves points between the corners farther than these, not quite in proportion.
    for _ in range(REACH_ROUNDS):
        motion = motion * (reach / max(largest_displacement_px(homography, mask), MIN_REACH_PX))
        homography = homography_between(corners, corners + motion)
    return homography


def largest_displacement_px(
    homography: Float[Tensor, "3 3"], mask: Float[Tensor, "H W 1"]
) -> float:
    """How far the point of the object's box that moves farthest does so, nominal pixels."""
    corners = object_box(mask).double()
    share = torch.linspace(0.0, 1.0, BOX_POINTS).double()
    y, x = torch.meshgrid(share, share, indexing="ij")
    points = corners[0] + (corners[2] - corners[0]) * torch.stack([x, y], -1)
    moved = transformed(homography.double(), points) - points
    unit = nominal_px((mask.shape[0], mask.shape[1])).double()
    return float(torch.linalg.vector_norm(moved / unit, dim=-1).max())


def _unit(angle_rad: Float[Tensor, "n"]) -> Float[Tensor, "n 2"]:
    return torch.stack([angle_rad.cos(), angle_rad.sin()], 1)


def homography_between(
    source: Float[Tensor, "4 2"], target: Float[Tensor, "4 2"]
) -> Float[Tensor, "3 3"]:
    """The homography that sends four points to four others; its last entry is 1.

    No three of the points may lie on a line. Source: Hartley and Zisserman 2004, eq. 4.1.
    """
    rows, right = [], []
    for (x, y), (u, v) in zip(source.double().tolist(), target.double().tolist(), strict=True):
        rows.append([x, y, 1.0, 0.0, 0.0, 0.0, -u * x, -u * y])
        rows.append([0.0, 0.0, 0.0, x, y, 1.0, -v * x, -v * y])
        right += [u, v]
    entries = torch.linalg.solve(
        torch.tensor(rows, dtype=torch.float64), torch.tensor(right, dtype=torch.float64)
    )
    return torch.cat([entries, entries.new_ones(1)]).view(3, 3)


def transformed(
    homography: Float[Tensor, "3 3"], points: Float[Tensor, "*batch 2"]
) -> Float[Tensor, "*batch 2"]:
    """Points under a homography."""
    matrix = homography.to(points)
    mapped = points @ matrix[:, :2].T + matrix[:, 2]
    return mapped[..., :2] / mapped[..., 2:]


def smooth_field(
    dice: Dice, channels: int, cells: int, shape: tuple[int, int]
) -> Float[Tensor, "H W channels"]:
    """A random vector field without steps, bent about once per cell; its longest vector is 1.

    Args:
        dice: what it is drawn from; the same draws give the same field, sampled, at any size.
        channels: components of a vector.
        cells: of the picture's width and of its height.
        shape: rows and columns.
    """
    knots = torch.randn(1, channels, cells + 3, cells + 3, generator=dice.generator)
    # The outer knots lie beyond the picture, so that its border is as any other part of it.
    inner = cells / (cells + 3)
    grid = pixel_centres(shape, knots)[None] * inner
    field = functional.grid_sample(knots, grid, mode="bicubic", align_corners=False)
    field = field[0].permute(1, 2, 0)
    return field / torch.linalg.vector_norm(field, dim=-1).max()


def source_points(
    homography: Float[Tensor, "3 3"], flow: Float[Tensor, "H W 2"]
) -> Float[Tensor, "H W 2"]:
    """Where each pixel of the displaced picture is read in the true one, normalised.

    Args:
        homography: true to displaced points.
        flow: a further, normalised, displacement of what each pixel reads.
    """
    centres = pixel_centres((flow.shape[0], flow.shape[1]), flow.double())
    back = transformed(torch.linalg.inv(homography.double()).to(flow.device), centres)
    return back.to(flow) + flow


def resample(
    picture: Float[Tensor, "H W C"], points: Float[Tensor, "h w 2"]
) -> Float[Tensor, "h w C"]:
    """Bilinear lookup at normalised points; beyond its border the picture is zero."""
    sampled = functional.grid_sample(
        picture.permute(2, 0, 1)[None], points[None], mode="bilinear", align_corners=False
    )
    return sampled[0].permute(1, 2, 0)
