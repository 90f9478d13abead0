"""The truth of one object of a benchmark: a folder in the layout of benchmark orbits, read.

Every part but the test views or the mesh may be missing: real captures have no materials, scans no
lights. `svim3d.io.suites` brings other benchmarks' folders into this layout.
"""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from svim3d.cameras import Cameras
from svim3d.io.exr import read_exr, read_rgb
from svim3d.io.orbit import CHANNELS, INDEX, read_orbit
from svim3d.io.triangles import read_triangles
from svim3d.render.asset_figures import LitViews, Surface
from svim3d.shading.environment import physical_radiance

SEEN = "A"  # the environment of the given views
MESH = "mesh.ply"


@dataclass(frozen=True)
class Truth:
    """What is known of an object.

    Attributes:
        surface: vertices and faces; None if nobody scanned it.
        given: cameras, images and the index of the photo's view.
        novel: test views under the light of the given ones, None where there are none.
        relit: by the name of an unseen light, views under it, each group with its light.
        exposure: that makes the photo of the radiance.
        unit: how many units of the capture's own world our unit of length is; 1 for our orbits.
        origin: of that world, in ours.
    """

    surface: Surface | None
    given: tuple[Cameras, dict[str, torch.Tensor], int] | None
    novel: tuple[Cameras, dict[str, torch.Tensor]] | None
    relit: dict[str, list[LitViews]]
    exposure: float
    unit: float = 1.0
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)


def read_truth(folder: Path) -> Truth:
    """Read a folder of the truth.

    Raises:
        ValueError: it lacks an index, or what the index names.
    """
    index = _read_index(folder)
    given = None
    if frames := index.get("train") or index.get("frames"):
        given = read_orbit(folder, wanted=_channels(folder / frames[0]["file"]))
    tests = index.get("test", [])
    lights = sorted({name for frame in tests for name in frame.get("files", {})})
    views = {name: _test_views(folder, index, name) for name in lights}
    reference = index.get("reference")  # an index of a view, or what is known of the photo
    photo = reference if isinstance(reference, dict) else {}
    return Truth(
        surface=read_triangles(folder / MESH) if (folder / MESH).is_file() else None,
        given=given,
        novel=views.get(SEEN),
        relit={n: _lit(folder, index, n, *views[n]) for n in lights if n != SEEN},
        exposure=float(photo.get("exposure", 1.0)),
        **index.get("capture", {}),
    )


def lit_views(folder: Path, light: str) -> list[LitViews]:
    """Test views under one light, with their images' full set and the light itself.

    Raises:
        ValueError: there are none, or files are missing.
    """
    index = _read_index(folder)
    cameras, images, _ = read_orbit(folder, f"test_{light}")
    return _lit(folder, index, light, cameras, images)


def _read_index(folder: Path) -> dict[str, Any]:
    file = folder / INDEX
    if not file.is_file():
        raise ValueError(f"wanted the truth of an object, but {folder} holds no {INDEX}")
    index: dict[str, Any] = json.loads(file.read_text())
    return index


def _channels(file: Path) -> tuple[str, ...]:
    """Images of an orbit that a frame has."""
    planes = read_exr(file)
    return tuple(name for name, channels in CHANNELS.items() if channels[0] in planes)


def _test_views(
    folder: Path, index: dict[str, Any], light: str
) -> tuple[Cameras, dict[str, torch.Tensor]]:
    first = next(f for f in index["test"] if light in f.get("files", {}))
    wanted = _channels(folder / first["files"][light])
    cameras, images, _ = read_orbit(folder, f"test_{light}", wanted=wanted)
    return cameras, images


def _lit(
    folder: Path,
    index: dict[str, Any],
    name: str,
    cameras: Cameras,
    images: dict[str, torch.Tensor],
) -> list[LitViews]:
    """Views with their light: one for all, or one each."""
    if name in index.get("environments", {}):
        file = folder / index["environments"][name]["file"]
        return [LitViews(cameras, images, _light(file))]
    frames = [f for f in index["test"] if name in f.get("files", {})]
    missing = [f["files"][name] for f in frames if name not in f.get("lights", {})]
    if missing:
        raise ValueError(
            f"wanted environments.{name}, or lights.{name} of {missing[0]}, in {folder / INDEX}"
        )
    return [
        LitViews(
            cameras[view],
            {image: values[[view]] for image, values in images.items()},
            _light(folder / frame["lights"][name]),
        )
        for view, frame in enumerate(frames)
    ]


def _light(file: Path) -> torch.Tensor:
    if not file.is_file():
        raise ValueError(f"wanted the light of test views, but {file} does not exist")
    return physical_radiance(torch.from_numpy(read_rgb(file)))[0]
