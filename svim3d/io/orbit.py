"""The orbit folder: cameras and material views on disk, the exchange format of the project.

`orbit.json` holds `camera` {width, height, fov_deg (vertical)}, the frames and the reference;
each frame names a multi-channel half-float EXR. Radiance (`R G B`) is premultiplied by the
coverage `A`; basecolor, roughness, metallic and the world normal are straight. Depth and a
confidence may be there or not. Two layouts are read: `frames` with `reference` as an index (what
`write_orbit` makes), and the layout of benchmark sets: `train`, and `test` whose frames name one
file per environment, or for some environments only. `cameras` may hold a camera by split where one
differs from the others'.
"""

import contextlib
import json
import math
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from svim3d.cameras import Cameras
from svim3d.io.exr import read_exr, write_exr
from svim3d.io.orbit_repair import Notify, repair_images

CHANNELS = {
    "radiance": ("R", "G", "B"),
    "mask": ("A",),
    "basecolor": ("basecolor.R", "basecolor.G", "basecolor.B"),
    "roughness": ("roughness.V",),
    "metallic": ("metallic.V",),
    "normal_world": ("normal.X", "normal.Y", "normal.Z"),
}
# Images that are there where all views have them: depth along the camera's -z axis, and how far the
# view is to be trusted, from 0 to 1.
OPTIONAL_CHANNELS = {"depth": ("depth.Z",), "confidence": ("confidence.V",)}
INDEX = "orbit.json"
RIGID_TOLERANCE = 1e-3  # poses written with 4 decimals pass, mirrored or scaled ones do not

Images = dict[str, Float[Tensor, "_ _ _ _"]]  # [views, rows, columns, channels]


def write_orbit(
    folder: Path, cameras: Cameras, images: Mapping[str, Tensor], *, reference: int
) -> None:
    """Write `orbit.json` and one half-float EXR per view into `folder`, made if need be.

    Args:
        folder: where to.
        cameras: V poses.
        images: the named images of `CHANNELS`, each [V, H, W, C], and those of
            `OPTIONAL_CHANNELS` that are known.
        reference: index of the view that the asset was asked for by.
    """
    folder.mkdir(parents=True, exist_ok=True)
    named = CHANNELS | {n: c for n, c in OPTIONAL_CHANNELS.items() if n in images}
    frames = []
    for view in range(len(cameras)):
        name = f"{view:03d}.exr"
        planes = {
            channel: images[image][view, ..., i].detach().cpu().numpy()
            for image, channels in named.items()
            for i, channel in enumerate(channels)
        }
        write_exr(folder / name, planes)
        frames.append({"file": name, **_angles(cameras, view), "c2w": cameras.c2w[view].tolist()})
    index = {
        "camera": {
            "width": cameras.width,
            "height": cameras.height,
            "fov_deg": cameras.fov_y_deg,
        },
        "reference": reference,
        "frames": frames,
    }
    (folder / INDEX).write_text(json.dumps(index, indent=1))


def _angles(cameras: Cameras, view: int) -> dict[str, float]:
    """Elevation and azimuth of a camera centre, for human readers."""
    x, y, z = cameras.positions[view].tolist()
    return {
        "elevation_deg": round(math.degrees(math.atan2(y, math.hypot(x, z))), 6),
        "azimuth_deg": round(math.degrees(math.atan2(x, z)), 6),
    }


def read_orbit(
    folder: Path,
    split: str = "train",
    *,
    wanted: Collection[str] = tuple(CHANNELS),
    notify: Notify | None = None,
) -> tuple[Cameras, Images, int]:
    """Read cameras, images as float32, and the reference index.

    Args:
        folder: an orbit folder of either layout.
        split: `train`, or `test_A` for the test views under environment A.
        wanted: which images of `CHANNELS` are needed; those of `OPTIONAL_CHANNELS` come with them
            if all views have them.
        notify: told (kind, message) of every value that had to be mended; see `repair_images`.

    Raises:
        ValueError: the folder cannot be used; the text says what was wanted, what came and what
            to do.
    """
    with _telling_of(folder):
        index = _read_index(folder)
        frames = _frames(folder, index, split)
        cameras = _cameras(folder, _of_split(index, split), frames)
        reference = _reference(index, len(frames), split)
    names = [frame["file"] for frame in frames]
    images = _read_views([folder / name for name in names], cameras, wanted)
    return cameras, repair_images(images, names, notify), reference


def read_frame(
    file: Path, camera: Cameras, *, wanted: Collection[str], notify: Notify | None = None
) -> tuple[Cameras, Images]:
    """Read one view by itself, as `read_orbit` reads many.

    Args:
        file: a multi-channel EXR like those of an orbit folder; where `orbit.json` beside it lists
            the file, its camera is read there.
        camera: one pose for a file that no orbit lists; the size is the file's own.
        wanted: which images of `CHANNELS` are needed.
        notify: told (kind, message) of what was mended or assumed.
    """
    with _telling_of(file.parent):
        listed = _listed_camera(file)
    if listed is None:
        planes = read_exr(file)
        height, width = next(iter(planes.values())).shape
        listed = camera.resized(height, width)
        if notify is not None:
            notify("camera_assumed", f"{file.name} is in no {INDEX}: taken to be seen as told")
    images = _read_views([file], listed, wanted)
    return listed, repair_images(images, [file.name], notify)


@contextlib.contextmanager
def _telling_of(folder: Path) -> Iterator[None]:
    """Name the index where its entries are of another kind than they should be."""
    try:
        yield
    except (KeyError, TypeError, AttributeError, IndexError) as error:
        raise ValueError(
            f"wanted an orbit's index near {folder}, cannot use it: {error!r}"
        ) from error


def _listed_camera(file: Path) -> Cameras | None:
    """Camera of a file that the `orbit.json` in its folder, or in the one above, lists."""
    for folder in (file.parent, file.parent.parent):
        if not (folder / INDEX).is_file():
            continue
        index = _read_index(folder)
        for frame in (f for key in ("frames", "train", "test") for f in index.get(key, [])):
            for name in (frame.get("file"), *frame.get("files", {}).values()):
                if name is not None and (folder / name).resolve() == file.resolve():
                    return _cameras(folder, index, [{"file": name, "c2w": frame["c2w"]}])
    return None


def _read_index(folder: Path) -> dict[str, Any]:
    """The parsed `orbit.json`."""
    file = folder / INDEX
    if not file.is_file():
        raise ValueError(
            f"wanted an orbit folder, but {folder} holds no {INDEX}; "
            "give the folder that contains it"
        )
    try:
        index = json.loads(file.read_text())
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"wanted JSON in {file}, cannot parse it: {error}") from error
    if not isinstance(index, dict):
        raise ValueError(f"wanted an object in {file}, got a {type(index).__name__}")
    return index


def _of_split(index: dict[str, Any], split: str) -> dict[str, Any]:
    """An index whose `camera` is that of a split."""
    return index | {"camera": index.get("cameras", {}).get(split, index.get("camera", {}))}


def _frames(folder: Path, index: dict[str, Any], split: str) -> list[dict[str, Any]]:
    """Frames of a split, each with its `file` and `c2w`."""
    name, _, environment = split.partition("_")
    key = "frames" if name == "train" and "frames" in index else name
    listed = index.get(key)
    if environment and listed:
        # Benchmarks may light each test view otherwise; of none it is an error below.
        listed = [f for f in listed if environment in f.get("files", {})] or listed
    if not listed:
        raise ValueError(
            f"wanted frames in {folder / INDEX}, but the list '{key}' is empty or missing; "
            "render the orbit again"
        )
    frames = []
    for number, frame in enumerate(listed):
        file = frame.get("files", {}).get(environment) if environment else frame.get("file")
        if file is None or "c2w" not in frame:
            raise ValueError(
                f"wanted a file and a c2w for frame {number} of '{split}' in {folder / INDEX}, "
                f"got only {sorted(frame)}"
            )
        if not (folder / file).is_file():
            raise ValueError(
                f"wanted frame {number} of {folder / INDEX}, but its file {file} does not exist; "
                "copy the whole folder or take the frame off the list"
            )
        frames.append({"file": file, "c2w": frame["c2w"]})
    return frames


def _cameras(folder: Path, index: dict[str, Any], frames: list[dict[str, Any]]) -> Cameras:
    """Cameras of the frames, checked to be rigid with a centred principal point."""
    camera = index.get("camera", {})
    missing = [key for key in ("width", "height", "fov_deg") if key not in camera]
    if missing:
        raise ValueError(f"wanted camera.{missing} in {folder / INDEX}, got {sorted(camera)}")
    width, height = int(camera["width"]), int(camera["height"])
    centre = (camera.get("cx", width / 2), camera.get("cy", height / 2))
    if max(abs(centre[0] - width / 2), abs(centre[1] - height / 2)) > 0.5:
        raise ValueError(
            f"wanted the principal point at the image centre ({width / 2}, {height / 2}), "
            f"got {centre} in {folder / INDEX}; crop or pad the views"
        )
    poses = []
    for frame in frames:
        pose = torch.tensor(frame["c2w"], dtype=torch.float64)
        if pose.shape != (4, 4) or not _is_rigid(pose):
            raise ValueError(
                f"wanted a rigid 4x4 camera-to-world transform for {frame['file']} in "
                f"{folder / INDEX}, got {frame['c2w']}; remove scale and mirroring from it"
            )
        poses.append(pose.float())
    return Cameras(torch.stack(poses), float(camera["fov_deg"]), height, width)


def _is_rigid(pose: Float[Tensor, "4 4"]) -> bool:
    """Whether a transform is a rotation and a translation."""
    rotation = pose[:3, :3]
    error = (rotation.T @ rotation - torch.eye(3, dtype=pose.dtype)).abs().max()
    last_row = (pose[3] - pose.new_tensor([0.0, 0.0, 0.0, 1.0])).abs().max()
    finite = bool(torch.isfinite(pose).all())
    return (
        finite
        and float(error) < RIGID_TOLERANCE
        and float(last_row) < RIGID_TOLERANCE
        and float(torch.linalg.det(rotation)) > 0
    )


def _read_views(files: list[Path], cameras: Cameras, wanted: Collection[str]) -> Images:
    """The wanted images of all views, and those optional ones that each of them has."""
    views = [_read_view(file, cameras.height, cameras.width, wanted) for file in files]
    names = [*wanted, *(n for n in OPTIONAL_CHANNELS if all(n in view for view in views))]
    return {name: torch.stack([view[name] for view in views]) for name in names}


def _read_view(
    file: Path, height: int, width: int, wanted: Collection[str]
) -> dict[str, Float[Tensor, "_ _ _"]]:
    """The wanted images of one view, and the optional ones that are there."""
    planes = read_exr(file)
    named = {name: CHANNELS[name] for name in wanted}
    needed = [channel for channels in named.values() for channel in channels]
    missing = [channel for channel in needed if channel not in planes]
    if missing:
        raise ValueError(
            f"wanted the channels {', '.join(needed)} in {file}, missing {', '.join(missing)}; "
            "export them, or render the orbit from a mesh"
        )
    named |= {name: c for name, c in OPTIONAL_CHANNELS.items() if c[0] in planes}
    shapes = {planes[channel].shape for channels in named.values() for channel in channels}
    if shapes != {(height, width)}:
        raise ValueError(
            f"wanted {width}x{height} pixels in {file} as {INDEX} says, got "
            f"{', '.join(f'{w}x{h}' for h, w in sorted(shapes))}; all views need one size"
        )
    return {
        name: torch.from_numpy(np.stack([planes[channel] for channel in channels], -1))
        for name, channels in named.items()
    }


def _reference(index: dict[str, Any], views: int, split: str) -> int:
    """Index of the reference view; the last one where nothing is said."""
    said = index.get("reference", views - 1) if split == "train" else views - 1
    reference = int(said.get("train_index", views - 1) if isinstance(said, dict) else said)
    if not 0 <= reference < views:
        raise ValueError(f"wanted a reference below the {views} views, got {reference}")
    return reference
