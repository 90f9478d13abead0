"""Stanford-ORB as it is downloaded.

    blender_HDR/CAPTURE/transforms_train.json, transforms_test.json, transforms_novel.json
    blender_HDR/CAPTURE/train/0000.exr, test/0000.exr      (blender_LDR: .png)
    blender_HDR/CAPTURE/train_mask/0000.png, test_mask/0000.png
    ground_truth/CAPTURE/env_map/0000.exr                  one for each test view
    ground_truth/CAPTURE/mesh_blender/mesh.obj             in the cameras' world, z up
    ground_truth/CAPTURE/pseudo_gt_albedo/0000.png         sRGB; named as the test view, as are
    ground_truth/CAPTURE/surface_normal/0000.npy           camera axes: x right, y up, z to it
    ground_truth/CAPTURE/z_depth/0000.npy                  along the view, in the world's units

`transforms_novel.json` lists test views of the same object's other captures (`scene_name`), in
this capture's world. Environment maps are those of the view's camera: the middle is what it looks
at, right is right. Maps are as large as the pictures. The first training view is the photo;
nothing but its pose, its mask and the scan's bounding box tells where the object stands.
"""

from dataclasses import replace
from pathlib import Path

from jaxtyping import Float
from torch import Tensor

from svim3d.io.suites.blender_frames import Frame, OurFrame, read_frames, required
from svim3d.io.suites.capture import Picture, object_truth
from svim3d.io.suites.truth_folder import SEEN, ObjectTruth
from svim3d.io.triangles import read_triangles

HDR, LDR, TRUE = "blender_HDR", "blender_LDR", "ground_truth"
TRAIN, TEST, NOVEL = "transforms_train.json", "transforms_test.json", "transforms_novel.json"
MESH = "mesh_blender/mesh.obj"
LOOKED_FOR = f"{HDR} (or {LDR})/CAPTURE/{TRAIN}"
# Image, folder, file ending, and the channel that holds it.
MAPS = (
    ("basecolor", "pseudo_gt_albedo", ".png", None),
    ("normal_camera", "surface_normal", ".npy", None),
    ("depth", "z_depth", ".npy", 0),
)
RELIT_NAME = "novel"  # of the other captures' lights, in our layout


def list_objects(folder: Path) -> list[str]:
    """Names of the captures."""
    return sorted(file.parent.name for file in _pictures(folder).glob(f"*/{TRAIN}"))


def _pictures(folder: Path) -> Path:
    return folder / (HDR if (folder / HDR).is_dir() else LDR)


def source_files(folder: Path, name: str) -> list[Path]:
    """Files of a capture, and indices of what its relit views are read from."""
    homes = (_pictures(folder) / name, folder / TRUE / name)
    return sorted(file for home in homes for file in home.rglob("*") if file.is_file())


def read_object(folder: Path, name: str, size: int) -> ObjectTruth:
    """Read a capture; raises `ValueError` where files are missing."""
    home = _pictures(folder) / name
    given = [_picture(home, frame) for frame in read_frames(home / TRAIN)]
    true = folder / TRUE / name
    tests = {
        SEEN: [
            replace(_picture(home, frame), maps=_maps(true, frame))
            for frame in read_frames(home / TEST)
        ]
    }
    if (home / NOVEL).is_file():
        tests[RELIT_NAME] = [_novel(folder, frame) for frame in read_frames(home / NOVEL)]
    mesh = true / MESH
    surface = read_triangles(mesh) if mesh.is_file() else None
    return object_truth(given, dict(tests), surface, size, turn_light)


def turn_light(ours: OurFrame, frame: Frame) -> Float[Tensor, "3 3"]:
    """From our world's directions to those of the view's camera."""
    return (ours.turn @ frame.pose[:3, :3]).T


def _picture(home: Path, frame: Frame, light: Path | None = None) -> Picture:
    """A picture of a capture, by the last two parts of its path."""
    split, stem = frame.image.parent.name, frame.image.name
    mask = required(home / f"{split}_mask" / stem)
    return Picture(frame, required(home / split / stem), mask=mask, light=light)


def _maps(true: Path, frame: Frame) -> tuple[tuple[str, Path, int | None], ...]:
    """Maps of a test view that are there; the script's loader wants albedo as PNG, the rest NPY."""
    stem = frame.image.name
    files = [(name, true / f"{folder}/{stem}{kind}", c) for name, folder, kind, c in MAPS]
    return tuple((name, file, channel) for name, file, channel in files if file.is_file())


def _novel(folder: Path, frame: Frame) -> Picture:
    """A test view of another capture, with the light there."""
    if not frame.scene:
        raise ValueError(f"wanted scene_name for {frame.image.name} in {NOVEL}")
    light = required(folder / TRUE / frame.scene / "env_map" / frame.image.name)
    return _picture(_pictures(folder) / frame.scene, frame, light)
