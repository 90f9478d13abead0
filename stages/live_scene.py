"""What a run has so far, as plain arrays that a 3D viewer takes: its cameras, its surfaces."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from numpy.typing import NDArray

from stages.artifacts import FittedField, MaterialViews, RefinedSurface
from svim3d.io.thumbnail import BACKGROUND
from svim3d.shading.tonemap import agx

PICTURE_PX = 128  # longest side of a camera's picture
LEAST_COVERAGE = 1e-4  # guards the division that turns premultiplied into straight


@dataclass(frozen=True)
class PlacedPicture:
    """A view where it was taken from.

    Attributes:
        view: its number.
        rotation: from the camera's axes (x right, y down, z ahead) to the world's.
        position: of the camera.
        fov_y_rad: vertical field of view.
        picture: display-encoded, 8 bit.
    """

    view: int
    rotation: Float[NDArray[np.float32], "3 3"]
    position: Float[NDArray[np.float32], "3"]
    fov_y_rad: float
    picture: UInt8[NDArray[np.uint8], "H W 3"]


@dataclass(frozen=True)
class PlainMesh:
    """Triangles.

    Attributes:
        vertices: world positions.
        faces: counter-clockwise seen from outside.
    """

    vertices: Float[NDArray[np.float32], "N 3"]
    faces: Int[NDArray[np.int64], "F 3"]


def placed_pictures(payload: Path) -> Iterator[PlacedPicture]:
    """Views of an artifact of the generation stage."""
    views = MaterialViews.load(payload)
    step = -(-max(views.cameras.height, views.cameras.width) // PICTURE_PX)
    straight = agx(views.radiance / views.mask.clamp_min(LEAST_COVERAGE))
    shown = BACKGROUND + views.mask * (straight.clamp(0.0, 1.0) - BACKGROUND)
    pixels = (shown[:, ::step, ::step] * 255.0).round().to(torch.uint8).numpy()
    # Ours look along -z with y up.
    flipped = views.cameras.c2w[:, :3, :3] * torch.tensor([1.0, -1.0, -1.0])
    for view, position in enumerate(views.cameras.positions.numpy()):
        yield PlacedPicture(
            view,
            flipped[view].numpy(),
            position,
            float(np.radians(views.cameras.fov_y_deg)),
            pixels[view],
        )


def mesh_of_field(payload: Path) -> PlainMesh:
    """The surface that phase 1 found."""
    return _plain(FittedField.load(payload).own_surface())


def mesh_of_surface(payload: Path) -> PlainMesh:
    """The surface that phase 2 refined."""
    return _plain(RefinedSurface.load(payload))


def _plain(surface: RefinedSurface) -> PlainMesh:
    return PlainMesh(surface.vertices.numpy(), surface.faces.long().numpy())
