"""From frames with pictures, maps and lights to the truth of an object."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float, Int
from torch import Tensor

from svim3d.io.light import read_light
from svim3d.io.suites.blender_frames import (
    Frame,
    OurFrame,
    exposure_of,
    read_map,
    read_radiance,
    shrunk,
    silhouette_box,
    zoomed,
)
from svim3d.io.suites.truth_folder import MIN_COVERAGE, LitPictures, ObjectTruth
from svim3d.numerics import normalize
from svim3d.shading.environment import direction_from_latlong, sample_latlong

LIGHT_ROWS = 128  # of converted lights, twice as many columns
PHOTO_PX = 512  # most rows of the photo
COVERED = 0.5
MIN_FACING = 0.5  # share of normals that face the camera; interpolated ones of a rim need not

Mesh = tuple[Float[Tensor, "N 3"], Int[Tensor, "F 3"]]


@dataclass(frozen=True)
class Picture:
    """The files of one view.

    Attributes:
        frame: its camera.
        image: radiance.
        mask: coverage, where the image has no opacity.
        maps: basecolor, roughness, metallic, normal_world (or normal_camera: x right, y up, z to
            the viewer) and depth that are there, each with the channel of the picture that holds
            it, or None for all three.
        light: lat-long, that lit it; None where nobody knows it.
    """

    frame: Frame
    image: Path
    mask: Path | None = None
    maps: tuple[tuple[str, Path, int | None], ...] = ()
    light: Path | None = None


# Rotation from our world's directions to those of a light's file, from our frame and the view.
LightTurn = Callable[[OurFrame, Frame], Float[Tensor, "3 3"]]


def object_truth(
    given: Sequence[Picture],
    tests: dict[str, Sequence[Picture]],
    mesh: Mesh | None,
    size: int,
    turn_light: LightTurn,
) -> ObjectTruth:
    """Read everything and bring it into our frame.

    Args:
        given: training views; the first one is the photo's.
        tests: test views by light.
        mesh: the true surface in the capture's world.
        size: most rows of views.
        turn_light: how lights are turned; see `LightTurn`.
    """
    photo = read_radiance(given[0].image, given[0].mask)
    # The photo's view is the last one, as in all orbits.
    ordered = [*given[1:], given[0]]
    if mesh is None:
        masks = [shrunk(read_radiance(p.image, p.mask)[1], size) for p in ordered]
        ours = OurFrame.of(given[0].frame.pose, *silhouette_box([p.frame for p in ordered], masks))
    else:
        ours = OurFrame.of(given[0].frame.pose, mesh[0].amin(0), mesh[0].amax(0))
        ours = ours.scaled_to(mesh[0])
    views = _views(ordered, ours, size)
    is_hdr = given[0].image.suffix.lower() == ".exr"
    return ObjectTruth(
        given=views,
        tests={
            name: _views(pictures, ours, size, turn_light)
            for name, pictures in tests.items()
            if pictures
        },
        photo=(shrunk(photo[0], PHOTO_PX), shrunk(photo[1], PHOTO_PX)),
        exposure=exposure_of(views.images, len(given) - 1, is_hdr=is_hdr),
        surface=None if mesh is None else (ours.points(mesh[0]), mesh[1]),
        source=ours.source(),
    )


def _views(
    pictures: Sequence[Picture],
    ours: OurFrame,
    size: int,
    turn_light: LightTurn | None = None,
) -> LitPictures:
    """Images of some views, each seen with the first one's field of view."""
    names = set.intersection(*({name for name, _, _ in p.maps} for p in pictures))
    fov_x = pictures[0].frame.fov_x
    views = [_images(picture, sorted(names), ours, size, fov_x) for picture in pictures]
    shapes = sorted({tuple(view["mask"].shape[:2]) for view in views})
    if len(shapes) != 1:
        raise ValueError(f"wanted pictures of one size, got {shapes}")
    cameras = ours.cameras([p.frame for p in pictures], *shapes[0])
    images = {name: torch.stack([view[name] for view in views]) for name in views[0]}
    return LitPictures(cameras, images, _lights(pictures, ours, turn_light))


def _images(
    picture: Picture, names: Sequence[str], ours: OurFrame, size: int, fov_x: float
) -> dict[str, Tensor]:
    """One view, read and made small before the next: captures have hundreds of large ones."""
    factor = math.tan(0.5 * fov_x) / math.tan(0.5 * picture.frame.fov_x)

    def fitted(image: Tensor) -> Tensor:
        return zoomed(shrunk(image, size), factor)

    radiance, mask = read_radiance(picture.image, picture.mask)
    cover = fitted(mask)
    images = {"radiance": fitted(radiance), "mask": cover}
    for name in names:
        # Averaged with their coverage, so that nothing of the background gets in.
        laid = fitted(_map(picture, name, mask, ours) * mask)
        straight = laid / cover.clamp_min(MIN_COVERAGE) * (cover > 0)
        is_normal = name in ("normal_world", "normal_camera")
        kept = normalize(straight) * (cover > 0) if is_normal else straight
        images["normal_world" if is_normal else name] = kept
    return images


def _map(picture: Picture, name: str, mask: Tensor, ours: OurFrame) -> Tensor:
    """One map, straight; normals in our world."""
    file, channel = next((f, c) for n, f, c in picture.maps if n == name)
    values = read_map(file, is_colour=name == "basecolor")
    if values.shape[:2] != mask.shape[:2]:
        raise ValueError(f"wanted {file} as large as the picture it belongs to")
    if channel is not None:
        values = values[..., channel : channel + 1]
    if name == "depth":  # not a number, or infinite, where there is nothing
        return ours.scale * torch.where(values.isfinite(), values, 0.0)
    if name == "normal_camera":
        turned = _facing(values, mask, file) @ picture.frame.pose[:3, :3].T.float()
        return ours.directions(turned * (mask > 0))
    if name != "normal_world":
        return values
    is_encoded = file.suffix.lower() != ".exr"
    return ours.directions((2.0 * values - 1.0 if is_encoded else values) * (mask > 0))


def _facing(
    normals: Float[Tensor, "H W 3"], mask: Float[Tensor, "H W 1"], file: Path
) -> Float[Tensor, "H W 3"]:
    """Normals of what a camera sees, which face it.

    Raises:
        ValueError: most of them look away, so that their axes are not those that we know.
    """
    toward = normals[..., 2:][mask > COVERED]
    if len(toward) and float((toward > 0.0).float().mean()) < MIN_FACING:
        raise ValueError(
            f"wanted normals with x right, y up and z to the viewer in {file}, but most of them "
            "look away; turn them, or take the maps away to leave their figure out"
        )
    return normals


def _lights(
    pictures: Sequence[Picture], ours: OurFrame, turn_light: LightTurn | None
) -> tuple[Tensor, ...]:
    """Lights in our world: one if all views share it."""
    known = [p for p in pictures if p.light is not None]
    if turn_light is None or len(known) < len(pictures):
        return ()
    shown = known[:1] if len({p.light for p in known}) == 1 else known
    return tuple(
        turned_light(picture.light, turn_light(ours, picture.frame))
        for picture in shown
        if picture.light is not None
    )


def turned_light(file: Path, to_light: Float[Tensor, "3 3"]) -> Float[Tensor, "h w 3"]:
    """A lat-long light as our world sees it.

    Args:
        file: of the light.
        to_light: from our directions to those that our lat-long convention looks up in the file.
    """
    light = read_light(file, layout="latlong").radiance
    rows, columns = torch.meshgrid(
        (torch.arange(LIGHT_ROWS) + 0.5) / LIGHT_ROWS,
        (torch.arange(2 * LIGHT_ROWS) + 0.5) / (2 * LIGHT_ROWS),
        indexing="ij",
    )
    directions = direction_from_latlong(torch.stack([columns, rows], -1))
    return sample_latlong(light, directions @ to_light.T.float())
