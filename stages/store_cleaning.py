"""Take out of a store what no run needs any more, without ever taking what one does.

Whatever goes is first renamed into `trash/`, then deleted there. A kill in between leaves complete
artifacts in `obj/` and a trash that the next cleaning empties. Runs name the keys they need while
they hold the store's lease in common; cleaning decides while it alone holds it, so that no run can
come to need a key between the decision and the renaming. A key that some process computes or
replaces at this moment is locked, and stays.
"""

import contextlib
import os
import shutil
import stat
import time
from collections.abc import Callable, Iterator, Set
from dataclasses import dataclass
from pathlib import Path

from stages.errors import TransientError
from stages.locks import file_lock, is_locked
from stages.store import Store

LEASE = "lease"  # held in common by who names or copies artifacts, alone by who removes them
TRASH = "trash"
# No file takes a day to write: older ones were left by a process that was killed.
TEMPORARY_S = 24 * 3600.0


@dataclass(frozen=True)
class Removal:
    """Something that goes, or would go.

    Attributes:
        kind: what it is: "artifact", "unfinished stage", "quarantined artifact" or "leftover".
        path: where it lies.
        size: bytes of all its files.
    """

    kind: str
    path: Path
    size: int


def collect_garbage(
    store: Store, needed: Callable[[], Set[str]], *, older_than_s: float, dry_run: bool = False
) -> list[Removal]:
    """Remove artifacts and half-done work that are old and that nobody needs; tells what went.

    Args:
        store: to be cleaned.
        needed: the keys that must stay; asked when no run can name another one.
        older_than_s: what was published, written to or quarantined less long ago stays. What a
            killed process left of a file is removed after a day.
        dry_run: tell what would go, and write nothing at all.

    Raises:
        TransientError: another process cleans or copies this store.
    """
    if not store.root.is_dir():
        return []
    if dry_run:
        return [r for r, lock in _candidates(store, needed(), older_than_s) if not _held(lock)]
    with file_lock(store.root / LEASE) as is_ours:
        if not is_ours:
            raise TransientError(
                f"the store {store.root} is being cleaned, copied or taken up by a starting run; "
                "try again in a moment"
            )
        removed = []
        # Listed as a whole first: what is thrown away now is no leftover of an earlier cleaning.
        for removal, lock in list(_candidates(store, needed(), older_than_s)):
            with file_lock(lock) if lock else contextlib.nullcontext(True) as is_free:
                if is_free and _throw_away(store, removal.path):
                    removed.append(removal)
    # Deleting takes long and needs no lease: nothing in the trash can be asked for.
    shutil.rmtree(store.root / TRASH, ignore_errors=True)
    return removed


def _candidates(
    store: Store, needed: Set[str], older_than_s: float
) -> Iterator[tuple[Removal, Path | None]]:
    """What may go, each with the lock that must be free for it."""
    root, now = store.root, time.time()
    for entry in _entries(root / "obj"):
        if entry.name not in needed and now - _changed_s(entry) > older_than_s:
            yield _removal("artifact", entry), root / "lock" / entry.name
    for entry in _entries(root / "work"):
        # Work beside a published artifact was left by a kill, or by a recomputation that failed.
        is_needed = entry.name in needed and not (root / "obj" / entry.name).exists()
        if not is_needed and now - _latest_s(entry) > older_than_s:
            yield _removal("unfinished stage", entry), root / "lock" / entry.name
    for entry in _entries(root / "bad"):
        if now - _quarantined_s(entry) > older_than_s:
            yield _removal("quarantined artifact", entry), None
    for entry in _entries(root / TRASH):
        yield _removal("leftover", entry), None
    for entry in _temporaries(root):
        if now - _latest_s(entry) > TEMPORARY_S:
            yield _removal("leftover", entry), None


def _held(lock: Path | None) -> bool:
    return lock is not None and is_locked(lock)


def _throw_away(store: Store, path: Path) -> bool:
    """Make something invisible in one step; it is deleted later."""
    trash = store.root / TRASH
    if path.parent == trash:
        return True
    trash.mkdir(exist_ok=True)
    try:
        path.rename(trash / f"{path.name}.{time.time_ns()}")
    except FileNotFoundError:  # its process has just removed it
        return False
    return True


def _entries(folder: Path) -> list[Path]:
    return sorted(folder.iterdir()) if folder.is_dir() else []


def _temporaries(root: Path) -> Iterator[Path]:
    """What writers leave when they are killed: files under shared/ and runs/, halves of imports."""
    yield from (root / "shared").rglob("*.tmp")
    yield from (root / "runs").glob(".*")
    yield from _entries(root / "incoming")


def _removal(kind: str, path: Path) -> Removal:
    return Removal(kind, path, sum(status.st_size for status in _statuses(path)))


def _statuses(path: Path) -> Iterator[os.stat_result]:
    """Of a file, or of all files below a folder, as far as they are still there."""
    for file in path.rglob("*") if path.is_dir() else [path]:
        with contextlib.suppress(FileNotFoundError):
            status = file.lstat()
            if not stat.S_ISDIR(status.st_mode):
                yield status


def _changed_s(path: Path) -> float:
    """When a file or a folder's list of files was last changed; now if it has just gone."""
    try:
        return path.lstat().st_mtime
    except FileNotFoundError:
        return time.time()


def _latest_s(path: Path) -> float:
    """When anything below `path` was last changed."""
    return max([_changed_s(path), *(status.st_mtime for status in _statuses(path))])


def _quarantined_s(path: Path) -> float:
    """When an artifact was set aside: its name ends with the nanosecond."""
    _, _, nanoseconds = path.name.rpartition(".")
    return int(nanoseconds) / 1e9 if nanoseconds.isdecimal() else _changed_s(path)
