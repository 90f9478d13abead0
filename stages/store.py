"""Content-addressed store of artifacts: each recipe is computed once, and never half seen.

    obj/<key>/    files/, scalars.csv, manifest.json: published, complete, never changed
    work/<key>/   what an unfinished computation keeps: checkpoints, scalars, the new artifact
    lock/<key>    held while one process computes the key
    bad/          artifacts that were found damaged, kept for inspection
    trash/        what `stages.store_cleaning` has taken out and not deleted yet

All five lie on one file system, so that publishing is one rename. A lock is the kernel's: it goes
with its process, however that ends. It binds the processes of one machine; on a shared drive two
machines may compute the same key, and the second to publish finds the first's artifact in place.
"""

import contextlib
import errno
import fcntl
import json
import logging
import os
import shutil
import socket
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from stages.errors import FullError, InputError, TransientError
from stages.keys import Recipe
from stages.manifest import Manifest

log = logging.getLogger(__name__)

FILES_FOLDER = "files"
MIN_FREE_MIB = 256  # a standard run writes about half of it; a full disk also breaks the engine
LOCK_POLL_S = 0.2
LOCK_TIMEOUT_S = 6 * 3600.0  # longer than the longest stage; a waiter must not outlive its use
FULL_DISK = frozenset({errno.ENOSPC, errno.EDQUOT})
UNWRITABLE = frozenset({errno.EROFS, errno.EACCES, errno.EPERM, errno.ENOTDIR})

Compute = Callable[[Path, Path], Mapping[str, Any]]


@dataclass(frozen=True)
class Stored:
    """A sound artifact in the store.

    Attributes:
        folder: its payload, as `Artifact.load` wants it.
        manifest: its page.
        is_cached: whether it was there already, or another process made it meanwhile.
    """

    folder: Path
    manifest: Manifest
    is_cached: bool

    @property
    def key(self) -> str:
        """Content address."""
        return self.manifest.recipe.key


@dataclass(frozen=True)
class Health:
    """State of a key in the store.

    Attributes:
        state: "ok", "missing" or "corrupted".
        damage: what is wrong with a corrupted artifact.
        stored: the artifact, if it is sound.
    """

    state: Literal["ok", "missing", "corrupted"]
    damage: str = ""
    stored: Stored | None = None


class Store:
    """Artifacts under one root folder. Looking writes nothing, so a read-only store can be read.

    Args:
        root: folder of the store, made on first write.
        say: told what an operator should know: a wait, a repair.
    """

    def __init__(self, root: Path, *, say: Callable[[str], None] = log.warning) -> None:
        self.root = root
        self._say = say
        self._verified: set[str] = set()
        self._was_there = False

    def artifact(self, key: str) -> Path:
        """Where the published artifact of `key` lies: payload, scalars and manifest."""
        return self.root / "obj" / key

    def work(self, key: str) -> Path:
        """Private folder of an unfinished computation."""
        return self.root / "work" / key

    @property
    def shared(self) -> Path:
        """Folder for derived data that any run may use."""
        return self.root / "shared"

    def check(self, key: str) -> Health:
        """State of `key`: sizes each time, content hashes at the first use by this process."""
        folder = self.artifact(key)
        if not folder.is_dir():
            return Health("missing")
        try:
            manifest = Manifest.read(folder)
        except ValueError as error:
            return Health("corrupted", str(error))
        if manifest.recipe.key != key:
            return Health("corrupted", "the manifest belongs to another key")
        if damage := manifest.damage(folder, hashes=key not in self._verified):
            return Health("corrupted", damage)
        self._verified.add(key)
        return Health("ok", stored=Stored(folder / FILES_FOLDER, manifest, is_cached=True))

    def keys(self) -> list[str]:
        """Names of all that is published, sound or not."""
        folder = self.root / "obj"
        return sorted(entry.name for entry in folder.iterdir()) if folder.is_dir() else []

    def recent(self, limit: int) -> Iterator[Manifest]:
        """Readable manifests of the latest published artifacts, newest first."""
        folders = self.root / "obj"
        dated = []
        for entry in os.scandir(folders) if folders.is_dir() else ():
            with contextlib.suppress(FileNotFoundError):  # replaced at this moment
                dated.append((entry.stat().st_mtime_ns, entry.path))
        for _, path in sorted(dated, reverse=True)[:limit]:
            with contextlib.suppress(ValueError):
                yield Manifest.read(Path(path))

    def obtain(self, recipe: Recipe, compute: Compute, *, force: bool = False) -> Stored:
        """The artifact of `recipe`, computed if it is not there, damaged, or forced.

        Args:
            recipe: what to make.
            compute: `compute(payload_folder, work_folder)` writes the payload and returns the
                record for the manifest. What it leaves in the work folder outlives a kill.
            force: compute though it is there; the new artifact then takes the old one's place.

        Raises:
            TransientError: the disk is full, the store has gone, or another process holds the key
                for too long.
            InputError: the store cannot be written.
        """
        key = recipe.key
        if not force and not self.work(key).exists() and (found := self.check(key).stored):
            return found
        with self._explained(), self._locked(key):
            # Another process may have published while this one waited, and one that was killed
            # right after its rename leaves its checkpoints behind.
            if not force and (found := self.check(key).stored):
                shutil.rmtree(self.work(key), ignore_errors=True)
                return found
            return self._compute(recipe, compute)

    def adopt(self, key: str, artifact: Path) -> bool:
        """Publish an artifact made elsewhere; False if there is a sound one, which then stays.

        Args:
            key: its content address.
            artifact: its folder, on the store's file system and known to be sound; it is moved.

        Raises:
            TransientError: the disk is full, the store has gone, or another process holds the key
                for too long.
            InputError: the store cannot be written.
        """
        with self._explained(), self._locked(key):
            if self.check(key).stored:
                return False
            self._quarantine_if_damaged(key)
            self._publish(key, artifact)
            return True

    def quarantine(self, key: str) -> None:
        """Set a damaged artifact aside, so that the next run that wants it computes it anew.

        Raises:
            TransientError: another process holds the key for too long.
            InputError: the store cannot be written.
        """
        with self._explained(), self._locked(key):
            self._quarantine_if_damaged(key)

    def _compute(self, recipe: Recipe, compute: Compute) -> Stored:
        key, work = recipe.key, self.work(recipe.key)
        self._require_space()
        self._quarantine_if_damaged(key)
        unpublished = work / "artifact"
        shutil.rmtree(unpublished, ignore_errors=True)
        payload = unpublished / FILES_FOLDER
        payload.mkdir(parents=True)
        record = compute(payload, work)
        if (scalars := work / "scalars.csv").exists():
            scalars.replace(unpublished / scalars.name)
        manifest = Manifest.of(unpublished, recipe, record)
        manifest.write(unpublished)
        self._publish(key, unpublished)
        self._verified.add(key)
        return Stored(self.artifact(key) / FILES_FOLDER, manifest, is_cached=False)

    def _publish(self, key: str, unpublished: Path) -> None:
        """Make a finished artifact visible and durable, and drop what its making left."""
        for path in [*unpublished.rglob("*"), unpublished]:
            _sync(path)
        artifact = self.artifact(key)
        artifact.parent.mkdir(exist_ok=True)
        if artifact.exists():  # forced: a folder cannot be renamed over another that holds files
            replaced = self.work(key) / "replaced"
            shutil.rmtree(replaced, ignore_errors=True)
            artifact.rename(replaced)
        unpublished.rename(artifact)
        _sync(artifact.parent)
        shutil.rmtree(self.work(key), ignore_errors=True)

    def _quarantine_if_damaged(self, key: str) -> None:
        health = self.check(key)
        if health.state == "corrupted":
            bad = self.root / "bad" / f"{key}.{time.time_ns()}"
            bad.parent.mkdir(exist_ok=True)
            self.artifact(key).rename(bad)
            self._say(
                f"artifact {key[:8]} is damaged ({health.damage}): moved to {bad}, "
                "to be computed anew"
            )

    def _require_space(self) -> None:
        free_mib = shutil.disk_usage(self.root).free / 2**20
        if free_mib < MIN_FREE_MIB:
            raise FullError(
                f"only {free_mib:.0f} MiB are free where the store {self.root} lies, "
                f"{MIN_FREE_MIB} MiB are wanted; free some space or choose another --store"
            )

    @contextlib.contextmanager
    def _locked(self, key: str) -> Iterator[None]:
        file = self.root / "lock" / key
        if self._is_gone():  # a new one in its place would be in the way of its return
            raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), str(self.root))
        file.parent.mkdir(parents=True, exist_ok=True)
        self._was_there = True
        with file.open("a+") as stream:
            self._acquire(stream.fileno(), file, key)
            holder = {"pid": os.getpid(), "host": socket.gethostname(), "since": _clock()}
            stream.truncate(0)
            stream.write(json.dumps(holder))
            stream.flush()
            yield

    def _acquire(self, descriptor: int, file: Path, key: str) -> None:
        start = time.monotonic()
        has_told = False
        while True:
            try:
                return fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                waited_s = time.monotonic() - start
            # The holder writes its name a moment after it took the lock.
            if waited_s > LOCK_POLL_S and not has_told:
                self._say(f"waiting for {key[:8]}, which {_holder(file)} computes")
                has_told = True
            if waited_s > LOCK_TIMEOUT_S:
                raise TransientError(
                    f"{key[:8]} has been held by {_holder(file)} for {waited_s:.0f} s; "
                    "see whether that process is still alive, then run again"
                )
            time.sleep(LOCK_POLL_S)

    @contextlib.contextmanager
    def _explained(self) -> Iterator[None]:
        """Turn the file system's faults into ones that say what to do."""
        try:
            yield
        except Exception as error:
            if is_disk_full(error):
                raise FullError(
                    f"no space left where the store {self.root} lies; free some space "
                    "or choose another --store, then run again: finished work is kept"
                ) from error
            if self._is_gone():
                raise TransientError(
                    f"the store {self.root} has gone while it was in use; bring it back, then run "
                    "again: what was finished in it is kept"
                ) from error
            if isinstance(error, OSError) and self._is_forbidden(error):
                raise InputError(
                    f"the store {self.root} cannot be written ({error.strerror}); "
                    "mend its permissions or choose another --store"
                ) from error
            raise

    def _is_gone(self) -> bool:
        """Whether the store was deleted, moved or unmounted under this process."""
        return self._was_there and not (self.root / "lock").is_dir()

    def _is_forbidden(self, error: OSError) -> bool:
        is_ours = error.filename is not None and Path(error.filename).is_relative_to(self.root)
        return error.errno in UNWRITABLE and is_ours


def is_disk_full(error: BaseException) -> bool:
    """Whether a file could not be written for lack of space, whichever library tried."""
    is_system_error = isinstance(error, OSError) and error.errno in FULL_DISK
    # Writers in compiled code (safetensors, OpenEXR) raise errors of their own with this text.
    return is_system_error or os.strerror(errno.ENOSPC) in str(error)


def _holder(lock_file: Path) -> str:
    try:
        holder = json.loads(lock_file.read_text())
        return f"process {holder['pid']} on {holder['host']} (since {holder['since']})"
    except (OSError, ValueError, KeyError):
        return "another process"


def _clock() -> str:
    return time.strftime("%Y-%m-%d %H:%M:%S")


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
