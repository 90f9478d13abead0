"""What kind of fault an exception is, and what follows from it.

input     never tried again: the same input and settings fail the same way
memory    tried again with smaller chunks, which are no part of an artifact's key
files     tried again after growing pauses: a mount that is away may come back
busy      likewise: another process holds what is wanted
space     not tried again: somebody has to make room first
time      not tried again: the same attempt would take as long; it goes on from its checkpoint
defect    not tried again: nobody knows what would be different
"""

import errno
from enum import StrEnum

import torch

from stages.errors import FullError, InputError, StageTimeoutError, TransientError
from stages.store import FULL_DISK


class Fault(StrEnum):
    """Kinds of faults; the values are what people read."""

    INPUT = "bad input"
    MEMORY = "out of memory"
    FILES = "input/output fault"
    BUSY = "something was in the way"
    SPACE = "no space left"
    TIME = "out of time"
    DEFECT = "defect"

    @property
    def is_passing(self) -> bool:
        """Whether another try may succeed without anybody doing anything."""
        return self in (Fault.MEMORY, Fault.FILES, Fault.BUSY)


# What a file system says when it is away for a while, as against a path that is wrong.
AWAY = frozenset(
    {
        *(errno.EIO, errno.EAGAIN, errno.EBUSY, errno.EINTR, errno.ESTALE, errno.EREMOTEIO),
        *(errno.ETIMEDOUT, errno.ENETDOWN, errno.ENETUNREACH, errno.ENETRESET),
        *(errno.EHOSTDOWN, errno.EHOSTUNREACH, errno.ENOTCONN, errno.EPIPE),
        *(errno.ECONNABORTED, errno.ECONNREFUSED, errno.ECONNRESET),
    }
)
# Allocators that raise a plain RuntimeError, by the words of their messages: torch on the CPU,
# CUDA's driver, cuBLAS and cuDNN.
MEMORY_WORDS = (
    "can't allocate memory",
    "cannot allocate memory",
    "out of memory",
    "ALLOC_FAILED",
)


def kind_of(error: BaseException) -> Fault:
    """The kind of an exception; what is in doubt is a defect."""
    if isinstance(error, InputError):
        return Fault.INPUT
    if isinstance(error, StageTimeoutError):
        return Fault.TIME
    if isinstance(error, FullError):
        return Fault.SPACE
    if isinstance(error, MemoryError | torch.OutOfMemoryError):
        return Fault.MEMORY
    if isinstance(error, TransientError):
        return Fault.BUSY
    if isinstance(error, OSError):
        return _kind_of_system_error(error)
    if isinstance(error, RuntimeError) and any(word in str(error) for word in MEMORY_WORDS):
        return Fault.MEMORY
    return Fault.DEFECT


def _kind_of_system_error(error: OSError) -> Fault:
    if error.errno == errno.ENOMEM:
        return Fault.MEMORY
    if error.errno in FULL_DISK or error.errno == errno.EROFS:
        return Fault.SPACE
    # Clients of remote stores raise these two without a number.
    is_away = error.errno in AWAY or isinstance(error, TimeoutError | ConnectionError)
    return Fault.FILES if is_away else Fault.DEFECT
