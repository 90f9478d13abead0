"""One computation at a time on a GPU, whoever asks: runs, batches, workers of one machine."""

import contextlib
import fcntl
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path

import torch


@contextlib.contextmanager
def device_slot(device: torch.device, folder: Path | None = None) -> Iterator[None]:
    """Hold a GPU for the length of the block; on the CPU there is nothing to hold.

    The slot is a lock of the kernel's and goes with its process, however that ends. It is taken
    after the store's lock on a key and let go before it, so that no two processes can wait for
    each other.

    Args:
        device: where the block computes.
        folder: of the lock files, on the machine's own disk; that for temporary files by default.
    """
    if device.type != "cuda":
        yield
        return
    # Indices count only the devices that a process may see; the identity is the hardware's own.
    identity = torch.cuda.get_device_properties(device).uuid
    name = f"svim3d-{os.getuid()}-{identity}.lock"
    with ((folder or Path(tempfile.gettempdir())) / name).open("a") as stream:
        fcntl.flock(stream, fcntl.LOCK_EX)
        try:
            yield
        finally:
            torch.cuda.empty_cache()  # what this process only keeps for later, the next one needs
