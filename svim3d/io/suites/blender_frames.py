"""Blender-style captures: `transforms_*.json` and the pictures it names.

`camera_angle_x` is the horizontal field of view in radians, `transform_matrix` camera-to-world
with OpenGL's camera axes; the world has z up. Pictures are PNG (sRGB, straight opacity) or EXR
(scene-linear, premultiplied), square to a pixel.
"""

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from svim3d.cameras import Cameras
from svim3d.color import linear_from_srgb
from svim3d.io.exr import read_exr, read_rgb
from svim3d.io.image import read_png
from svim3d.io.suites.truth_folder import SourceFrame
from svim3d.numerics import normalize

Y_UP = ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, -1.0, 0.0))  # (x, y, z up) -> (x, z, -y)
SUFFIXES = (".exr", ".png")
BRIGHTEST_SHARE, EXPOSED_TO = 0.98, 0.9  # a photo of HDR pictures: this quantile becomes that
SAME_FOV = 1e-4  # relative


@dataclass(frozen=True)
class Frame:
    """One picture with its camera.

    Attributes:
        image: its file, without a suffix.
        pose: camera-to-world, z up.
        fov_x: horizontal field of view, radians.
        scene: that it was taken in, where the index says so.
    """

    image: Path
    pose: Float[Tensor, "4 4"]
    fov_x: float
    scene: str = ""


def read_frames(file: Path) -> list[Frame]:
    """Frames of an index.

    Raises:
        ValueError: it is missing, or no such index.
    """
    if not file.is_file():
        raise ValueError(f"wanted camera poses in {file}, which does not exist")
    try:
        index = json.loads(file.read_text())
        frames = [
            Frame(
                _without_suffix(file.parent / entry["file_path"]),
                torch.tensor(entry["transform_matrix"], dtype=torch.float64),
                float(entry.get("camera_angle_x", index.get("camera_angle_x"))),
                str(entry.get("scene_name", "")),
            )
            for entry in index["frames"]
        ]
    except (KeyError, TypeError, json.JSONDecodeError) as error:
        raise ValueError(
            f"wanted camera_angle_x and frames with file_path and transform_matrix in {file}: "
            f"{error!r}"
        ) from error
    if not frames:
        raise ValueError(f"wanted frames in {file}, but it lists none")
    return frames


def _without_suffix(path: Path) -> Path:
    return path.with_suffix("") if path.suffix.lower() in SUFFIXES else path


def picture_file(stem: Path) -> Path | None:
    """The file of a picture that is named without a suffix; EXR before PNG."""
    found = (stem.with_name(stem.name + suffix) for suffix in SUFFIXES)
    return next((file for file in found if file.is_file()), None)


def required(stem: Path) -> Path:
    """The same, where there has to be one.

    Raises:
        ValueError: there is none.
    """
    file = picture_file(stem)
    if file is None:
        raise ValueError(f"wanted a picture {stem}.exr or .png, found neither")
    return file


def read_radiance(
    file: Path, mask: Path | None = None
) -> tuple[Float[Tensor, "H W 3"], Float[Tensor, "H W 1"]]:
    """Scene-linear radiance, premultiplied, and coverage.

    Args:
        file: with opacity, where there is no mask.
        mask: a picture that is white where the object is.

    Raises:
        ValueError: neither tells the object from its background.
    """
    is_exr = file.suffix.lower() == ".exr"
    if is_exr:
        planes = read_exr(file)
        colour = torch.from_numpy(read_rgb(file))
        alpha = torch.from_numpy(planes["A"])[..., None] if "A" in planes else None
    else:
        picture = read_png(file)
        colour = linear_from_srgb(picture[..., :3])
        alpha = picture[..., 3:] if picture.shape[-1] == 4 else None
    if mask is not None:
        cover = read_png(mask)[..., :1]
        return colour * cover, cover
    if alpha is None:
        raise ValueError(f"wanted opacity in {file}, or a mask beside it")
    return (colour if is_exr else colour * alpha), alpha


def read_map(file: Path, *, is_colour: bool) -> Float[Tensor, "H W C"]:
    """Values of a material, normal or depth map; colours of PNG are decoded from sRGB.

    Raises:
        ValueError: it cannot be read.
    """
    if file.suffix.lower() == ".npy":
        return _read_array(file)
    if file.suffix.lower() == ".exr":
        return torch.from_numpy(read_rgb(file))
    picture = read_png(file)
    values = picture[..., :3] if picture.shape[-1] >= 3 else picture[..., :1].expand(-1, -1, 3)
    return linear_from_srgb(values) if is_colour else values


def _read_array(file: Path) -> Float[Tensor, "H W C"]:
    """An array of numpy, [H, W] or [H, W, C]."""
    try:
        values = np.load(file, allow_pickle=False)
    except (ValueError, EOFError) as error:
        raise ValueError(f"{file} cannot be read as an array: {error}") from error
    if values.ndim not in (2, 3) or not np.issubdtype(values.dtype, np.number):
        raise ValueError(f"wanted numbers by row, column and channel in {file}, got {values.shape}")
    return torch.from_numpy(values.astype(np.float32)).reshape(*values.shape[:2], -1)


def shrunk(image: Float[Tensor, "H W C"], size: int) -> Float[Tensor, "h w C"]:
    """Area means, at most `size` rows; smaller pictures stay."""
    height, width, _ = image.shape
    if height <= size:
        return image
    wanted = size, round(size * width / height)
    planes = functional.adaptive_avg_pool2d(image.movedim(-1, 0)[None], wanted)
    return planes[0].movedim(0, -1)


def zoomed(image: Float[Tensor, "H W C"], factor: float) -> Float[Tensor, "H W C"]:
    """The picture as a camera with tan(half field of view) `factor` times as large sees it."""
    if abs(factor - 1.0) < SAME_FOV:
        return image
    theta = torch.tensor([[[factor, 0.0, 0.0], [0.0, factor, 0.0]]])
    planes = image.movedim(-1, 0)[None]
    grid = functional.affine_grid(theta, list(planes.shape), align_corners=False)
    return functional.grid_sample(planes, grid, align_corners=False)[0].movedim(0, -1)


def vertical_fov_deg(fov_x: float, height: int, width: int) -> float:
    """From a horizontal field of view in radians."""
    return math.degrees(2.0 * math.atan(math.tan(0.5 * fov_x) * height / width))


@dataclass(frozen=True)
class OurFrame:
    """From a capture's world to ours: x -> scale * turn @ (x - centre).

    Attributes:
        turn: a rotation; the photo's camera stands at azimuth 0 behind it.
        centre: of the object's bounding box.
        scale: makes its longest side 1.
    """

    turn: Float[Tensor, "3 3"]
    centre: Float[Tensor, "3"]
    scale: float

    @classmethod
    def of(
        cls, photo_pose: Float[Tensor, "4 4"], low: Float[Tensor, "3"], high: Float[Tensor, "3"]
    ) -> "OurFrame":
        """The frame of an object whose bounding box in the capture's world is known.

        The longest side is taken after the turn, as ours is.
        """
        centre = 0.5 * (low + high).double()
        upright = torch.tensor(Y_UP, dtype=torch.float64)
        eye = upright @ (photo_pose[:3, 3] - centre)
        azimuth = math.atan2(float(eye[0]), float(eye[2]))
        cosine, sine = math.cos(azimuth), math.sin(azimuth)
        back = torch.tensor([[cosine, 0.0, -sine], [0.0, 1.0, 0.0], [sine, 0.0, cosine]])
        return cls(back.double() @ upright, centre, 1.0 / float((high - low).max()))

    def scaled_to(self, vertices: Float[Tensor, "N 3"]) -> "OurFrame":
        """The same turn, with the bounding box of these vertices after it."""
        turned = (vertices.double() - self.centre) @ self.turn.T
        low, high = turned.amin(0), turned.amax(0)
        return OurFrame(
            self.turn,
            self.centre + self.turn.T @ (0.5 * (low + high)),
            1.0 / float((high - low).max()),
        )

    def points(self, vertices: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        """Positions in our world."""
        return (self.scale * (vertices.double() - self.centre) @ self.turn.T).float()

    def directions(self, values: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        """Unit directions in our world; zero stays zero."""
        return normalize(values @ self.turn.T.to(values)) * (values.square().sum(-1, True) > 0)

    def source(self) -> SourceFrame:
        """Where the capture's world lies in ours."""
        x, y, z = self.points(torch.zeros(3)).tolist()
        return SourceFrame(1.0 / self.scale, (x, y, z))

    def cameras(self, frames: Sequence[Frame], height: int, width: int) -> Cameras:
        """Cameras in our world; all are given the first one's field of view."""
        poses = []
        for frame in frames:
            pose = torch.eye(4, dtype=torch.float64)
            pose[:3, :3] = self.turn @ frame.pose[:3, :3]
            pose[:3, 3] = self.scale * self.turn @ (frame.pose[:3, 3] - self.centre)
            poses.append(pose.float())
        fov = vertical_fov_deg(frames[0].fov_x, height, width)
        return Cameras(torch.stack(poses), fov, height, width)


def silhouette_box(
    frames: Iterable[Frame], masks: Iterable[Float[Tensor, "H W 1"]]
) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"]]:
    """A cube around an object of which only silhouettes are known.

    It stands where the cameras' axes come nearest to each other; its side is the longest side of
    any silhouette's box, seen at that distance.

    Raises:
        ValueError: the cameras look in parallel, or no view shows anything.
    """
    frames = list(frames)
    normal, right = torch.zeros(3, 3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64)
    for frame in frames:
        axis = frame.pose[:3, 2] / torch.linalg.vector_norm(frame.pose[:3, 2])
        across = torch.eye(3, dtype=torch.float64) - torch.outer(axis, axis)
        normal += across
        right += across @ frame.pose[:3, 3]
    if float(torch.linalg.cond(normal)) > 1e6:
        raise ValueError("wanted cameras around an object, but they look in parallel")
    centre = torch.linalg.solve(normal, right)
    longest = 0.0
    for frame, mask in zip(frames, masks, strict=True):
        covered = torch.nonzero(mask[..., 0] > 0.5)
        if len(covered):
            side = float((covered.amax(0) - covered.amin(0)).max()) + 1.0
            distance = float(torch.linalg.vector_norm(frame.pose[:3, 3] - centre))
            pixel = 2.0 * math.tan(0.5 * frame.fov_x) / mask.shape[1]
            longest = max(longest, side * pixel * distance)
    if not longest > 0.0:
        raise ValueError("wanted a silhouette of the object, but all masks are empty")
    half = 0.5 * longest
    return centre - half, centre + half


def exposure_of(images: Mapping[str, Tensor], view: int, *, is_hdr: bool) -> float:
    """Exposure of the photo that a view's radiance is made into; 1 for what was displayed."""
    if not is_hdr:
        return 1.0
    inside = images["mask"][view, ..., 0] > 0.5
    if not bool(inside.any()):
        raise ValueError("wanted an object in the photo's view, but its mask is empty")
    bright = images["radiance"][view][inside].amax(-1).quantile(BRIGHTEST_SHARE)
    return EXPOSED_TO / max(float(bright), 1e-6)
