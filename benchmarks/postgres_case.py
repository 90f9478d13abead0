"""A PostgreSQL server of its own on a socket of this machine, for Prefect's records."""

import contextlib
import os
import pwd
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path

CONNECTIONS = 200
OWNERS = ("postgres", "nobody")  # where we are root, whom the server refuses
DATABASE = "prefect"


def has_postgres() -> bool:
    """Whether a server can be started here."""
    return shutil.which("initdb") is not None and shutil.which("pg_ctl") is not None


@contextlib.contextmanager
def postgres() -> Iterator[str]:
    """An empty data base; its address as SQLAlchemy wants it. Nothing of it is left."""
    owner = _owner()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if owner is not None:
            shutil.chown(folder, owner)
        cluster = folder / "cluster"
        _run(["initdb", "-D", cluster, "-U", DATABASE, "-A", "trust", "-E", "UTF8"], owner)
        options = f"-c listen_addresses='' -k {folder} -c max_connections={CONNECTIONS}"
        control = ["pg_ctl", "-D", cluster, "-w", "-l", folder / "log"]
        _run([*control, "-o", options, "start"], owner)
        try:
            _run(["createdb", "-h", folder, "-U", DATABASE, DATABASE], owner)
            yield f"postgresql+asyncpg://{DATABASE}@/{DATABASE}?host={folder}"
        finally:
            _run([*control, "-m", "immediate", "stop"], owner)


def _owner() -> str | None:
    if os.geteuid() != 0:
        return None
    known = {entry.pw_name for entry in pwd.getpwall()}
    return next(name for name in OWNERS if name in known)


def _run(command: list[str | Path], owner: str | None) -> None:
    quiet = subprocess.DEVNULL
    subprocess.run(command, check=True, user=owner, cwd="/", stdout=quiet, stdin=quiet)
