"""The Prefect engine of one run: settings, and a private server that lives and dies with it.

Prefect keeps its state behind a server. Left alone it starts one inside the first API call, for
which the client imports the server too. Here the server starts as a process of its own before
torch is imported, so that both load at the same time, and the client never imports it.
A server that the user runs (`PREFECT_API_URL`) is used as it is.
"""

import importlib.metadata
import os
import shutil
import socket
import sqlite3
import subprocess
import sys
import time
import urllib.error
import urllib.request
from contextlib import closing
from pathlib import Path
from types import TracebackType
from typing import Self

from stages.errors import InputError, TransientError

STARTUP_TIMEOUT_S = 120.0  # a new data base takes 20 s on a busy machine
STOP_TIMEOUT_S = 5.0
DATABASE = "prefect.db"

# No word leaves the machine.
SETTINGS = {"PREFECT_SERVER_ANALYTICS_ENABLED": "false", "DO_NOT_TRACK": "1"}
# With a server of the user's own everything is shown there, and the console stays ours.
SHOWN = {"PREFECT_LOGGING_HANDLERS_CONSOLE_LEVEL": "CRITICAL"}
PRIVATE = {
    # The command line speaks to the user; the engine only of its own defects.
    "PREFECT_LOGGING_LEVEL": "CRITICAL",
    # Nobody can look into a server that ends with the run: `flows.showing` sends nothing either.
    "PREFECT_LOGGING_TO_API_ENABLED": "false",
    # Blocks are not used; registering them costs 0.3 s of each start.
    "PREFECT_API_BLOCKS_REGISTER_ON_START": "false",
    # A server that is overrun answers in the end; giving up after 5 tries lost 2 of 200 runs.
    "PREFECT_CLIENT_MAX_RETRIES": "30",
}
# Marks that make Prefect run only the services which a private server needs.
SERVER_MARKS = {
    "PREFECT__SERVER_EPHEMERAL": "1",
    "PREFECT__SERVER_FINAL": "1",
    "PREFECT_UI_ENABLED": "0",
    "PREFECT_SERVER_DATABASE_TIMEOUT": "120",
    # Nobody looks at its events. Where many write, SQLite refuses some, and their runs fail.
    "PREFECT_SERVER_SERVICES_EVENT_PERSISTER_ENABLED": "false",
    "PREFECT_SERVER_SERVICES_TRIGGERS_ENABLED": "false",
}


class Engine:
    """Prefect for the length of a `with` block; `home` keeps its data base and log.

    Attributes:
        waited_s: how long the run had to wait for the server, once it is ready.
    """

    def __init__(self, home: Path) -> None:
        self._home = home.resolve()
        self._server: subprocess.Popen[bytes] | None = None
        self._url = os.environ.get("PREFECT_API_URL")
        self._is_new = False
        self.waited_s = 0.0

    def __enter__(self) -> Self:
        """Set Prefect's environment and start the server; returns before it is ready.

        Raises:
            InputError: if the home cannot be made.
        """
        os.environ.update(SETTINGS)
        if self._url is not None:
            for name, value in SHOWN.items():
                os.environ.setdefault(name, value)
            return self  # the user's home may hold the key to the user's server
        # Prefect makes its home, but not the folder above; that failure would show as a time-out.
        try:
            self._home.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(
                f"the store cannot be written: no folder {self._home} ({error.strerror}); "
                "mend its permissions or choose another --store"
            ) from error
        os.environ.update(PRIVATE | {"PREFECT_HOME": str(self._home)})
        self._is_new = not (self._home / DATABASE).exists()
        if self._is_new and _seed_file().exists():
            _copy_whole(_seed_file(), self._home / DATABASE)
            self._is_new = False
        self._start_server()
        return self

    def _start_server(self) -> None:
        # The socket listens before the server runs: no port to guess, and early calls just wait.
        with closing(socket.create_server(("127.0.0.1", 0), backlog=64)) as listening:
            self._url = f"http://127.0.0.1:{listening.getsockname()[1]}/api"
            command = [sys.executable, "-m", "flows.engine_server", str(listening.fileno())]
            with (self._home / "server.log").open("wb") as server_log:
                self._server = subprocess.Popen(
                    command,
                    stdin=subprocess.PIPE,  # its end tells the server that this process is gone
                    stdout=server_log,
                    stderr=server_log,
                    pass_fds=[listening.fileno()],
                    start_new_session=True,  # Ctrl-C must reach the run, not its record keeper
                    env=os.environ | SERVER_MARKS,
                )
        os.environ["PREFECT_API_URL"] = self._url

    def wait(self) -> None:
        """Block until the server answers; call it when there is nothing left to import.

        Raises:
            TransientError: if it died or takes too long, with where to read why.
        """
        start = time.monotonic()
        try:
            with urllib.request.urlopen(f"{self._url}/health", timeout=STARTUP_TIMEOUT_S):
                pass
        except urllib.error.HTTPError:
            pass  # it answers: one that wants a key shows its health to nobody without
        except (OSError, urllib.error.URLError) as error:
            why = (
                f"see {self._home / 'server.log'}" if self._server else "is PREFECT_API_URL right?"
            )
            raise TransientError(
                f"the Prefect server at {self._url} does not answer ({error}); {why}"
            ) from error
        self.waited_s = time.monotonic() - start
        if self._is_new:
            _keep_seed(self._home / DATABASE)

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Stop the server."""
        if self._server is None or self._server.stdin is None:
            return
        os.environ.pop("PREFECT_API_URL", None)
        self._server.stdin.close()
        try:
            self._server.wait(STOP_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            self._server.kill()
            self._server.wait()


def _seed_file() -> Path:
    """An empty, migrated data base of this Prefect: migrations take 7 s of CPU, a copy none."""
    cache = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache"))
    return cache / "svim3d" / f"prefect-{importlib.metadata.version('prefect')}.db"


def _keep_seed(database: Path) -> None:
    """Keep a data base that holds no runs yet as the start of the next new home."""
    seed = _seed_file()
    try:
        seed.parent.mkdir(parents=True, exist_ok=True)
        partial = seed.with_name(f"{seed.name}.{os.getpid()}")
        with closing(sqlite3.connect(database)) as source, closing(sqlite3.connect(partial)) as to:
            source.backup(to)
        partial.replace(seed)
    except (OSError, sqlite3.Error):
        return  # a cache that cannot be written only costs time


def _copy_whole(source: Path, target: Path) -> None:
    """Copy a file so that no other process sees half of it."""
    partial = target.with_name(f"{target.name}.{os.getpid()}")
    shutil.copyfile(source, partial)
    partial.replace(target)
