"""Pinhole cameras on an orbit: poses, projection, rays.

World: right-handed, y up. Camera: OpenGL axes (x right, y up, looks down -z). Pixel centres lie at
(column + 0.5, row + 0.5) with row 0 at the top.
"""

import math
from dataclasses import dataclass, replace
from typing import Self

import torch
from jaxtyping import Float, Int
from torch import Tensor

from svim3d.numerics import normalize

NEAR, FAR = 0.05, 100.0  # clip planes in world units; the object's longest side is 1


@dataclass(frozen=True)
class Cameras:
    """V pinhole cameras that share one field of view and one image size.

    Attributes:
        c2w: camera-to-world transforms, OpenGL axes.
        fov_y_deg: vertical field of view.
        height: image rows.
        width: image columns.
    """

    c2w: Float[Tensor, "V 4 4"]
    fov_y_deg: float
    height: int
    width: int

    def __len__(self) -> int:
        return int(self.c2w.shape[0])

    def __getitem__(self, index: int | slice | list[int]) -> "Cameras":
        """A subset of the views, in the order given."""
        chosen = [index] if isinstance(index, int) else index
        return replace(self, c2w=self.c2w[chosen])

    def to(self, device: torch.device) -> "Cameras":
        """The same cameras on another device."""
        return replace(self, c2w=self.c2w.to(device))

    def resized(self, height: int, width: int) -> "Cameras":
        """The same cameras with another image size; the aspect ratio must be kept."""
        return replace(self, height=height, width=width)

    @property
    def positions(self) -> Float[Tensor, "V 3"]:
        """Camera centres in world space."""
        return self.c2w[:, :3, 3]

    @property
    def azimuths(self) -> Float[Tensor, "V"]:
        """Where the cameras stand around the y axis: radians in [-pi, pi], 0 on +z."""
        return torch.atan2(self.positions[:, 0], self.positions[:, 2])

    @property
    def focal_px(self) -> float:
        """Focal length in pixels, equal for both axes."""
        return 0.5 * self.height / math.tan(math.radians(self.fov_y_deg) / 2)

    def clip_from_world(self) -> Float[Tensor, "V 4 4"]:
        """Projection times view: world points to OpenGL clip space."""
        y_scale = 1.0 / math.tan(math.radians(self.fov_y_deg) / 2)
        projection = self.c2w.new_zeros(4, 4)
        projection[0, 0] = y_scale * self.height / self.width
        projection[1, 1] = y_scale
        projection[2, 2] = (FAR + NEAR) / (NEAR - FAR)
        projection[2, 3] = 2.0 * FAR * NEAR / (NEAR - FAR)
        projection[3, 2] = -1.0
        return projection @ torch.linalg.inv(self.c2w)

    def project(self, points: Float[Tensor, "N 3"]) -> Float[Tensor, "V N 4"]:
        """World points to clip space, one set per view."""
        ones = points.new_ones(len(points), 1)
        return torch.cat([points, ones], -1) @ self.clip_from_world().transpose(1, 2)

    def pixel_directions(self, pixels: Int[Tensor, "P"]) -> Float[Tensor, "P 3"]:
        """Unit camera-space directions through the centres of flat pixel indices."""
        column = (pixels % self.width).to(self.c2w.dtype) + 0.5
        row = (pixels // self.width).to(self.c2w.dtype) + 0.5
        x = (column - 0.5 * self.width) / self.focal_px
        y = (0.5 * self.height - row) / self.focal_px
        return normalize(torch.stack([x, y, -torch.ones_like(x)], -1))

    def rays(self, view: int) -> tuple[Float[Tensor, "HW 3"], Float[Tensor, "HW 3"]]:
        """Origins and unit directions in world space through all pixel centres of one view."""
        pixels = torch.arange(self.height * self.width, device=self.c2w.device)
        directions = self.pixel_directions(pixels) @ self.c2w[view, :3, :3].T
        return self.positions[view].expand_as(directions), directions


def look_at_origin(elevation_deg: float, azimuth_deg: float, radius: float) -> Float[Tensor, "4 4"]:
    """Pose of a camera that looks at the origin; azimuth 0 stands on +z, 90 on +x.

    `elevation_deg` must lie strictly between -90 and 90: at the poles "up" has no meaning.
    """
    if not -90.0 < elevation_deg < 90.0:
        raise ValueError(f"elevation must lie in (-90, 90) degrees, got {elevation_deg}")
    elevation, azimuth = math.radians(elevation_deg), math.radians(azimuth_deg)
    backward = torch.tensor(
        [
            math.cos(elevation) * math.sin(azimuth),
            math.sin(elevation),
            math.cos(elevation) * math.cos(azimuth),
        ]
    )
    right = normalize(torch.linalg.cross(torch.tensor([0.0, 1.0, 0.0]), backward))
    c2w = torch.eye(4)
    c2w[:3, 0] = right
    c2w[:3, 1] = torch.linalg.cross(backward, right)
    c2w[:3, 2] = backward
    c2w[:3, 3] = radius * backward
    return c2w


def orbit_angles(
    views: int, mean_elevation_deg: float, elevation_swing_deg: float
) -> list[tuple[float, float]]:
    """(elevation, azimuth) of a closed orbit; the last view is the reference at azimuth 0.

    elevation = mean + swing * sin(azimuth); a swing of 0 is SV3D's static orbit.
    """
    azimuths = [360.0 * (i + 1) / views for i in range(views)]
    azimuths[-1] = 0.0
    return [
        (mean_elevation_deg + elevation_swing_deg * math.sin(math.radians(azimuth)), azimuth)
        for azimuth in azimuths
    ]


@dataclass(frozen=True)
class CameraPath:
    """Where the cameras of a clip stand, the reference view last.

    Attributes:
        angles: (elevation, azimuth) of each frame in degrees. The elevation is absolute; the
            azimuth counts from the reference view, counter-clockwise from above, in [0, 360).

    Raises:
        ValueError: fewer than two frames, a camera at or beyond a pole, numbers that are not
            finite, or a last frame whose azimuth is not 0.
    """

    angles: tuple[tuple[float, float], ...]

    def __post_init__(self) -> None:
        turned = tuple((float(e), float(a) % 360.0 % 360.0) for e, a in self.angles)
        object.__setattr__(self, "angles", turned)
        if len(turned) < 2:
            raise ValueError(f"wanted a path of at least 2 frames, got {len(turned)}")
        for frame, (elevation, azimuth) in enumerate(turned):
            if not (-90.0 < elevation < 90.0 and math.isfinite(azimuth)):
                raise ValueError(
                    "wanted elevations in (-90, 90) and finite azimuths in degrees, "
                    f"got ({elevation}, {azimuth}) at frame {frame}"
                )
        if turned[-1][1] != 0.0:
            raise ValueError(
                f"wanted the reference view last, at azimuth 0, got azimuth {turned[-1][1]}; "
                "append (elevation of the picture, 0) or count azimuths from the picture"
            )

    @classmethod
    def orbit(cls, views: int, elevation_deg: float, swing_deg: float = 0.0) -> Self:
        """Once around in even steps: static, or rising and sinking as the sine of the azimuth."""
        return cls(tuple(orbit_angles(views, elevation_deg, swing_deg)))

    def __len__(self) -> int:
        return len(self.angles)

    def tensors(self) -> tuple[Float[Tensor, "K"], Float[Tensor, "K"]]:
        """Elevations and azimuths of all frames in degrees."""
        elevation, azimuth = torch.tensor(self.angles).unbind(1)
        return elevation, azimuth


def orbit_cameras(
    angles: list[tuple[float, float]], *, radius: float, fov_y_deg: float, size: int
) -> Cameras:
    """Square cameras at (elevation, azimuth) pairs in degrees, all looking at the origin."""
    poses = torch.stack([look_at_origin(e, a, radius) for e, a in angles])
    return Cameras(c2w=poses, fov_y_deg=fov_y_deg, height=size, width=size)


def fitting_radius(vertices: Float[Tensor, "N 3"], fov_y_deg: float, fill: float) -> float:
    """Distance at which the bounding sphere about the origin takes `fill` of the image's height."""
    bound = float(torch.linalg.vector_norm(vertices, dim=1).max())
    half_angle = math.atan(fill * math.tan(math.radians(fov_y_deg) / 2))
    return bound / math.sin(half_angle)
