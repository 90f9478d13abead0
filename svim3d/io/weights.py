"""The safetensors door: named tensors in one file, no pickle."""

from collections.abc import Mapping
from pathlib import Path

from safetensors import safe_open
from safetensors.torch import load_file, save_file
from torch import Tensor


def save_tensors(
    file: Path, tensors: Mapping[str, Tensor], metadata: Mapping[str, str] | None = None
) -> None:
    """Write named tensors; views and CUDA tensors are copied to contiguous CPU memory.

    Args:
        file: overwritten if it is there.
        tensors: by name.
        metadata: texts that the file's header carries.
    """
    contiguous = {name: t.detach().cpu().contiguous() for name, t in tensors.items()}
    save_file(contiguous, file, dict(metadata) if metadata else None)


def load_tensors(file: Path) -> dict[str, Tensor]:
    """Read all tensors of a file onto the CPU."""
    tensors: dict[str, Tensor] = load_file(file)
    return tensors


def load_metadata(file: Path) -> dict[str, str]:
    """The texts in a file's header; empty where there are none."""
    with safe_open(file, framework="pt") as opened:
        return dict(opened.metadata() or {})
