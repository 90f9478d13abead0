"""The safetensors door: named tensors in one file, no pickle."""

from collections.abc import Mapping
from pathlib import Path

from safetensors.torch import load_file, save_file
from torch import Tensor


def save_tensors(file: Path, tensors: Mapping[str, Tensor]) -> None:
    """Write named tensors; views and CUDA tensors are copied to contiguous CPU memory."""
    save_file({name: t.detach().cpu().contiguous() for name, t in tensors.items()}, file)


def load_tensors(file: Path) -> dict[str, Tensor]:
    """Read all tensors of a file onto the CPU."""
    tensors: dict[str, Tensor] = load_file(file)
    return tensors
