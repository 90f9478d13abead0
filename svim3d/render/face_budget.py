"""How many faces a surface needs: decimation that ends where the views would notice.

Face counts form a curve, each sqrt(2) times the next. Along it the decimated surface is held
against pictures: by the overlap of the silhouettes and by the angle to the normals that the
pictures show. What counts is by how much either is worse than that of the undecimated surface:
roughness that the views do not show is no reason to keep faces. Levels of detail are the same
curve, cut at larger errors.
"""

import math
from dataclasses import dataclass
from typing import Self

import torch
from jaxtyping import Float, Int
from torch import Tensor

from svim3d.cameras import Cameras
from svim3d.mesh.cleanup import CleanMesh, decimate
from svim3d.mesh.mesh import vertex_normals
from svim3d.metrics import mean_angle_deg
from svim3d.raster.interpolation import interpolate
from svim3d.raster.zbuffer import rasterize

CURVE_RATIO = math.sqrt(2.0)  # from one face count to the next
FEWEST_FACES = 64  # where the curve ends
MOSTLY = 0.5  # coverage of pixels whose normals are compared
# Eight discs of half the width of 256 px have 103,000 pixels, and 0.2 % of them are 206. More and
# larger views tell the same at their own cost.
PICTURE_PX = 256
PICTURE_PIXELS = 8 * PICTURE_PX**2


@dataclass(frozen=True)
class ShapeError:
    """How far a surface is from what pictures show; or how far it may be.

    Attributes:
        silhouette: 1 - IoU of what surface and pictures cover, over all pictures.
        normal_deg: mean angle between the shading normals where both cover, degrees.
    """

    silhouette: float
    normal_deg: float

    def within(self, limit: "ShapeError") -> bool:
        """Whether neither part exceeds its limit."""
        return self.silhouette <= limit.silhouette and self.normal_deg <= limit.normal_deg

    def beyond(self, other: "ShapeError") -> "ShapeError":
        """By how much this one is larger; negative where it is smaller."""
        return ShapeError(self.silhouette - other.silhouette, self.normal_deg - other.normal_deg)


UNSEEN = ShapeError(silhouette=0.002, normal_deg=1.0)  # a smaller difference is not noticed
# Where the curve is cut for three coarser levels of detail.
COARSER = (ShapeError(0.005, 2.0), ShapeError(0.015, 5.0), ShapeError(0.04, 10.0))


@dataclass(frozen=True)
class ShapePictures:
    """What surfaces are held against.

    Attributes:
        cameras: V poses.
        covered: coverage in [0, 1].
        normals: unit, world frame; of no meaning where nothing is covered.
    """

    cameras: Cameras
    covered: Float[Tensor, "V H W 1"]
    normals: Float[Tensor, "V H W 3"]

    @classmethod
    def of_views(
        cls,
        cameras: Cameras,
        mask: Float[Tensor, "V H W 1"],
        normals: Float[Tensor, "V H W 3"],
    ) -> Self:
        """Every so many of an orbit's views, `PICTURE_PIXELS` in all."""
        stride = max(1, len(cameras) * cameras.height * cameras.width // PICTURE_PIXELS)
        return cls(cameras[::stride], mask[::stride], normals[::stride])

    @classmethod
    def of_surface(
        cls, vertices: Float[Tensor, "N 3"], faces: Int[Tensor, "F 3"], cameras: Cameras
    ) -> Self:
        """Pictures of another surface."""
        return cls(cameras, *_pictures(vertices, faces, cameras))

    def error(self, vertices: Float[Tensor, "N 3"], faces: Int[Tensor, "F 3"]) -> ShapeError:
        """How far a surface is from what they show."""
        covered, normals = _pictures(vertices, faces, self.cameras)
        both = (self.covered > MOSTLY) & (covered > MOSTLY)
        if not bool(both.any()):
            return ShapeError(1.0, 180.0)
        shared = torch.minimum(self.covered, covered).double().sum()
        overlap = float(shared / torch.maximum(self.covered, covered).double().sum())
        return ShapeError(1.0 - overlap, mean_angle_deg(self.normals, normals, both))


def _pictures(
    vertices: Float[Tensor, "N 3"], faces: Int[Tensor, "F 3"], cameras: Cameras
) -> tuple[Float[Tensor, "V H W 1"], Float[Tensor, "V H W 3"]]:
    """Coverage and mean vertex normals, of `PICTURE_PX` samples across at least."""
    views, height, width = len(cameras), cameras.height, cameras.width
    samples = -(-PICTURE_PX // max(height, width))
    smooth = vertex_normals(vertices, faces)
    stacked = torch.cat([smooth, torch.ones_like(smooth[:, :1])], 1)
    clip = cameras.project(vertices)
    images = torch.zeros(views, height * width, 4)
    for view in range(views):
        fragments = rasterize(clip[view], faces, height * samples, width * samples)
        sample, values = interpolate(clip[view], faces, fragments, stacked)
        row, column = sample // (width * samples), sample % (width * samples)
        pixel = row // samples * width + column // samples
        images[view].index_add_(0, pixel, values / samples**2)
    normals, covered = images.view(views, height, width, 4).split([3, 1], -1)
    return covered, normals


@dataclass(frozen=True)
class Decimation:
    """A decimated surface, and by how much it is farther from the pictures than what it came of."""

    mesh: CleanMesh
    error: ShapeError


def face_counts(most: int) -> list[int]:
    """The curve: descending from `most` by `CURVE_RATIO` to `FEWEST_FACES` at least."""
    steps = int(math.log(max(most, FEWEST_FACES) / FEWEST_FACES) / math.log(CURVE_RATIO))
    return [round(most / CURVE_RATIO**step) for step in range(steps + 1)]


def decimate_to_error(
    vertices: Float[Tensor, "N 3"],
    faces: Int[Tensor, "F 3"],
    pictures: ShapePictures,
    *,
    limit: ShapeError,
    max_faces: int,
) -> Decimation:
    """The fewest faces on the curve whose error rises by no more than the limit.

    Found by bisection, which takes the error for one that grows along the curve. Where even
    `max_faces` are too few for the limit, that many are taken. All are made of the surface of
    `max_faces`: decimating the whole one anew each time would take most of the time.

    Args:
        vertices: of the undecimated surface.
        faces: counter-clockwise seen from outside.
        pictures: what errors are measured against.
        limit: of the rise over the undecimated surface's own error.
        max_faces: where the curve begins.
    """
    before = pictures.error(vertices, faces)
    densest = decimate(vertices, faces, max_faces=max_faces)
    counts = face_counts(len(densest.faces))

    def attempt(step: int) -> Decimation:
        mesh = densest
        if step:
            mesh = decimate(densest.vertices, densest.faces, max_faces=counts[step])
        error = pictures.error(mesh.vertices, mesh.faces).beyond(before)
        return Decimation(CleanMesh(mesh.vertices, mesh.faces, densest.notes), error)

    best, good, bad = attempt(0), 0, len(counts)
    if not best.error.within(limit):
        return best
    while bad - good > 1:
        middle = (good + bad) // 2
        found = attempt(middle)
        if found.error.within(limit):
            best, good = found, middle
        else:
            bad = middle
    return best
