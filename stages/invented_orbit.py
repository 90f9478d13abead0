"""An invented object as an orbit folder with its truth: what measures where there are no scans.

Views, test views under three lights, those lights and the mesh, in the layout of the path-traced
orbits. Pictures are our rasteriser's, without shadows and multiple scattering, as the figures of
`svim3d.render.asset_figures` assume.
"""

import json
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from stages.keys import code_digests, digest_json
from svim3d.cameras import Cameras, fitting_radius, orbit_angles, orbit_cameras
from svim3d.color import srgb_from_linear
from svim3d.io.exr import write_rgb
from svim3d.io.image import write_png
from svim3d.io.orbit import INDEX, write_orbit
from svim3d.io.orbit_sheet import orbit_sheet
from svim3d.io.triangles import write_triangles
from svim3d.numerics import normalize
from svim3d.shading.environment import latlong_from_octahedral
from svim3d.shading.octahedral import texel_directions
from svim3d.shading.prefilter import EnvironmentPyramid, PyramidOperator
from svim3d.shading.split_sum import shade
from svim3d.shading.studio import studio_radiance
from svim3d.synthesis.dice import Dice
from svim3d.synthesis.lights import random_light
from svim3d.synthesis.objects import SyntheticObject, random_object
from svim3d.synthesis.scenes import Scene, scene_of
from svim3d.synthesis.views import ViewSamples, sample_views

VIEWS, TEST_VIEWS = 21, 6
FOV_DEG, FILL = 33.8, 0.85
ELEVATION_DEG, SWING_DEG = 10.0, 20.0
LIGHT_SIZE, LIGHT_HEIGHT = 128, 128
SUPERSAMPLE = 3
SEED = 11  # of the invented objects; their lights have the next
PHOTO = "reference.png"

Thing = Callable[[], SyntheticObject]


def invented_orbit(
    number: int, parent: Path, size: int, *, name: str | None = None, thing: Thing | None = None
) -> Path:
    """The folder of an invented scene, made if it is not there; named after all it depends on.

    Args:
        number: of the object and its lights.
        parent: where folders are kept.
        size: side of the views, pixels.
        name: of the scene; None is `random-NUMBER`.
        thing: makes the object; None invents one.
    """
    code = code_digests(__name__)
    name = name or f"random-{number}"
    folder = parent / f"{name}-{digest_json({'size': size, 'code': code})[:16]}"
    if folder.exists():
        return folder
    made = random_object(Dice.of(SEED, number)) if thing is None else thing()
    parent.mkdir(parents=True, exist_ok=True)
    work = Path(tempfile.mkdtemp(dir=parent, prefix=".tmp-"))
    try:
        _render(scene_of(made, 0.0), work, size, Dice.of(SEED + 1, number))
        work.replace(folder)
    finally:
        shutil.rmtree(work, ignore_errors=True)
    return folder


def _render(scene: Scene, folder: Path, size: int, dice: Dice) -> None:
    """Write everything that the figures are taken from."""
    vertices = scene.geometry.vertices
    radius = fitting_radius(vertices, FOV_DEG, FILL)
    train = orbit_cameras(
        orbit_angles(VIEWS, ELEVATION_DEG, SWING_DEG), radius=radius, fov_y_deg=FOV_DEG, size=size
    )
    between = [(5.0 + 20.0 * (i % 2), 30.0 + 360.0 / TEST_VIEWS * i) for i in range(TEST_VIEWS)]
    test = orbit_cameras(between, radius=radius, fov_y_deg=FOV_DEG, size=size)
    lights = {
        "A": studio_radiance(texel_directions(LIGHT_SIZE)),
        "B": random_light(dice, LIGHT_SIZE),
        "C": random_light(dice, LIGHT_SIZE),
    }
    operator = PyramidOperator.build(LIGHT_SIZE)
    train_samples, test_samples = (
        sample_views(scene.geometry, scene.materials, cameras, supersample=SUPERSAMPLE)
        for cameras in (train, test)
    )
    given = _images(train_samples, operator(lights["A"]))
    index = _write_split(folder, "train", train, given)
    write_png(folder / "views.png", orbit_sheet(train, given))
    index["train"] = index.pop("frames")
    index["reference"] = _write_photo(folder, given, index["reference"])
    index["environments"], listed = {}, []
    for name, light in lights.items():
        images = _images(test_samples, operator(light))
        listed.append(_write_split(folder, f"test_{name}", test, images)["frames"])
        latlong = latlong_from_octahedral(light, height=LIGHT_HEIGHT)
        write_rgb(folder / f"env_{name}.exr", latlong.numpy(), half=False)
        index["environments"][name] = {"file": f"env_{name}.exr"}
    index["test"] = [
        {"files": dict(zip(lights, (frame["file"] for frame in frames), strict=True)), **frames[0]}
        for frames in zip(*listed, strict=True)
    ]
    (folder / INDEX).write_text(json.dumps(index, indent=1))
    write_triangles(folder / "mesh.ply", vertices, scene.geometry.faces)


def _images(samples: ViewSamples, pyramid: EnvironmentPyramid) -> dict[str, Tensor]:
    """Images of an orbit folder: radiance premultiplied, all else straight."""
    mask = samples.mask
    radiance = shade(
        samples.normal,
        samples.wo,
        samples.basecolor,
        samples.roughness,
        samples.metallic,
        pyramid,
        multiple_scattering=False,
    ).radiance
    straight = {
        name: samples.image(getattr(samples, name)) / mask.clamp_min(1e-6)
        for name in ("basecolor", "roughness", "metallic")
    }
    normal = normalize(samples.image(samples.normal)) * (mask > 0)
    return {"radiance": samples.image(radiance), "mask": mask, "normal_world": normal, **straight}


def _write_photo(folder: Path, images: dict[str, Tensor], view: int) -> dict[str, object]:
    """The picture of a view, with opacity; what the index says of it."""
    mask = images["mask"][view]
    straight = images["radiance"][view] / mask.clamp_min(1e-6)
    encoded = srgb_from_linear(straight.clamp(0.0, 1.0)) * (mask > 0)
    write_png(folder / PHOTO, torch.cat([encoded, mask], -1))
    return {"file": PHOTO, "train_index": view}


def _write_split(
    folder: Path, split: str, cameras: Cameras, images: dict[str, Tensor]
) -> dict[str, Any]:
    """One split as a folder of its own; its index, with files named from the parent."""
    write_orbit(folder / split, cameras, images, reference=len(cameras) - 1)
    index: dict[str, Any] = json.loads((folder / split / INDEX).read_text())
    (folder / split / INDEX).unlink()
    for frame in index["frames"]:
        frame["file"] = f"{split}/{frame['file']}"
    return index
