"""Training examples as files: one safetensors file per object."""

from pathlib import Path

from svim3d.io.weights import load_metadata, load_tensors, save_tensors
from svim3d.synthesis.example import TrainingExample


def example_file(folder: Path, index: int) -> Path:
    """Where example `index` of a data set lies."""
    return folder / f"{index:06d}.safetensors"


def write_example(path: Path, example: TrainingExample) -> None:
    """Write an example in one step: a reader never sees half a file, a killed writer leaves none.

    The temporary sibling `<name>.tmp` is overwritten when the same example is written again.
    """
    temporary = path.with_suffix(".tmp")
    save_tensors(temporary, example.tensors(), example.metadata)
    temporary.replace(path)


def read_example(path: Path) -> TrainingExample:
    """Read an example.

    Raises:
        ValueError: the file holds something else.
    """
    tensors = load_tensors(path)
    try:
        return TrainingExample(**tensors, metadata=load_metadata(path))
    except TypeError as error:
        raise ValueError(
            f"{path} holds no training example but {sorted(tensors)}; make some with "
            "svim3d data render"
        ) from error
