"""Where the truth has what was made of a photo: a similarity, fitted on the photo's own view alone.

A photo tells neither an object's size nor where in its frame it stood. Both silhouettes of the
photo's view tell a scale and a shift in the plane through the origin that faces its camera; no
other view is looked at, and depth stays as it was assumed.
"""

import math
from dataclasses import dataclass, replace
from typing import Self

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from svim3d.cameras import Cameras
from svim3d.mesh.source_mesh import SourceMesh

COVERED = 0.5
MIN_COVERAGE = 1e-3  # below it a straight colour is undefined
PREMULTIPLIED = ("radiance", "mask")


@dataclass(frozen=True)
class Framing:
    """x -> scale x + shift, from the frame of what was made to that of the truth.

    Attributes:
        scale: of lengths.
        shift: world units of the truth.
    """

    scale: float
    shift: Float[Tensor, "3"]

    @classmethod
    def none(cls) -> Self:
        """Both frames are one."""
        return cls(1.0, torch.zeros(3))

    @classmethod
    def fit(
        cls,
        camera: Cameras,
        mask: Float[Tensor, "h w 1"],
        true_camera: Cameras,
        true_mask: Float[Tensor, "H W 1"],
    ) -> Self:
        """Lay the silhouette's box over the true one, as seen by the photo's camera.

        Args:
            camera: one view, of what was made.
            mask: its coverage.
            true_camera: the same view of the truth.
            true_mask: its coverage.

        Raises:
            ValueError: one of the silhouettes is empty.
        """
        x, y, area = _box(camera, mask)
        true_x, true_y, true_area = _box(true_camera, true_mask)
        scale = math.sqrt(true_area / area)
        right, up = true_camera.c2w[0, :3, 0], true_camera.c2w[0, :3, 1]
        return cls(scale, (true_x - scale * x) * right + (true_y - scale * y) * up)

    def place(self, mesh: SourceMesh) -> SourceMesh:
        """The mesh in the truth's frame."""
        return replace(mesh, vertices=self.scale * mesh.vertices + self.shift)

    def resample(
        self, cameras: Cameras, images: dict[str, Tensor], true_cameras: Cameras
    ) -> dict[str, Tensor]:
        """Views as the truth's cameras show them, which stand in the same directions.

        What a pixel shows is taken to lie in the plane through the origin that faces the camera,
        so that perspective inside the object stays that of the given views.

        Args:
            cameras: V poses that look at the origin.
            images: named as in orbits, each [V, h, w, C].
            true_cameras: V poses, of any distance, field of view and size.
        """
        grid = self._grid(cameras, true_cameras)
        mask = images["mask"]
        shown = {}
        for name, image in images.items():
            flat = image if name in PREMULTIPLIED else image * mask
            planes = functional.grid_sample(
                flat.movedim(-1, 1), grid, mode="bilinear", align_corners=False
            )
            shown[name] = planes.movedim(1, -1)
        cover = shown["mask"]
        return {
            name: image
            if name in PREMULTIPLIED
            else image / cover.clamp_min(MIN_COVERAGE) * (cover > 0)
            for name, image in shown.items()
        }

    def _grid(self, cameras: Cameras, true_cameras: Cameras) -> Float[Tensor, "V H W 2"]:
        """Where each pixel of the true cameras lies on the given pictures, in [-1, 1]."""
        views = []
        for view in range(len(cameras)):
            pixels = torch.arange(true_cameras.height * true_cameras.width)
            toward = true_cameras.pixel_directions(pixels)
            plane = toward[:, :2] / -toward[:, 2:] * _distance(true_cameras, view)
            axes = true_cameras.c2w[view, :3, :2]
            point = ((plane @ axes.T) - self.shift) / self.scale
            seen = point @ cameras.c2w[view, :3, :2] / _distance(cameras, view)
            reach = 0.5 * cameras.height / cameras.focal_px
            x, y = seen.unbind(1)
            aspect = cameras.width / cameras.height
            grid = torch.stack([x / (reach * aspect), -y / reach], -1)
            views.append(grid.view(true_cameras.height, true_cameras.width, 2))
        return torch.stack(views)


def _distance(cameras: Cameras, view: int) -> float:
    """From the camera to the plane through the origin that faces it."""
    return float(cameras.positions[view] @ cameras.c2w[view, :3, 2])


def _box(camera: Cameras, mask: Float[Tensor, "h w 1"]) -> tuple[float, float, float]:
    """Centre (right, up) and area of a silhouette's box in the plane through the origin."""
    covered = mask[..., 0] > COVERED
    if not bool(covered.any()):
        raise ValueError("wanted a silhouette in the photo's view to fit a scale to, it is empty")
    rows, columns = (torch.nonzero(covered.any(axis))[:, 0] for axis in (1, 0))
    pixel = _distance(camera, 0) / camera.focal_px
    top, bottom = float(rows[0]), float(rows[-1]) + 1.0
    left, right = float(columns[0]), float(columns[-1]) + 1.0
    x = (0.5 * (left + right) - 0.5 * camera.width) * pixel
    y = (0.5 * camera.height - 0.5 * (top + bottom)) * pixel
    return x, y, (right - left) * (bottom - top) * pixel**2
