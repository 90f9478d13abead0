"""Google Scanned Objects with renders.

    OBJECT/meshes/model.obj            as downloaded, in metres, z up
    OBJECT/transforms_train.json       Blender-style renders of that mesh; see `blender_renders`

Scans have no materials, so that geometry and novel views are scored. `transforms.json` in the
place of `transforms_train.json` will do.
"""

from pathlib import Path

from svim3d.io.suites import blender_renders
from svim3d.io.suites.blender_frames import read_frames, required
from svim3d.io.suites.blender_renders import TRAIN, mesh_of, source_files, turn_light
from svim3d.io.suites.capture import Picture, object_truth
from svim3d.io.suites.truth_folder import SEEN, ObjectTruth

MODEL, ALL = "meshes/model.obj", "transforms.json"
LOOKED_FOR = f"OBJECT/{MODEL} and OBJECT/{TRAIN} or {ALL}"

__all__ = ["LOOKED_FOR", "list_objects", "read_object", "source_files"]


def list_objects(folder: Path) -> list[str]:
    """Names of the scans that have renders."""
    homes = [file.parents[1] for file in folder.glob(f"*/{MODEL}")]
    return sorted(h.name for h in homes if any((h / index).is_file() for index in (TRAIN, ALL)))


def read_object(folder: Path, name: str, size: int) -> ObjectTruth:
    """Read a scan and its renders; raises `ValueError` where files are missing."""
    home = folder / name
    if (home / TRAIN).is_file():
        return blender_renders.read_object(folder, name, size)
    given = [Picture(f, required(f.image)) for f in read_frames(home / ALL)]
    # Nothing says which views to keep back: all but the photo's are novel to a photo.
    return object_truth(given, {SEEN: given[1:]}, mesh_of(home), size, turn_light)
