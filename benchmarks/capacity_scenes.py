"""Scenes of the capacity benchmark: orbits with a known truth, from the simplest to the hardest.

Procedural ones are rendered here, without shadows and multiple scattering, as the figures of
`svim3d.render.asset_figures` assume; orbits of the data folder are averaged down to the size asked
for.
"""

import json
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path

import torch
import trimesh
from torch import Tensor

from benchmarks.inconsistent_orbit import corrupted_orbit
from stages.keys import code_digests, digest_file, digest_json
from svim3d import synthesis
from svim3d.cameras import Cameras, fitting_radius, orbit_angles, orbit_cameras
from svim3d.io.exr import write_rgb
from svim3d.io.image import write_png
from svim3d.io.orbit import INDEX, write_orbit
from svim3d.io.orbit_sheet import orbit_sheet
from svim3d.numerics import normalize
from svim3d.shading.environment import latlong_from_octahedral
from svim3d.shading.octahedral import texel_directions
from svim3d.shading.prefilter import PyramidOperator
from svim3d.shading.split_sum import shade
from svim3d.shading.studio import studio_radiance
from svim3d.synthesis.dice import Dice
from svim3d.synthesis.inconsistency import Strengths
from svim3d.synthesis.lights import random_light
from svim3d.synthesis.materials import SolidMaterial, patterned
from svim3d.synthesis.matter import Matter
from svim3d.synthesis.objects import SyntheticObject, random_object
from svim3d.synthesis.scenes import Scene, scene_of
from svim3d.synthesis.shapes import Shape, assemble, superquadric
from svim3d.synthesis.views import ViewSamples, sample_views

VIEWS, TEST_VIEWS = 21, 6
FOV_DEG, FILL = 33.8, 0.85
ELEVATION_DEG, SWING_DEG = 10.0, 20.0
LIGHT_SIZE, LIGHT_HEIGHT = 128, 128
SUPERSAMPLE = 3
CLAY = Matter(basecolor=(0.45, 0.12, 0.08), roughness=0.5, metallic=0.0)
SEED = 11  # of the invented objects


def _ball() -> Shape:
    """A sphere whose longest side is 1."""
    return superquadric(1.0, 1.0, 128).placed(scale=[0.5] * 3)


def _of(name: str, material: SolidMaterial, shape: Shape) -> SyntheticObject:
    """One body of one material."""
    assembly = assemble([shape])
    faces = torch.zeros(len(assembly.faces), dtype=torch.long)
    return SyntheticObject(name, assembly, faces, (material,), "good")


def _sphere() -> SyntheticObject:
    return _of("sphere", SolidMaterial(CLAY), _ball())


def _painted() -> SyntheticObject:
    return _of("patterned", patterned(Dice.of(SEED, 1000)), _ball())


SIMPLE: dict[str, Callable[[], SyntheticObject]] = {"sphere": _sphere, "patterned": _painted}


def scene_orbit(name: str, data: Path | None, parent: Path, size: int) -> tuple[Path, Path]:
    """The views of a scene, and the folder of its truth, made if they are not there.

    Args:
        name: one of `SIMPLE`, `random-K` for an invented object, or an orbit of the data folder.
        data: holds `orbits`.
        parent: where folders are kept.
        size: side of the views, pixels.
    """
    if name in SIMPLE or name.startswith("random-"):
        folder = _procedural(name, parent, size)
        return folder, folder
    if data is None:
        raise SystemExit(f"scene {name} is none of {', '.join(SIMPLE)}, random-K; give --data")
    truth = data / "orbits" / name
    views = corrupted_orbit(truth, parent, size=size, strengths=Strengths.at(0.0), seed=0)
    return views, truth


def _procedural(name: str, parent: Path, size: int) -> Path:
    """The folder of an invented scene: views, test views in three lights, lights, mesh."""
    code = {**code_digests(synthesis.__name__ + ".objects"), "here": digest_file(Path(__file__))}
    folder = parent / f"{name}-{digest_json({'size': size, 'code': code})[:16]}"
    if folder.exists():
        return folder
    thing = SIMPLE[name]() if name in SIMPLE else random_object(Dice.of(SEED, _number(name)))
    parent.mkdir(parents=True, exist_ok=True)
    work = Path(tempfile.mkdtemp(dir=parent, prefix=".tmp-"))
    try:
        _render(scene_of(thing, 0.0), work, size, Dice.of(SEED + 1, _number(name)))
        work.replace(folder)
    finally:
        shutil.rmtree(work, ignore_errors=True)
    return folder


def _number(name: str) -> int:
    return int(name.partition("-")[2] or 0)


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
    index = _write_split(folder, "train", train, _images(train_samples, operator(lights["A"])))
    index["train"] = index.pop("frames")
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
    mesh = trimesh.Trimesh(vertices.numpy(), scene.geometry.faces.numpy(), process=False)
    mesh.export(folder / "mesh.ply")


def _images(samples: ViewSamples, pyramid: object) -> dict[str, Tensor]:
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


def _write_split(folder: Path, split: str, cameras: Cameras, images: dict[str, Tensor]) -> dict:
    """One split as a folder of its own; its index, with files named from the parent."""
    write_orbit(folder / split, cameras, images, reference=len(cameras) - 1)
    if split == "train":
        write_png(folder / "views.png", orbit_sheet(cameras, images))
    index = json.loads((folder / split / INDEX).read_text())
    (folder / split / INDEX).unlink()
    for frame in index["frames"]:
        frame["file"] = f"{split}/{frame['file']}"
    return index
