"""What callers send, checked before it is kept: pictures, and views as a .zip.

No name that a caller chose ever reaches the file system: files are kept under names of ours, and
the index of views is written anew with these.
"""

import errno
import json
import os
import shutil
import stat
import struct
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from http import HTTPStatus
from pathlib import Path, PurePosixPath
from typing import Any, BinaryIO, NoReturn

from flows.service.limits import MIB, ArchiveLimits, Limits
from flows.service.problems import Refusal, without_paths
from svim3d.io.exr import read_exr_header
from svim3d.io.photo_header import read_photo_header

INDEX = "orbit.json"
CAMERA_NUMBERS = ("width", "height", "fov_deg", "cx", "cy")
CHUNK_BYTES = 1 << 20
END_RECORD = struct.Struct("<4s4H2LH")  # a .zip's last 22 bytes. Source: APPNOTE.TXT, 4.3.16
END_MARK, ZIP64_MARK = b"PK\x05\x06", b"PK\x06\x07"
ZIP64_LOCATOR_BYTES = 20  # lies before the end record where there is one
DIRECTORY_ENTRY_BYTES = 512  # generous for 46 bytes and a name
# Below this a high ratio does no harm: a short text of blanks.
SMALL_BYTES = MIB
# What zipfile raises on damage, unknown ways of packing, encryption, and offsets that lead nowhere.
DAMAGE = (
    zipfile.BadZipFile,
    zlib.error,
    struct.error,
    NotImplementedError,
    EOFError,
    RuntimeError,
    ValueError,
    OSError,
)
WANTED_ZIP = "a .zip of an orbit folder: orbit.json and an .exr per view"


def keep_picture(stream: BinaryIO, folder: Path, limits: Limits) -> str:
    """Check a picture's head and copy it into `folder`.

    Returns:
        The name that it has there; the ending follows the content.

    Raises:
        Refusal: it is no picture, or claims too many pixels.
    """
    wanted = "a photo (PNG, JPEG, WebP, TIFF, BMP or GIF)"
    stream.seek(0)
    try:
        header = read_photo_header(stream)
    except ValueError as error:
        raise Refusal(
            HTTPStatus.UNSUPPORTED_MEDIA_TYPE,
            "no_picture",
            wanted=wanted,
            came=without_paths(str(error)),
            todo="convert it to PNG",
        ) from error
    if not 0 < header.height * header.width <= limits.photo_px:
        raise Refusal(
            HTTPStatus.REQUEST_ENTITY_TOO_LARGE,
            "too_many_pixels",
            wanted=f"{wanted} of at most {limits.photo_px} pixels",
            came=f"one that claims {header.width} x {header.height}",
            todo="scale it down",
        )
    name = f"photo{header.suffix}"
    stream.seek(0)
    with (folder / name).open("xb") as file:
        shutil.copyfileobj(stream, file, CHUNK_BYTES)
        os.fsync(file.fileno())
    return name


def keep_views(stream: BinaryIO, folder: Path, limits: ArchiveLimits) -> str:
    """Unpack what `orbit.json` names from a .zip into a folder of ours.

    Returns:
        The name of that folder in `folder`.

    Raises:
        Refusal: it is no such archive, or one that unpacks to more than it should.
    """
    stream.seek(0)
    _require_plain_end(stream, limits)
    try:
        with zipfile.ZipFile(stream) as archive:
            entries = _checked_entries(archive, limits)
            index_name = _index_name(entries)
            index = _read_index(archive, entries[index_name], limits)
            views = folder / "views"
            views.mkdir()
            _unpack_views(archive, entries, PurePosixPath(index_name).parent, index, views, limits)
    except DAMAGE as error:
        if isinstance(error, OSError) and error.errno not in (None, errno.EINVAL):
            raise  # a fault of our disk
        _refuse(f"a damaged one ({without_paths(str(error))})")
    return "views"


def _require_plain_end(stream: BinaryIO, limits: ArchiveLimits) -> None:
    """Bound the archive's directory before it is read as a whole into memory."""
    size = stream.seek(0, os.SEEK_END)
    tail_bytes = min(size, END_RECORD.size + ZIP64_LOCATOR_BYTES)
    stream.seek(size - tail_bytes)
    tail = stream.read(tail_bytes)
    if len(tail) < END_RECORD.size or tail[-END_RECORD.size :][:4] != END_MARK:
        _refuse("something else, or an archive with a comment at its end")
    _, _, _, _, count, directory_bytes, _, comment = END_RECORD.unpack(tail[-END_RECORD.size :])
    if comment or tail.startswith(ZIP64_MARK):
        _refuse("one of more than 4 GiB, or with a comment")
    if count > limits.entries or directory_bytes > limits.entries * DIRECTORY_ENTRY_BYTES:
        _refuse_size(f"{count} entries", f"at most {limits.entries} entries")
    stream.seek(0)


def _checked_entries(archive: zipfile.ZipFile, limits: ArchiveLimits) -> dict[str, zipfile.ZipInfo]:
    """The archive's files by name, none of which could lead out of a folder or be a bomb."""
    entries: dict[str, zipfile.ZipInfo] = {}
    for entry in archive.infolist():
        _require_harmless_name(entry)
        if entry.is_dir():
            continue
        if entry.filename in entries:
            _refuse("one with two entries of the same name")
        if entry.flag_bits & 0x1:
            _refuse("an encrypted one")
        if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            _refuse("one that is packed by other means than deflate")
        if entry.file_size > max(SMALL_BYTES, limits.ratio * entry.compress_size):
            _refuse_size(
                f"an entry packed {entry.file_size // max(1, entry.compress_size)} times",
                f"entries that shrink at most {limits.ratio} times",
            )
        entries[entry.filename] = entry
    if sum(entry.file_size for entry in entries.values()) > limits.unpacked_bytes:
        _refuse_size("more", f"at most {limits.unpacked_bytes // MIB} MiB unpacked")
    # Entries that share their bytes would unpack to more than any ratio allows.
    if archive.fp is None or sum(e.compress_size for e in entries.values()) > archive.fp.seek(0, 2):
        _refuse("one whose entries overlap")
    return entries


def _require_harmless_name(entry: zipfile.ZipInfo) -> None:
    name = entry.orig_filename
    is_link = stat.S_ISLNK(entry.external_attr >> 16)
    if is_link or "\\" in name or ":" in name or not name.isprintable():
        _refuse("one with a link, or a name that is no plain one")
    path = PurePosixPath(name)
    if path.is_absolute() or ".." in path.parts:
        _refuse("one with a name that leads out of its folder")


def _index_name(entries: Mapping[str, zipfile.ZipInfo]) -> str:
    """Where the index lies: at the top, or in the one folder that was packed."""
    found = [
        name
        for name in entries
        if PurePosixPath(name).name == INDEX and len(PurePosixPath(name).parts) <= 2
    ]
    if len(found) != 1:
        _refuse(f"one with {len(found)} files {INDEX}")
    return found[0]


def _read_index(
    archive: zipfile.ZipFile, entry: zipfile.ZipInfo, limits: ArchiveLimits
) -> dict[str, Any]:
    if entry.file_size > limits.index_bytes:
        _refuse_size(
            f"an {INDEX} of {entry.file_size} bytes", f"one of {limits.index_bytes} at most"
        )
    # Read with a bound: without one zipfile unpacks all that there is, and then cuts it to the size
    # that the directory tells.
    with archive.open(entry) as packed:
        text = packed.read(limits.index_bytes)
    try:
        index = json.loads(text)
    except (ValueError, RecursionError):
        _refuse(f"an {INDEX} that is no JSON")
    if not isinstance(index, dict):
        _refuse(f"an {INDEX} that holds no object")
    return index


def _unpack_views(
    archive: zipfile.ZipFile,
    entries: Mapping[str, zipfile.ZipInfo],
    base: PurePosixPath,
    index: Mapping[str, Any],
    folder: Path,
    limits: ArchiveLimits,
) -> None:
    """Unpack each frame's file under a name of ours, and write the index that names these."""
    frames, values = [], 0
    for number, (file, pose) in enumerate(_frames(index, limits)):
        entry = entries.get(str(base / file))
        if entry is None:
            _refuse(f"one that lacks the file of frame {number}")
        name = f"{number:03d}.exr"
        with archive.open(entry) as packed, (folder / name).open("xb") as unpacked:
            shutil.copyfileobj(packed, unpacked, CHUNK_BYTES)
        try:
            height, width, channels = read_exr_header(folder / name)
        except ValueError:
            _refuse(f"one whose frame {number} is no OpenEXR file")
        values += height * width * channels
        if not 0 < min(height, width) <= max(height, width) <= limits.view_px:
            _refuse_size(f"{width} x {height} in frame {number}", f"1 to {limits.view_px} a side")
        if values > limits.values:
            _refuse_size("more", f"at most {limits.values} numbers in all views")
        frames.append({"file": name, "c2w": pose})
    (folder / INDEX).write_text(json.dumps({**_numbers_of(index), "frames": frames}))


def _numbers_of(index: Mapping[str, Any]) -> dict[str, Any]:
    """Camera and reference view, with nothing but the numbers that a reader of views looks at."""
    camera = index.get("camera")
    camera = camera if isinstance(camera, dict) else {}
    kept = {name: camera[name] for name in CAMERA_NUMBERS if _is_number(camera.get(name))}
    reference = index.get("reference")
    if isinstance(reference, dict):
        reference = reference.get("train_index")
    return {"camera": kept} | ({"reference": reference} if isinstance(reference, int) else {})


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float)


def _is_pose(value: Any) -> bool:
    """Whether a value is a 4 x 4 matrix; what it means is for the run to judge."""
    return (
        isinstance(value, list)
        and len(value) == 4
        and all(isinstance(row, list) and len(row) == 4 for row in value)
        and all(_is_number(number) for row in value for number in row)
    )


def _frames(index: Mapping[str, Any], limits: ArchiveLimits) -> Iterator[tuple[str, Any]]:
    """File and pose of each training frame."""
    listed = index.get("frames", index.get("train"))
    if not isinstance(listed, list) or not 0 < len(listed) <= limits.views:
        _refuse(f"an {INDEX} that does not list 1 to {limits.views} frames")
    for number, frame in enumerate(listed):
        file = frame.get("file") if isinstance(frame, dict) else None
        if not isinstance(file, str) or not _is_pose(frame.get("c2w")):
            _refuse(f"an {INDEX} whose frame {number} has no file or no 4 x 4 c2w")
        yield file, frame["c2w"]


def _refuse(came: str) -> NoReturn:
    raise Refusal(
        HTTPStatus.UNSUPPORTED_MEDIA_TYPE,
        "no_orbit",
        wanted=WANTED_ZIP,
        came=came,
        todo="pack the folder anew, for example with zip -r views.zip FOLDER",
    )


def _refuse_size(came: str, wanted: str) -> NoReturn:
    raise Refusal(
        HTTPStatus.REQUEST_ENTITY_TOO_LARGE,
        "archive_too_large",
        wanted=f"{WANTED_ZIP}, {wanted}",
        came=came,
        todo="send fewer or smaller views",
    )
