"""Fewer or smaller views of an orbit folder, for cases in which that is what is measured."""

import json
import shutil
import tempfile
from pathlib import Path

import torch
from torch import Tensor

from stages.artifacts import MaterialViews
from stages.errors import InputError
from stages.keys import code_digests, digest_input, digest_json
from svim3d.cameras import Cameras
from svim3d.io.orbit import INDEX, read_orbit, write_orbit
from svim3d.numerics import normalize

MIN_COVERAGE = 1e-3  # below it a pixel holds no colour that could be divided out
FEWEST_VIEWS = 3


def shrunken(views: MaterialViews, size: int) -> tuple[Cameras, dict[str, Tensor]]:
    """Area means of at most `size` pixels, straight but for radiance.

    Views that fit keep every bit.
    """
    images = {name: value for name, value in vars(views).items() if isinstance(value, Tensor)}
    if max(views.cameras.height, views.cameras.width) <= size:
        return views.cameras, images
    cameras, planes = views.premultiplied(size)
    covered = planes["mask"] > MIN_COVERAGE
    mask = planes["mask"] * covered
    straight = {
        name: plane * covered / planes["mask"].clamp_min(MIN_COVERAGE)
        for name, plane in planes.items()
    }
    return cameras, straight | {
        "mask": mask,
        "radiance": planes["radiance"] * covered,
        "normal_world": normalize(straight["normal_world"]),
    }


def spread_views(count: int, reference: int, wanted: int) -> list[int]:
    """Indices of `wanted` views of an orbit, evenly spread; the last is the reference."""
    order = [(reference + 1 + i) % count for i in range(count)]
    return [order[(i + 1) * count // wanted - 1] for i in range(wanted)]


def given_views(orbit: Path, parent: Path, *, views: int | None, size: int | None) -> Path:
    """The folder of an orbit's training views, fewer or smaller; made if it is not there.

    It is named after all that it depends on. Depth, which no generator knows, is left out.

    Args:
        orbit: an orbit folder of either layout.
        parent: where folders are kept.
        views: how many are taken; None takes all.
        size: longest side that they are averaged down to, pixels; None leaves them as they are.

    Raises:
        InputError: the orbit cannot be used, or has fewer views.
    """
    if views is None and size is None:
        return orbit
    recipe = {"views": views, "size": size, "orbit": digest_input(orbit)}
    key = digest_json(recipe | {"code": code_digests(__name__)})
    folder = parent / f"{orbit.name}-{key[:16]}"
    if folder.exists():
        return folder
    try:
        cameras, images, reference = read_orbit(orbit)
    except ValueError as error:
        raise InputError(str(error)) from error
    images.pop("depth", None)
    if views is not None:
        if not FEWEST_VIEWS <= views <= len(cameras):
            raise InputError(
                f"wanted {FEWEST_VIEWS} to {len(cameras)} views of {orbit}, got {views}"
            )
        chosen = torch.tensor(spread_views(len(cameras), reference, views))
        images = {name: image[chosen] for name, image in images.items()}
        cameras = Cameras(cameras.c2w[chosen], cameras.fov_y_deg, cameras.height, cameras.width)
        reference = views - 1
    if size is not None:
        cameras, images = shrunken(
            MaterialViews(cameras=cameras, reference=reference, **images), size
        )
    parent.mkdir(parents=True, exist_ok=True)
    work = Path(tempfile.mkdtemp(dir=parent, prefix=".tmp-"))
    try:
        write_orbit(work, cameras, images, reference=reference)
        if not folder.exists():  # another process may have been quicker
            work.replace(folder)
    finally:
        shutil.rmtree(work, ignore_errors=True)
    return folder


def photo_of(orbit: Path) -> tuple[Path, tuple[str, ...]]:
    """The picture of an orbit's reference view, and settings that tell where it was taken from.

    Raises:
        InputError: there is none.
    """
    index = json.loads((orbit / INDEX).read_text())
    try:
        file = orbit / index["reference"]["file"]
        elevation_deg = float(index["train"][index["reference"]["train_index"]]["elevation_deg"])
    except (KeyError, TypeError, IndexError) as error:
        raise InputError(
            f"wanted reference.file and reference.train_index in {orbit / INDEX}, got "
            f"{index.get('reference')}; leave out --photos"
        ) from error
    if not file.is_file():
        raise InputError(f"wanted the photo of {orbit}, but {file} does not exist")
    return file, (f"generation.elevation_deg={elevation_deg}",)
