"""From frames with pictures, maps and lights to the truth of an object."""

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
from svim3d.io.suites.truth_folder import LitPictures, ObjectTruth
from svim3d.shading.environment import direction_from_latlong, sample_latlong

LIGHT_ROWS = 128  # of converted lights, twice as many columns
PHOTO_PX = 512  # most rows of the photo

Mesh = tuple[Float[Tensor, "N 3"], Int[Tensor, "F 3"]]


@dataclass(frozen=True)
class Picture:
    """The files of one view.

    Attributes:
        frame: its camera.
        image: radiance.
        mask: coverage, where the image has no opacity.
        maps: basecolor, roughness, metallic and normal_world that are there, each with the channel
            of the picture that holds it, or None for all three.
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
    pictures = [read_radiance(p.image, p.mask) for p in ordered]
    if mesh is None:
        box = silhouette_box([p.frame for p in ordered], [mask for _, mask in pictures])
        ours = OurFrame.of(given[0].frame.pose, *box)
    else:
        ours = OurFrame.of(given[0].frame.pose, mesh[0].amin(0), mesh[0].amax(0))
        ours = ours.scaled_to(mesh[0])
    views = _views(ordered, pictures, ours, size)
    is_hdr = given[0].image.suffix.lower() == ".exr"
    return ObjectTruth(
        given=views,
        tests={
            name: _views(t, [read_radiance(p.image, p.mask) for p in t], ours, size, turn_light)
            for name, t in tests.items()
            if t
        },
        photo=(shrunk(photo[0], PHOTO_PX), shrunk(photo[1], PHOTO_PX)),
        exposure=exposure_of(views.images, len(given) - 1, is_hdr=is_hdr),
        surface=None if mesh is None else (ours.points(mesh[0]), mesh[1]),
    )


def _views(
    pictures: Sequence[Picture],
    radiances: Sequence[tuple[Tensor, Tensor]],
    ours: OurFrame,
    size: int,
    turn_light: LightTurn | None = None,
) -> LitPictures:
    """Images of some views, each seen with the first one's field of view."""
    fields_of_view = [p.frame.fov_x for p in pictures]
    wanted = torch.tensor(fields_of_view[0])
    factors = [float((0.5 * wanted).tan() / torch.tensor(0.5 * f).tan()) for f in fields_of_view]

    def fitted(image: Tensor, view: int) -> Tensor:
        return zoomed(shrunk(image, size), factors[view])

    images: dict[str, list[Tensor]] = {"radiance": [], "mask": []}
    for view, (radiance, mask) in enumerate(radiances):
        images["radiance"].append(fitted(radiance, view))
        images["mask"].append(fitted(mask, view))
    shared = set.intersection(*({name for name, _, _ in p.maps} for p in pictures))
    for name in sorted(shared):
        images[name] = [
            fitted(_map(picture, name, mask, ours), view)
            for view, (picture, (_, mask)) in enumerate(zip(pictures, radiances, strict=True))
        ]
    shapes = {image.shape[:2] for image in images["radiance"]}
    if len(shapes) != 1:
        raise ValueError(f"wanted pictures of one size, got {sorted(tuple(s) for s in shapes)}")
    height, width = shapes.pop()
    cameras = ours.cameras([p.frame for p in pictures], height, width)
    # Straight values mean something where the object is.
    cover = (torch.stack(images["mask"]) > 0).float()
    stacked = {n: torch.stack(i) * (1.0 if n == "mask" else cover) for n, i in images.items()}
    return LitPictures(cameras, stacked, _lights(pictures, ours, turn_light))


def _map(picture: Picture, name: str, mask: Tensor, ours: OurFrame) -> Tensor:
    """One map, straight; normals in our world."""
    file, channel = next((f, c) for n, f, c in picture.maps if n == name)
    values = read_map(file, is_colour=name == "basecolor")
    if values.shape[:2] != mask.shape[:2]:
        raise ValueError(f"wanted {file} as large as the picture it belongs to")
    if name != "normal_world":
        return values if channel is None else values[..., channel : channel + 1]
    is_encoded = file.suffix.lower() != ".exr"
    return ours.directions((2.0 * values - 1.0 if is_encoded else values) * (mask > 0))


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
