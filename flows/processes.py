"""Which process does a run, told apart from any later one that was given its number."""

import contextlib
import os
import socket
from dataclasses import dataclass
from pathlib import Path
from typing import Self

PROC = Path("/proc")
START_FIELD = 19  # of /proc/PID/stat, counted after the name: when it started, in ticks since boot
ENDED = ("Z", "X")  # a zombie has a number, but does nothing any more


@dataclass(frozen=True)
class Process:
    """A process of some machine.

    Attributes:
        pid: its number.
        host: name of the machine.
        boot: of the machine: its random name; empty where the system tells none.
        namespace: in which the number counts; containers have their own.
        started: in ticks since the boot; empty where the system tells none.
    """

    pid: int
    host: str
    boot: str
    namespace: str
    started: str

    @classmethod
    def this(cls) -> Self:
        """The one that asks."""
        pid = os.getpid()
        return cls(pid, socket.gethostname(), _boot(), _namespace(), _started(pid) or "")

    def is_alive(self) -> bool | None:
        """Whether it still runs; None where that cannot be seen from here."""
        if self.boot != _boot():
            # The same machine has been started anew, or it is another one.
            return False if self.host == socket.gethostname() else None
        if self.namespace != _namespace():
            return None
        if not self.started:
            return _has_number(self.pid)
        return _started(self.pid) == self.started


def _boot() -> str:
    with contextlib.suppress(OSError):
        return (PROC / "sys/kernel/random/boot_id").read_text().strip()
    return ""


def _namespace() -> str:
    with contextlib.suppress(OSError):
        return str((PROC / "self/ns/pid").readlink())
    return ""


def _started(pid: int) -> str | None:
    """When a process started; None if there is none, or only its remains."""
    try:
        text = (PROC / str(pid) / "stat").read_text()
    except OSError:
        return None
    fields = text.rpartition(")")[2].split()  # the name before may hold anything
    return None if fields[0] in ENDED else fields[START_FIELD]


def _has_number(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True
