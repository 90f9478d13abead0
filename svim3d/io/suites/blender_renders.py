"""Renders of synthetic objects, Blender-style: Poly Haven assets and BlenderVault.

    OBJECT/transforms_train.json, transforms_test.json
    OBJECT/train/r_0.png               RGBA; its first frame is the photo
    OBJECT/train/r_0_albedo.png        and _normal, and _orm or _roughness and _metallic
    OBJECT/test/r_0.png ...            the same
    OBJECT/test/r_0_NAME.png           relit by
    OBJECT/lights/NAME.exr             lat-long, as Blender's world shows it, z up
    OBJECT/mesh.obj                    (.ply, .glb) in the cameras' world

Each picture may be .exr instead. Normals are those of the world, z up, as 0.5 n + 0.5 in PNG.
"""

from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from svim3d.io.suites.blender_frames import (
    Frame,
    OurFrame,
    picture_file,
    read_frames,
    required,
)
from svim3d.io.suites.capture import Mesh, Picture, object_truth
from svim3d.io.suites.truth_folder import SEEN, ObjectTruth
from svim3d.io.triangles import read_triangles

TRAIN, TEST, LIGHTS = "transforms_train.json", "transforms_test.json", "lights"
LOOKED_FOR = f"OBJECT/{TRAIN}"
MESHES = ("mesh.obj", "mesh.ply", "mesh.glb", "meshes/model.obj")
LIGHT_SUFFIXES = (".exr", ".hdr")
# Of each image, file endings in the order of preference, and the channel that holds it.
MAPS = {
    "basecolor": (("albedo", None), ("basecolor", None)),
    "roughness": (("roughness", 0), ("orm", 1)),
    "metallic": (("metallic", 0), ("orm", 2)),
    "normal_world": (("normal", None),),
}
# Blender's equirectangular world: +x in the middle, -y to its right; ours: -z and +x.
OURS_FROM_BLENDER = ((0.0, -1.0, 0.0), (0.0, 0.0, 1.0), (-1.0, 0.0, 0.0))


def list_objects(folder: Path) -> list[str]:
    """Names of the objects."""
    return sorted(file.parent.name for file in folder.glob(f"*/{TRAIN}"))


def source_files(folder: Path, name: str) -> list[Path]:
    """All files of an object."""
    return sorted(file for file in (folder / name).rglob("*") if file.is_file())


def read_object(folder: Path, name: str, size: int) -> ObjectTruth:
    """Read an object; raises `ValueError` where files are missing."""
    home = folder / name
    given = [_picture(frame) for frame in read_frames(home / TRAIN)]
    tests: dict[str, list[Picture]] = {}
    if (home / TEST).is_file():
        frames = read_frames(home / TEST)
        tests[SEEN] = [_picture(frame) for frame in frames]
        for light in lights_of(home):
            tests[light.stem] = [_relit(frame, light) for frame in frames]
    return object_truth(given, dict(tests), mesh_of(home), size, turn_light)


def lights_of(home: Path) -> list[Path]:
    """Lights of relit test views."""
    listed = sorted((home / LIGHTS).glob("*")) if (home / LIGHTS).is_dir() else []
    return [file for file in listed if file.suffix.lower() in LIGHT_SUFFIXES]


def mesh_of(home: Path) -> Mesh | None:
    """The true surface, where there is one."""
    found = next((home / name for name in MESHES if (home / name).is_file()), None)
    return None if found is None else read_triangles(found)


def turn_light(ours: OurFrame, frame: Frame) -> Float[Tensor, "3 3"]:
    """From our world's directions to those that our convention looks up in Blender's picture."""
    return torch.tensor(OURS_FROM_BLENDER, dtype=torch.float64) @ ours.turn.T


def _picture(frame: Frame) -> Picture:
    return Picture(frame, required(frame.image), maps=_maps(frame.image))


def _relit(frame: Frame, light: Path) -> Picture:
    stem = frame.image.with_name(f"{frame.image.name}_{light.stem}")
    return Picture(frame, required(stem), maps=_maps(frame.image), light=light)


def _maps(stem: Path) -> tuple[tuple[str, Path, int | None], ...]:
    """Maps beside a picture."""
    found = []
    for name, choices in MAPS.items():
        for ending, channel in choices:
            file = picture_file(stem.with_name(f"{stem.name}_{ending}"))
            if file is not None:
                found.append((name, file, channel))
                break
    return tuple(found)
