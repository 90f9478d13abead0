"""The safetensors door: named tensors in one file, no pickle."""

import json
from collections.abc import Mapping
from pathlib import Path

from safetensors import safe_open
from safetensors.torch import load_file, save, save_file
from torch import Tensor

LENGTH_BYTES = 8  # a file begins with the length of its header, little endian


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
    if metadata is None:
        save_file(contiguous, file)
    else:
        file.write_bytes(_with_sorted_header(save(contiguous, dict(metadata))))


def _with_sorted_header(content: bytes) -> bytes:
    """The same file with its header in order: the library shuffles metadata at every call."""
    length = int.from_bytes(content[:LENGTH_BYTES], "little")
    header = json.loads(content[LENGTH_BYTES : LENGTH_BYTES + length])
    text = json.dumps(header, sort_keys=True, separators=(",", ":")).encode()
    # Spaces keep the tensors behind it aligned.
    text += b" " * (-len(text) % LENGTH_BYTES)
    return len(text).to_bytes(LENGTH_BYTES, "little") + text + content[LENGTH_BYTES + length :]


def load_tensors(file: Path) -> dict[str, Tensor]:
    """Read all tensors of a file onto the CPU."""
    tensors: dict[str, Tensor] = load_file(file)
    return tensors


def load_metadata(file: Path) -> dict[str, str]:
    """The texts in a file's header; empty where there are none."""
    with safe_open(file, framework="pt") as opened:
        return dict(opened.metadata() or {})
