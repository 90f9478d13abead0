"""Do views agree where they show the same point? Answered by reprojection, without any truth.

Every covered pixel of a view is carried by its depth to a point in the world and from there into
another view. It is compared where that view sees the same point: the point falls between four
covered pixels, and their depth is the point's. Depth comes from the views themselves or from a
mesh (`mesh_depth`); an asset's own views agree by construction, so that the figure is for views
that a generator drew.

What depends on the direction of view, as highlights do, differs between true views too. Compare a
figure of radiance to that of true views, or compare basecolor.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from svim3d.cameras import FAR, NEAR, Cameras
from svim3d.raster.zbuffer import rasterize

# World units, of an object whose longest side is 1: two percent of it, below the thickness of a
# handle and above what a pixel of a steep surface spans at a few hundred pixels.
DEPTH_TOLERANCE = 0.02


@dataclass(frozen=True)
class Consistency:
    """How well views agree.

    Attributes:
        error: mean absolute difference over channels and compared pixels; NaN if none was.
        rmse: root of the mean square difference over the same.
        share: of the first views' covered pixels that were compared. A small error over a small
            share says little.
        pixels: that were compared.
    """

    error: float
    rmse: float
    share: float
    pixels: int


@dataclass(frozen=True)
class Correspondence:
    """Which pixels of one view another one shows.

    Attributes:
        pixels: flat indices into the first view.
        column: of the same points in the other view, in pixels from its left border.
        row: from its upper border.
    """

    pixels: Int[Tensor, "P"]
    column: Float[Tensor, "P"]
    row: Float[Tensor, "P"]


def view_consistency(
    images: Float[Tensor, "V H W C"],
    depth: Float[Tensor, "V H W 1"],
    mask: Bool[Tensor, "V H W 1"],
    cameras: Cameras,
    *,
    step: int = 1,
    tolerance: float = DEPTH_TOLERANCE,
) -> Consistency:
    """Compare every view of a closed orbit to the one `step` places on.

    Args:
        images: not premultiplied; encoded for display if the figure is to match what is seen.
        depth: along each camera's -z axis, world units.
        mask: pixels that show nothing but the object.
        cameras: of the views.
        step: how far apart compared views are.
        tolerance: difference of depth up to which two points are the same, world units.
    """
    absolute, squared, pixels = 0.0, 0.0, 0
    for view in range(len(cameras)):
        other = (view + step) % len(cameras)
        same = correspond(depth, mask, cameras, view, other, tolerance=tolerance)
        own = images[view].flatten(0, 1)[same.pixels].double()
        difference = own - _sample(images[other].double(), same.column, same.row)
        absolute += float(difference.abs().mean(-1).sum())
        squared += float(difference.square().mean(-1).sum())
        pixels += len(same.pixels)
    if not pixels:
        return Consistency(math.nan, math.nan, 0.0, 0)
    share = pixels / int(mask.sum())
    return Consistency(absolute / pixels, math.sqrt(squared / pixels), share, pixels)


def correspond(
    depth: Float[Tensor, "V H W 1"],
    mask: Bool[Tensor, "V H W 1"],
    cameras: Cameras,
    view: int,
    other: int,
    *,
    tolerance: float = DEPTH_TOLERANCE,
) -> Correspondence:
    """The pixels of `view` whose points `other` sees, and where."""
    pixels = torch.nonzero(mask[view].reshape(-1))[:, 0]
    local = cameras.pixel_directions(pixels).double()
    along = depth[view].reshape(-1, 1)[pixels].double()
    # Depth runs along -z, so a ray is as long as its z component is short.
    pose = cameras.c2w[view].double()
    points = (local / -local[:, 2:] * along) @ pose[:3, :3].T + pose[:3, 3]
    back = torch.linalg.inv(cameras.c2w[other].double())
    seen = points @ back[:3, :3].T + back[:3, 3]
    distance = -seen[:, 2]
    # A point behind the other camera lands somewhere; no depth there is negative as its own is.
    ahead = distance.clamp_min(NEAR)
    column = 0.5 * cameras.width + cameras.focal_px * seen[:, 0] / ahead
    row = 0.5 * cameras.height - cameras.focal_px * seen[:, 1] / ahead
    inside = _within(column, cameras.width) & _within(row, cameras.height)
    pixels, column, row, distance = (x[inside] for x in (pixels, column, row, distance))
    met = _sample(depth[other].double(), column, row)[:, 0]
    covered = _sample(mask[other].double(), column, row)[:, 0]
    # Between four pixels of one surface the depth is the point's; across an edge it is nobody's.
    is_same = (covered > 1.0 - 1e-9) & ((met - distance).abs() <= tolerance)
    return Correspondence(pixels[is_same], column[is_same], row[is_same])


def mesh_depth(
    vertices: Float[Tensor, "N 3"], faces: Int[Tensor, "F 3"], cameras: Cameras
) -> tuple[Float[Tensor, "V H W 1"], Bool[Tensor, "V H W 1"]]:
    """Depth along each camera's -z axis at pixel centres, zero where nothing is, and where is."""
    clip = cameras.project(vertices)
    views = [
        rasterize(clip[view], faces, cameras.height, cameras.width, cull_backfaces=False).depth
        for view in range(len(cameras))
    ]
    window = torch.stack(views)[..., None]
    is_covered = window.isfinite()
    ndc = 2.0 * torch.where(is_covered, window, 0.0).double() - 1.0
    depth = 2.0 * FAR * NEAR / (FAR + NEAR - ndc * (FAR - NEAR))
    return torch.where(is_covered, depth, 0.0).to(vertices.dtype), is_covered


def _within(coordinate: Float[Tensor, "P"], size: int) -> Bool[Tensor, "P"]:
    """Whether it lies between pixel centres, so that nothing is extrapolated."""
    return (coordinate >= 0.5) & (coordinate <= size - 0.5)


def _sample(
    image: Float[Tensor, "H W C"], column: Float[Tensor, "P"], row: Float[Tensor, "P"]
) -> Float[Tensor, "P C"]:
    """Bilinear between the four pixel centres around each place."""
    grid = torch.stack([2.0 * column / image.shape[1] - 1.0, 2.0 * row / image.shape[0] - 1.0], -1)
    planes = image.movedim(-1, 0)[None]
    found = torch.nn.functional.grid_sample(
        planes, grid[None, None], mode="bilinear", align_corners=False
    )
    return found[0, :, 0].T
