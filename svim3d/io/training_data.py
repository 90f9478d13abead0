"""Training examples as files: one safetensors file per object."""

import os
from dataclasses import fields
from pathlib import Path

from svim3d.io.weights import load_metadata, load_tensors, save_tensors
from svim3d.synthesis.example import TrainingExample


def example_file(folder: Path, index: int) -> Path:
    """Where example `index` of a data set lies."""
    return folder / f"{index:06d}.safetensors"


def write_example(path: Path, example: TrainingExample) -> None:
    """Write an example in one step: a reader never sees half a file."""
    # Named after the process, so that two that make the same example do not share it.
    temporary = path.with_suffix(f".{os.getpid()}.tmp")
    try:
        save_tensors(temporary, example.tensors(), example.metadata)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def read_example(path: Path) -> TrainingExample:
    """Read an example.

    Raises:
        ValueError: the file holds something else.
    """
    tensors = load_tensors(path)
    names = {f.name for f in fields(TrainingExample)} - {"metadata"}
    if set(tensors) != names:
        raise ValueError(
            f"wanted a training example with {sorted(names)}, but {path} holds {sorted(tensors)}; "
            "make some with svim3d data render"
        )
    return TrainingExample(**tensors, metadata=load_metadata(path))


def read_example_metadata(path: Path) -> dict[str, str]:
    """What an example is, without its pictures."""
    return load_metadata(path)


def is_whole(path: Path) -> bool:
    """Whether a file is there and as long as its header says."""
    try:
        return "seed" in load_metadata(path)
    except Exception:  # of any kind the library has for a damaged file
        return False
