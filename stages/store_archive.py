"""Artifacts in one file: a plain tar that another store takes up, after it has looked closely.

    run.json, run.log                what a run says of itself
    obj/<key>/manifest.json, ...     artifacts, as they lie in the store

The tar is not compressed (EXR, PNG and weights are) and holds regular files only, so that its size
bounds what comes out of it. Nothing of a foreign tar is believed: names are checked against the
layout above before anything is written, sizes are counted while they are, and every file is hashed
before the first artifact is published.
"""

import contextlib
import io
import re
import shutil
import tarfile
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from stages.errors import InputError, TransientError
from stages.locks import file_lock
from stages.manifest import MANIFEST_NAME, Manifest
from stages.store import FILES_FOLDER, Store
from stages.store_cleaning import LEASE

INCOMING = "incoming"
RUN_PAGE, RUN_LOG = "run.json", "run.log"
MAX_FILES = 100_000  # a run has some hundreds
MAX_MIB = 64 * 1024  # of all files together; a run of the largest settings writes a few thousand
MAX_PAGE_MIB = 16  # of a text that is read whole
KEY = re.compile(r"[0-9a-f]{64}")
# A letter, digit or underscore first: no hidden files, no `..`, nothing that reads as an option.
NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9._ +=,@-]{0,199}")
BLOCK = 2**20
# What reading a file that is no tar, that was cut, or whose names contradict each other may raise.
NO_TAR = (
    tarfile.TarError,
    EOFError,
    RecursionError,
    FileNotFoundError,
    FileExistsError,
    IsADirectoryError,
    NotADirectoryError,
)


@dataclass(frozen=True)
class Imported:
    """What an archive brought.

    Attributes:
        pages: the run's own texts, by name.
        new: keys that were published.
        kept: keys that the store had already.
    """

    pages: dict[str, bytes]
    new: tuple[str, ...]
    kept: tuple[str, ...]


def export_artifacts(
    store: Store, keys: Iterable[str], pages: Mapping[str, bytes], archive: Path
) -> list[str]:
    """Write artifacts and a run's texts into a new tar; returns the keys that the store lacks.

    The same content gives the same bytes: owners and times are left out.

    Raises:
        InputError: an artifact is damaged, or the file cannot be written.
        TransientError: the store is being cleaned.
    """
    missing = []
    partial = archive.with_name(f".{archive.name}.partial")
    with _leased(store):
        try:
            with tarfile.open(partial, "w") as tar:
                for name, page in pages.items():
                    tar.addfile(_entry(name, len(page)), io.BytesIO(page))
                for key in keys:
                    health = store.check(key)
                    if health.damage:
                        raise InputError(
                            f"artifact {key[:8]} is damaged ({health.damage}); "
                            "run again or use svim3d store verify --repair, then export"
                        )
                    if health.stored is None:
                        missing.append(key)
                        continue
                    for name in [MANIFEST_NAME, *health.stored.manifest.files]:
                        file = store.artifact(key) / name
                        with file.open("rb") as stream:
                            tar.addfile(_entry(f"obj/{key}/{name}", file.stat().st_size), stream)
            partial.replace(archive)
        except OSError as error:
            raise InputError(f"{archive} cannot be written: {error}") from error
        finally:
            partial.unlink(missing_ok=True)
    return missing


@contextlib.contextmanager
def _leased(store: Store) -> Iterator[None]:
    """Keep artifacts from being cleaned away."""
    with file_lock(store.root / LEASE, shared=True) as is_held:
        if not is_held:
            raise TransientError(f"the store {store.root} is being cleaned; try again in a moment")
        yield


def _entry(name: str, size: int) -> tarfile.TarInfo:
    entry = tarfile.TarInfo(name)
    entry.size = size
    return entry


def import_artifacts(
    store: Store, archive: Path, *, check_page: Callable[[bytes], object]
) -> Imported:
    """Publish what a tar of `export_artifacts` holds; all of it is checked before any is.

    Args:
        store: where to; artifacts that it has stay.
        archive: from anywhere.
        check_page: raises ValueError for a run page that makes no sense.

    Raises:
        InputError: the file is no such tar, names or types are not allowed, it is too large, or an
            artifact is not what its manifest says.
        TransientError: the store is being cleaned, or its disk is full.
    """
    incoming = store.root / INCOMING
    try:
        incoming.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"the store {store.root} cannot be written ({error.strerror}); "
            "mend its permissions or choose another --store"
        ) from error
    with _leased(store), tempfile.TemporaryDirectory(dir=incoming) as name:
        staging = Path(name)
        try:
            found, pages = _unpack(archive, staging, shutil.disk_usage(staging).free)
        except InputError:
            raise
        except (*NO_TAR, ValueError) as error:
            raise InputError(
                f"{archive} cannot be read as a tar of svim3d store export: {error}"
            ) from error
        for key, files in found.items():
            _require_sound(archive, key, staging / key, files)
        _require_page(archive, pages, check_page)
        published = {key: store.adopt(key, staging / key) for key in found}
    return Imported(
        pages,
        new=tuple(key for key, is_new in published.items() if is_new),
        kept=tuple(key for key, is_new in published.items() if not is_new),
    )


def _unpack(
    archive: Path, staging: Path, free: int
) -> tuple[dict[str, set[str]], dict[str, bytes]]:
    """Write the files of each key below `staging`; gives their names, and the run's texts."""
    found: dict[str, set[str]] = {}
    pages: dict[str, bytes] = {}
    names: set[str] = set()
    size = 0
    for entry, stream in _entries(archive):
        size += entry.size
        if len(names) >= MAX_FILES or size > MAX_MIB * 2**20:
            raise InputError(
                f"{archive} holds more than {MAX_FILES} files or {MAX_MIB} MiB; no run does"
            )
        if size > free:
            raise TransientError(
                f"{archive} does not fit: {free >> 20} MiB are free where the store lies"
            )
        if entry.name in names:
            raise InputError(f"{archive} holds {entry.name!r} twice")
        names.add(entry.name)
        if entry.name in (RUN_PAGE, RUN_LOG):
            pages[entry.name] = _read_page(archive, entry, stream)
            continue
        key, inside = _place(archive, entry.name)
        target = staging / key / inside
        target.parent.mkdir(parents=True, exist_ok=True)
        with target.open("xb") as file:
            shutil.copyfileobj(stream, file, BLOCK)
        if target.stat().st_size != entry.size:
            raise InputError(f"{archive} ends in the middle of {entry.name}; copy it again")
        found.setdefault(key, set()).add(inside)
    return found, pages


def _entries(archive: Path) -> Iterator[tuple[tarfile.TarInfo, IO[bytes]]]:
    """Regular files of a tar with their content."""
    with tarfile.open(archive, "r:") as tar:
        for entry in tar:
            is_plain = entry.isreg() and not entry.issparse() and entry.size >= 0
            stream = tar.extractfile(entry) if is_plain else None
            if stream is None:
                raise InputError(
                    f"{archive}: {entry.name!r} is no plain file; links, folders, devices and "
                    "sparse files are not taken"
                )
            yield entry, stream
        # The reader takes a tar that was cut between two files for a whole one.
        with archive.open("rb") as whole:
            whole.seek(tar.offset)
            if whole.read(tarfile.BLOCKSIZE) != bytes(tarfile.BLOCKSIZE):
                raise tarfile.ReadError("its end is missing; copy it again")


def _place(archive: Path, name: str) -> tuple[str, str]:
    """Key and path inside the artifact that a tar's name stands for."""
    top, *parts = name.split("/")
    is_ours = top == "obj" and len(parts) >= 2 and KEY.fullmatch(parts[0]) is not None
    if is_ours and all(NAME.fullmatch(part) for part in parts[1:]):
        inside = "/".join(parts[1:])
        if inside in (MANIFEST_NAME, "scalars.csv") or parts[1] == FILES_FOLDER:
            return parts[0], inside
    raise InputError(f"{archive}: {name!r} is no name that svim3d store export writes")


def _read_page(archive: Path, entry: tarfile.TarInfo, stream: IO[bytes]) -> bytes:
    if entry.size > MAX_PAGE_MIB * 2**20:
        raise InputError(f"{archive}: {entry.name} has more than {MAX_PAGE_MIB} MiB")
    return stream.read()


def _require_sound(archive: Path, key: str, folder: Path, files: set[str]) -> None:
    """Refuse an artifact whose files are not those of its manifest, or whose name is not its own.

    Raises:
        InputError: naming the artifact.
    """
    page = folder / MANIFEST_NAME
    if not page.is_file() or page.stat().st_size > MAX_PAGE_MIB * 2**20:
        raise InputError(f"{archive}: artifact {key[:8]} has no {MANIFEST_NAME}, or a huge one")
    try:
        manifest = Manifest.read(folder)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{archive}: artifact {key[:8]}: {error}") from error
    if manifest.recipe.key != key:
        raise InputError(f"{archive}: artifact {key[:8]} is that of another key")
    if strange := files ^ {MANIFEST_NAME, *manifest.files}:
        raise InputError(
            f"{archive}: artifact {key[:8]}: {min(strange)!r} is not both in the tar and in its "
            "manifest"
        )
    if damage := manifest.damage(folder, hashes=True):
        raise InputError(f"{archive}: artifact {key[:8]}: {damage}")


def _require_page(
    archive: Path, pages: Mapping[str, bytes], check_page: Callable[[bytes], object]
) -> None:
    try:
        if RUN_PAGE in pages:
            check_page(pages[RUN_PAGE])
    except (ValueError, RecursionError) as error:
        raise InputError(f"{archive}: {RUN_PAGE} is none: {error}") from error
