"""What is relit: views that came as pictures, or a mesh that is rendered view by view."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from svim3d.cameras import Cameras, fitting_radius, look_at_origin, orbit_angles, orbit_cameras
from svim3d.io.light import DISPLAY_SUFFIXES
from svim3d.io.orbit import read_frame, read_orbit
from svim3d.io.scene import read_object
from svim3d.mesh.source_mesh import SourceMesh, normalised
from svim3d.render.gbuffer import GBuffer
from svim3d.render.pictures import render_gbuffer

FRAME_SUFFIX = ".exr"
BUFFERS = ("mask", "basecolor", "roughness", "metallic", "normal_world")  # what shading needs
ASSET_FILL = 0.85  # share of the picture's height that an asset's bounding sphere takes
FRAME_RADIUS = 2.0  # distance of a frame's camera that no orbit tells; shading does not ask it


class Subject(Protocol):
    """Views with materials and normals, one at a time.

    Attributes:
        cameras: of all views, at the size of the finished pictures.
        reference: index of the view that stands for the object.
    """

    @property
    def cameras(self) -> Cameras:
        """One per view."""

    @property
    def reference(self) -> int:
        """One of them."""

    def view(self, index: int) -> GBuffer:
        """One view; its sides may be a multiple of the finished picture's."""


@dataclass(frozen=True)
class PictureSubject:
    """Views that came as pictures."""

    gbuffer: GBuffer
    reference: int

    @property
    def cameras(self) -> Cameras:
        """As read."""
        return self.gbuffer.cameras

    def view(self, index: int) -> GBuffer:
        """As read."""
        return self.gbuffer.take([index])


@dataclass(frozen=True)
class MeshSubject:
    """A mesh in world space, its longest side 1.

    Attributes:
        mesh: with its materials.
        cameras: around it.
        reference: index of the camera at azimuth 0.
        supersample: samples per pixel and axis.
    """

    mesh: SourceMesh
    cameras: Cameras
    reference: int
    supersample: int

    def view(self, index: int) -> GBuffer:
        """Rendered at `supersample` times the size."""
        size = (self.cameras.height * self.supersample, self.cameras.width * self.supersample)
        return render_gbuffer(self.mesh, self.cameras[[index]].resized(*size))


@dataclass(frozen=True)
class Viewpoint:
    """Cameras for a subject that brings none.

    Attributes:
        views: around a mesh; the last stands at azimuth 0.
        size: image rows and columns, pixels.
        supersample: samples per pixel and axis.
        fov_y_deg: vertical field of view.
        elevation_deg: of all cameras.
    """

    views: int
    size: int
    supersample: int
    fov_y_deg: float
    elevation_deg: float


def read_subject(source: Path, at: Viewpoint, notify: Callable[[str, str], None]) -> Subject:
    """Read an orbit folder, a single frame (.exr), a mesh or a scene.

    Args:
        source: file or folder.
        at: cameras for what brings none.
        notify: told (kind, message) of what was mended or assumed.

    Raises:
        ValueError: the source cannot be used.
    """
    if not source.exists():
        raise ValueError(f"wanted views or an asset, but {source} does not exist; check the path")
    if source.is_dir():
        cameras, images, reference = read_orbit(source, wanted=BUFFERS, notify=notify)
        return PictureSubject(GBuffer.of(cameras, images), reference)
    if source.suffix.lower() == FRAME_SUFFIX:
        pose = look_at_origin(at.elevation_deg, 0.0, FRAME_RADIUS)
        assumed = Cameras(pose[None], at.fov_y_deg, at.size, at.size)
        cameras, images = read_frame(source, assumed, wanted=BUFFERS, notify=notify)
        return PictureSubject(GBuffer.of(cameras, images), 0)
    if source.suffix.lower() in DISPLAY_SUFFIXES:
        raise ValueError(
            f"{source} is a picture, which has no materials to relight; make views of it first: "
            f"svim3d run {source.name}, then relight the run's folder"
        )
    mesh = normalised(read_object(source), source.name)
    cameras = orbit_cameras(
        orbit_angles(at.views, at.elevation_deg, 0.0),
        radius=fitting_radius(mesh.vertices, at.fov_y_deg, ASSET_FILL),
        fov_y_deg=at.fov_y_deg,
        size=at.size,
    )
    return MeshSubject(mesh, cameras, len(cameras) - 1, at.supersample)
