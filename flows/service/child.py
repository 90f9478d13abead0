"""A run as a process of its own, which can be stopped, killed, and found again after a crash."""

import contextlib
import fcntl
import os
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Self

PROJECT = Path(__file__).resolve().parents[2]
ALIVE = "alive"
LOG = "log.txt"
LOG_COLUMNS = "1000"  # lines are not broken, so that they can be read by a program


class Child:
    """A run that this service started.

    It holds a lock in the job's folder for as long as it lives, however the service ends: the
    kernel frees it with the process.
    """

    def __init__(self, process: subprocess.Popen[bytes]) -> None:
        self._process = process

    @classmethod
    def start(cls, command: Sequence[str], folder: Path) -> Self | None:
        """Start `command` in a job's folder; its output takes the place of the job's log.

        Returns:
            None while another run of this job lives.
        """
        with (folder / ALIVE).open("a") as alive, (folder / LOG).open("ab") as log:
            try:
                fcntl.flock(alive, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                return None
            log.truncate(0)
            # Closing our descriptor leaves the lock to the child's.
            process = subprocess.Popen(
                command,
                cwd=folder,
                env=os.environ | {"PYTHONPATH": _search_path(), "COLUMNS": LOG_COLUMNS},
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                pass_fds=[alive.fileno()],
                start_new_session=True,  # Ctrl-C is for the service, which stops its runs itself
            )
        return cls(process)

    @property
    def pid(self) -> int:
        """Its number, which is that of its process group too."""
        return self._process.pid

    def exit_code(self) -> int | None:
        """How it ended, with whatever it had started gone too; None while it runs."""
        # Looked at without being reaped: until then its number belongs to no other group.
        options = os.WEXITED | os.WNOHANG | os.WNOWAIT
        if self._process.returncode is None and os.waitid(os.P_PID, self.pid, options) is None:
            return None
        if self._process.returncode is None:
            self.kill()
        return self._process.wait()

    def ask_to_stop(self) -> None:
        """Let it end as after Ctrl-C: checkpoints stay, the same command goes on from them."""
        with contextlib.suppress(ProcessLookupError):
            self._process.send_signal(signal.SIGTERM)

    def kill(self) -> None:
        """End it, and what it had started."""
        _kill_group(self.pid)


def kill_leftover(folder: Path, pid: int | None) -> None:
    """End a run that outlived the service which had started it, if it still lives."""
    file = folder / ALIVE
    if pid is None or not file.exists():
        return
    with file.open("a") as alive:
        try:
            fcntl.flock(alive, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            # It holds its lock, so the number is still its own.
            _kill_group(pid)


def run_command(
    source: Path, out: Path, *, store: Path, device: str, options: Sequence[str]
) -> list[str]:
    """The command of a run, which is also the command that resumes it."""
    return [
        sys.executable,
        "-P",  # modules are never looked for in the folder that it starts in
        "-m",
        "flows.cli",
        "run",
        str(source),
        "-o",
        str(out),
        "--store",
        str(store),
        "--device",
        device,
        *options,
    ]


def _search_path() -> str:
    """Where modules are found, with this project first: it need not be installed."""
    return os.pathsep.join([str(PROJECT), *filter(None, [os.environ.get("PYTHONPATH")])])


def _kill_group(pid: int) -> None:
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(pid, signal.SIGKILL)
