"""The safetensors door: named tensors in one file, no pickle."""

import contextlib
import hashlib
import json
import math
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save, save_file
from torch import Tensor

Shape = tuple[int, ...]

ZIP, PICKLE = b"PK\x03\x04", b"\x80"  # first bytes of what torch.save writes, now and formerly
SEAL = "sha256"  # entry of the header's texts: digest over names, types, shapes and content
LENGTH_BYTES = 8  # a file begins with the length of its header, little endian
HEADER_ALIGNMENT = 8  # bytes; readers map the numbers behind the header as they are
TYPE_NAMES = {torch.float16: "F16", torch.bfloat16: "BF16", torch.float32: "F32"}


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
    text += b" " * (-len(text) % HEADER_ALIGNMENT)
    return len(text).to_bytes(LENGTH_BYTES, "little") + text + content[LENGTH_BYTES + length :]


def load_tensors(file: Path) -> dict[str, Tensor]:
    """All tensors of a file on the CPU, as pages of the file until they are written to.

    Raises:
        ValueError: see `open_tensors`.
    """
    with open_tensors(file) as opened:
        return {name: opened.read(name) for name in opened.shapes}


def load_state(file: Path) -> dict[str, Tensor]:
    """All tensors of a safetensors file or of what torch.save made of a state, on the CPU.

    The latter is read by an unpickler that knows tensors and plain containers and nothing else.

    Raises:
        ValueError: see `open_tensors`; or a pickled file holds something else.
    """
    try:
        return load_tensors(file)
    except ValueError:
        if not (file.is_file() and _is_pickled(file)):
            raise
    try:
        state = torch.load(file, map_location="cpu", weights_only=True)
    except Exception as error:  # of any kind, by what is wrong with the file
        raise ValueError(f"{file} holds no state of a network: {error}") from error
    if not isinstance(state, dict) or not all(isinstance(v, Tensor) for v in state.values()):
        raise ValueError(f"wanted named tensors in {file}, got another object; save a state_dict()")
    return dict(state)


def load_metadata(file: Path) -> dict[str, str]:
    """The texts in a file's header; empty where there are none.

    Raises:
        ValueError: see `open_tensors`.
    """
    with open_tensors(file) as opened:
        return opened.metadata


def save_sealed(file: Path, tensors: Mapping[str, Tensor]) -> None:
    """As `save_tensors`, with a digest by which `load_sealed` tells a file that was damaged.

    For files that no manifest vouches for.
    """
    contiguous = {name: t.detach().cpu().contiguous() for name, t in tensors.items()}
    save_file(contiguous, file, {SEAL: _digest(contiguous)})


def load_sealed(file: Path) -> dict[str, Tensor]:
    """As `load_tensors`; a file that carries no digest is taken as it is.

    Raises:
        ValueError: see `open_tensors`; or the content is not what was written.
    """
    tensors = load_tensors(file)
    sealed = load_metadata(file).get(SEAL)
    if sealed is not None and sealed != _digest(tensors):
        raise ValueError(f"{file} is damaged: its content does not match its digest")
    return tensors


def _digest(tensors: Mapping[str, Tensor]) -> str:
    """Sha256 over everything that tells these tensors from others."""
    digest = hashlib.sha256()
    for name, tensor in sorted(tensors.items()):
        digest.update(f"{name}\n{tensor.dtype}\n{tuple(tensor.shape)}\n".encode())
        digest.update(tensor.reshape(-1).view(torch.uint8).numpy().data)
    return digest.hexdigest()


class TensorFile:
    """Tensors that stay in their file until one is read; see `open_tensors`.

    Attributes:
        shapes: by name.
        types: by name, as the format calls them: F32, BF16 and so on.
        metadata: texts in the file's header.
    """

    def __init__(self, opened: Any) -> None:
        self._opened = opened
        self.metadata: dict[str, str] = dict(opened.metadata() or {})
        slices = {name: opened.get_slice(name) for name in opened.keys()}  # noqa: SIM118
        self.shapes: dict[str, Shape] = {n: tuple(s.get_shape()) for n, s in slices.items()}
        self.types: dict[str, str] = {n: str(s.get_dtype()) for n, s in slices.items()}

    def read(self, name: str) -> Tensor:
        """One tensor, as pages of the file that memory may drop again."""
        tensor: Tensor = self._opened.get_tensor(name)
        return tensor


@contextlib.contextmanager
def open_tensors(file: Path) -> Iterator[TensorFile]:
    """Look into a file that may be larger than memory.

    Raises:
        ValueError: there is no such file, or it is pickled, cut short or of another kind.
    """
    if not file.is_file():
        raise ValueError(f"there is no file {file}; check the path")
    try:
        opened = safe_open(file, framework="pt")
    except SafetensorError as error:
        if _is_pickled(file):
            raise ValueError(
                f"{file} is pickled, and unpickling can run any code: it is not opened; "
                "wanted the .safetensors file of the same weights"
            ) from error
        raise ValueError(
            f"{file} is no complete safetensors file ({error}); fetch or copy it again"
        ) from error
    except OSError as error:
        raise ValueError(f"{file} cannot be read: {error}") from error
    with opened:
        yield TensorFile(opened)


def _is_pickled(file: Path) -> bool:
    with file.open("rb") as stream:
        start = stream.read(4)
    return start == ZIP or start[:1] == PICKLE


def save_one_by_one(
    file: Path,
    shapes: Mapping[str, Shape],
    dtype: torch.dtype,
    tensors: Iterable[tuple[str, Tensor]],
) -> None:
    """Write tensors as they come, one in memory at a time.

    Args:
        file: overwritten if it is there.
        shapes: of all tensors to come.
        dtype: all are written in this one.
        tensors: names and values, in any order.

    Raises:
        ValueError: a tensor that was not announced so or holds what `dtype` cannot, or one lacking.
    """
    size = dtype.itemsize
    starts, end = {}, 0
    for name, shape in shapes.items():
        starts[name] = end
        end += math.prod(shape) * size
    header: dict[str, Any] = {
        name: {
            "dtype": TYPE_NAMES[dtype],
            "shape": list(shape),
            "data_offsets": [starts[name], starts[name] + math.prod(shape) * size],
        }
        for name, shape in shapes.items()
    }
    text = json.dumps(header, separators=(",", ":")).encode()
    text += b" " * (-len(text) % HEADER_ALIGNMENT)
    lacking = set(shapes)
    with file.open("wb") as stream:
        stream.write(len(text).to_bytes(LENGTH_BYTES, "little") + text)
        for name, tensor in tensors:
            if name not in lacking or tuple(tensor.shape) != shapes[name]:
                raise ValueError(
                    f"{name} {tuple(tensor.shape)} was not announced so, or came twice"
                )
            lacking.remove(name)
            written = _in_type(name, tensor, dtype)
            stream.seek(LENGTH_BYTES + len(text) + starts[name])
            stream.write(written.reshape(-1).view(torch.uint8).numpy().data)
    if lacking:
        raise ValueError(f"{len(lacking)} tensors never came: {', '.join(sorted(lacking)[:3])}")


def _in_type(name: str, tensor: Tensor, dtype: torch.dtype) -> Tensor:
    """A tensor of finite numbers in another type."""
    converted = tensor.detach().to("cpu", dtype).contiguous()
    if not bool(torch.isfinite(converted).all()):
        raise ValueError(
            f"{name} is not finite in {TYPE_NAMES[dtype]}; if it is in the file, choose bf16 or "
            "fp32, otherwise the file is damaged"
        )
    return converted
