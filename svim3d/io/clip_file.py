"""Stored clips as files: one safetensors file per object."""

from pathlib import Path

from torch import Tensor

from svim3d.diffusion.clips import StoredClip
from svim3d.io.weights import load_metadata, load_tensors, save_tensors

GOOD_MATERIALS = "has_good_materials"  # key of the metadata


def write_clip(path: Path, clip: StoredClip) -> None:
    """Write a clip; a reader never sees half a file."""
    tensors = {name: value for name, value in vars(clip).items() if isinstance(value, Tensor)}
    temporary = path.with_suffix(".tmp")
    save_tensors(temporary, tensors, {GOOD_MATERIALS: str(int(clip.has_good_materials))})
    temporary.replace(path)


def read_clip(path: Path) -> StoredClip:
    """Read a clip.

    Raises:
        ValueError: the file holds something else.
    """
    good = load_metadata(path).get(GOOD_MATERIALS)
    try:
        return StoredClip(**load_tensors(path), has_good_materials=good == "1")
    except TypeError as error:
        raise ValueError(f"{path} holds no clip; make it again: svim3d train") from error
