"""The truth of one object of any suite, and the folder that it is written to."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
import trimesh
from jaxtyping import Float, Int
from torch import Tensor

from svim3d.cameras import Cameras
from svim3d.color import srgb_from_linear
from svim3d.io.exr import write_exr, write_rgb
from svim3d.io.image import write_png
from svim3d.io.orbit import CHANNELS, INDEX, OPTIONAL_CHANNELS

MIN_COVERAGE = 1e-3  # below it a straight colour is undefined
SEEN = "A"  # the light of the photo
MESH, PHOTO = "mesh.ply", "reference.png"


@dataclass(frozen=True)
class LitPictures:
    """Views under one light.

    Attributes:
        cameras: V poses.
        images: those of an orbit that are known, `radiance` and `mask` among them.
        lights: lat-long, one for all views, or one each; none where nobody knows them.
    """

    cameras: Cameras
    images: Mapping[str, Float[Tensor, "_ _ _ _"]]
    lights: tuple[Float[Tensor, "_ _ 3"], ...] = ()


@dataclass(frozen=True)
class SourceFrame:
    """Where a capture's own world lies in ours, for figures that are told in its units.

    Attributes:
        unit: how many of its units our unit of length is.
        origin: of its world, in ours.
    """

    unit: float
    origin: tuple[float, float, float]


@dataclass(frozen=True)
class ObjectTruth:
    """One object in our frame: y up, its longest side 1, the photo's camera at azimuth 0.

    Attributes:
        given: training views, the photo's the last one.
        tests: by light; `A` is the photo's.
        photo: radiance (premultiplied) and coverage that the photo is made of.
        exposure: that makes the photo of the radiance.
        surface: vertices and faces; None if nobody scanned it.
        source: the frame that all this came from.
    """

    given: LitPictures
    tests: Mapping[str, LitPictures]
    photo: tuple[Float[Tensor, "H W 3"], Float[Tensor, "H W 1"]]
    exposure: float
    surface: tuple[Float[Tensor, "N 3"], Int[Tensor, "F 3"]] | None
    source: SourceFrame


def write_truth(truth: ObjectTruth, folder: Path) -> None:
    """Write `orbit.json`, pictures, lights, mesh and photo into an empty folder."""
    cameras = {f"test_{name}": views.cameras for name, views in truth.tests.items()}
    index: dict[str, Any] = {
        "camera": _camera(truth.given.cameras),
        "cameras": {name: _camera(c) for name, c in cameras.items()},
        "train": _write_views(folder, "train", truth.given),
        "test": [],
        "environments": {},
        "reference": {
            "file": PHOTO,
            "train_index": len(truth.given.cameras) - 1,
            "exposure": truth.exposure,
        },
        "capture": asdict(truth.source),
    }
    by_pose: dict[str, dict[str, Any]] = {}
    for light, views in truth.tests.items():
        frames = _write_views(folder, f"test_{light}", views)
        names = [f"light_{light}_{number:03d}.exr" for number in range(len(views.lights))]
        for name, radiance in zip(names, views.lights, strict=True):
            write_rgb(folder / name, radiance.numpy(), half=False)
        if len(names) == 1:
            index["environments"][light] = {"file": names[0]}
        for number, frame in enumerate(frames):
            # Views that differ by their light alone are one frame.
            entry = by_pose.setdefault(
                json.dumps(frame["c2w"]), {"c2w": frame["c2w"], "files": {}, "lights": {}}
            )
            entry["files"][light] = frame["file"]
            if len(names) > 1:
                entry["lights"][light] = names[number]
    index["test"] = list(by_pose.values())
    _write_photo(truth, folder / PHOTO)
    if truth.surface is not None:
        vertices, faces = (part.numpy() for part in truth.surface)
        trimesh.Trimesh(vertices, faces, process=False).export(folder / MESH)
    (folder / INDEX).write_text(json.dumps(index, indent=1))


def _camera(cameras: Cameras) -> dict[str, int | float]:
    return {"width": cameras.width, "height": cameras.height, "fov_deg": cameras.fov_y_deg}


def _write_views(folder: Path, split: str, views: LitPictures) -> list[dict[str, Any]]:
    """One EXR per view, of the images that are known."""
    (folder / split).mkdir()
    frames = []
    for view in range(len(views.cameras)):
        planes = {
            channel: views.images[name][view, ..., i].numpy()
            for name, channels in (CHANNELS | OPTIONAL_CHANNELS).items()
            if name in views.images
            for i, channel in enumerate(channels)
        }
        file = f"{split}/{view:03d}.exr"
        write_exr(folder / file, planes)
        frames.append({"file": file, "c2w": views.cameras.c2w[view].tolist()})
    return frames


def _write_photo(truth: ObjectTruth, file: Path) -> None:
    radiance, mask = truth.photo
    straight = truth.exposure * radiance / mask.clamp_min(MIN_COVERAGE)
    encoded = srgb_from_linear(straight.clamp(0.0, 1.0)) * (mask > 0)
    write_png(file, torch.cat([encoded, mask.clamp(0.0, 1.0)], -1))
