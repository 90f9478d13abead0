"""A homography per view: where a picture shows what the camera should have seen at a pixel.

Positions are normalised: x runs right and y down over [-1, 1], from edge to edge of the picture. A
warp is held as the shifts of the picture's four corners, which are eight numbers like the entries
of H = I + delta but all of one unit: a bound on them bounds the warp everywhere inside. Pictures
are read at warped positions, never moved themselves: reading a fixed picture is differentiable in
the warp by that picture's own gradient, whatever is rendered beside it.
Source: SViM3D sec. 4, phase 1.
"""

from dataclasses import dataclass
from typing import Self

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

CORNERS = ((-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0))  # in the order of their shifts
FREEDOMS = 8
MAX_SHIFT = 0.5  # from here on the corners could change places and H lose its inverse


@dataclass(frozen=True)
class ViewCorrections:
    """What was learnt of V views: how each has to be read, and how far it can be trusted.

    Attributes:
        shifts: corner shifts of the warps.
        weights: in [0, 1], 1 for a view that agrees with the others.
    """

    shifts: Float[Tensor, "V 4 2"]
    weights: Float[Tensor, "V"]

    def tensors(self) -> dict[str, Tensor]:
        """Named for a file or a checkpoint."""
        return {"views.shifts": self.shifts, "views.weights": self.weights}

    def to(self, device: torch.device | str) -> "ViewCorrections":
        """The same on another device."""
        return ViewCorrections(self.shifts.to(device), self.weights.to(device))

    @classmethod
    def taken_from(cls, tensors: dict[str, Tensor]) -> Self | None:
        """Those of `tensors`, taken out of the dictionary; None if there are none."""
        if "views.shifts" not in tensors:
            return None
        return cls(tensors.pop("views.shifts"), tensors.pop("views.weights"))


def homographies(shifts: Float[Tensor, "V 4 2"]) -> Float[Tensor, "V 3 3"]:
    """The projective map that takes the four corners to where their shifts put them.

    Source: Heckbert 1989, "Fundamentals of texture mapping", sec. 2.2.3 (square to quadrilateral).
    The last entry is one; no shift gives the identity exactly.
    """
    a, b, c, d = (shifts + shifts.new_tensor(CORNERS)).unbind(1)
    bend, right, below = a - b + c - d, b - c, d - c
    area = _cross(right, below)
    g, h = _cross(bend, below) / area, _cross(right, bend) / area
    column_u, column_v = b - a + g * b, d - a + h * d
    # From the unit square to the picture's own square, u = (x + 1) / 2.
    x, y = 0.5 * column_u, 0.5 * column_v
    last = torch.cat([0.5 * g, 0.5 * h, 1.0 + 0.5 * (g + h)], 1)[:, None]
    rows = torch.stack([x, y, a + x + y], 2)
    matrix = torch.cat([rows, last], 1)
    return matrix / matrix[:, 2:, 2:]


def _cross(a: Float[Tensor, "V 2"], b: Float[Tensor, "V 2"]) -> Float[Tensor, "V 1"]:
    """Area of the parallelogram between two vectors, with its sign."""
    return a[:, :1] * b[:, 1:] - a[:, 1:] * b[:, :1]


def inverse_shifts(shifts: Float[Tensor, "V 4 2"]) -> Float[Tensor, "V 4 2"]:
    """The warps that undo these, exactly."""
    back = torch.linalg.inv(homographies(shifts).double()).to(shifts)
    corners = shifts.new_tensor(CORNERS)
    return apply(back[:, None], corners.expand(len(shifts), 4, 2)) - corners


def apply(
    matrix: Float[Tensor, "*batch 3 3"], position: Float[Tensor, "*points 2"]
) -> Float[Tensor, "*points 2"]:
    """Map positions by homographies; the batches broadcast."""
    moved = (matrix[..., :2] @ position[..., None])[..., 0] + matrix[..., 2]
    return moved[..., :2] / moved[..., 2:]


def pixel_shifts(
    shifts: Float[Tensor, "V 4 2"], view: Int[Tensor, "P"], position: Float[Tensor, "P 2"]
) -> Float[Tensor, "P 2"]:
    """How far the warps of their views move positions; exactly zero without corner shifts."""
    delta = homographies(shifts) - torch.eye(3, dtype=shifts.dtype, device=shifts.device)
    here = delta.index_select(0, view)
    moved = (here[..., :2] @ position[..., None])[..., 0] + here[..., 2]
    # (p + m) / (1 + w) - p = (m - w p) / (1 + w)
    return (moved[:, :2] - moved[:, 2:] * position) / (1.0 + moved[:, 2:])


def bounded(shifts: Float[Tensor, "V 4 2"], limit: float) -> Float[Tensor, "V 4 2"]:
    """Corner shifts of at most `limit`, the rest unchanged; below `MAX_SHIFT` det H stays positive.

    A warp that is too large is scaled down as a whole, so that it stays a warp of its kind.
    """
    largest = shifts.norm(dim=-1).amax(1)[:, None, None]
    return torch.where(largest > limit, shifts * (limit / largest.clamp_min(limit)), shifts)


def corner_basis(position: Float[Tensor, "P 2"]) -> Float[Tensor, "P 2 8"]:
    """How far each position moves with each corner shift (x of corner 0, y, x of corner 1, ...).

    The derivative at the identity: a homography near it is I + delta, whose eight entries move a
    position by a polynomial of degree two.
    """
    at_corners = _delta_basis(position.new_tensor(CORNERS).double()).reshape(FREEDOMS, FREEDOMS)
    return _delta_basis(position) @ torch.linalg.inv(at_corners).to(position)


def _delta_basis(position: Float[Tensor, "P 2"]) -> Float[Tensor, "P 2 8"]:
    """Motion of positions by each entry of delta, row by row; the last entry of H is one."""
    x, y = position.unbind(1)
    one, zero = torch.ones_like(x), torch.zeros_like(x)
    return torch.stack(
        [
            torch.stack([x, y, one, zero, zero, zero, -x * x, -x * y], 1),
            torch.stack([zero, zero, zero, x, y, one, -x * y, -y * y], 1),
        ],
        1,
    )


def pixel_positions(pixels: Int[Tensor, "P"], height: int, width: int) -> Float[Tensor, "P 2"]:
    """Normalised positions of the centres of flat pixel indices, of one picture or of many."""
    column, row = (pixels % width).float() + 0.5, (pixels // width % height).float() + 0.5
    return torch.stack([column * (2.0 / width) - 1.0, row * (2.0 / height) - 1.0], 1)


def is_inside(position: Float[Tensor, "P 2"]) -> Bool[Tensor, "P"]:
    """Whether positions lie in the picture; what lies beyond was never drawn."""
    return (position.abs() <= 1.0).all(1)


def read(
    pictures: Float[Tensor, "N C"],
    pixels: Int[Tensor, "P"],
    shift: Float[Tensor, "P 2"],
    height: int,
    width: int,
) -> Float[Tensor, "P C"]:
    """Bilinear values at shifted pixels; differentiable in shifts and pictures.

    Without a shift the value is the pixel's own, exactly. Beyond the border the border goes on.

    Args:
        pictures: the pixels of all views, flat: N = V x height x width.
        pixels: flat indices into them.
        shift: normalised.
        height: rows of a view.
        width: columns of a view.
    """
    size = shift.new_tensor([width, height])
    own = torch.stack([pixels % width, pixels // width % height], 1)
    place = torch.minimum((own + shift * (0.5 * size)).clamp_min(0.0), size - 1.0)
    corner = torch.minimum(place.detach().floor(), size - 2.0)
    right, down = (place - corner).split(1, 1)
    column, row = corner.long().unbind(1)
    first = pixels - own[:, 1] * width - own[:, 0] + row * width + column
    index = torch.stack([first, first + 1, first + width, first + width + 1], 1)
    taps = pictures.index_select(0, index.reshape(-1)).view(*index.shape, -1)
    # In this form a picture of one value is read as that value to the bit.
    left = taps[:, 0::2]
    upper, lower = (left + right[:, None] * (taps[:, 1::2] - left)).unbind(1)
    return upper + down * (lower - upper)


def read_through(
    corrections: ViewCorrections,
    pictures: Float[Tensor, "N C"],
    pixels: Int[Tensor, "P"],
    height: int,
    width: int,
) -> tuple[Float[Tensor, "P C"], Float[Tensor, "P 1"]]:
    """What views show where their warps put pixels, and the weight of that.

    The weight is that of the view, or zero where the warp leaves the picture.

    Args:
        corrections: of all views.
        pictures: the pixels of all views, flat: N = V x height x width.
        pixels: flat indices into them.
        height: rows of a view.
        width: columns of a view.
    """
    view = pixels // (height * width)
    position = pixel_positions(pixels, height, width)
    moved = pixel_shifts(corrections.shifts, view, position)
    values = read(pictures, pixels, moved, height, width)
    return values, (is_inside(position + moved) * corrections.weights[view])[:, None]
