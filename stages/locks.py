"""Locks that the kernel keeps: they go with their process, however that ends."""

import contextlib
import fcntl
from collections.abc import Iterator
from pathlib import Path


@contextlib.contextmanager
def file_lock(file: Path, *, shared: bool = False, wait: bool = False) -> Iterator[bool]:
    """Hold the lock of `file` for the length of a `with` block; gives whether it is held.

    The file is made if it is not there, and stays: whoever removed it would leave two holders, one
    of the old file and one of the new.

    Args:
        file: what the lock is on.
        shared: be one of many holders instead of the only one.
        wait: until it can be had; otherwise the answer comes at once.
    """
    file.parent.mkdir(parents=True, exist_ok=True)
    how = (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | (0 if wait else fcntl.LOCK_NB)
    with file.open("a+") as stream:
        try:
            fcntl.flock(stream.fileno(), how)
        except BlockingIOError:
            is_held = False
        else:
            is_held = True
        yield is_held


def is_locked(file: Path) -> bool:
    """Whether some process holds the lock of `file`; looking writes nothing."""
    try:
        with file.open() as stream:
            fcntl.flock(stream.fileno(), fcntl.LOCK_SH | fcntl.LOCK_NB)
    except FileNotFoundError:
        return False
    except BlockingIOError:
        return True
    return False
