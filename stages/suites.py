"""Benchmarks' folders: which objects they hold, and each as a folder of its truth.

Orbits of our own layout are taken as they are. Others are converted once, into a folder whose name
tells the source's files and the code that converts: what was converted before is found again.
"""

import shutil
import tempfile
from pathlib import Path

from stages.errors import InputError
from stages.keys import code_digests, digest_json
from svim3d.io.suites import blender_renders, orbits, scans, stanford_orb
from svim3d.io.suites.truth_folder import write_truth

READERS = {
    "orbits": orbits,
    "stanford-orb": stanford_orb,
    "poly-haven": blender_renders,
    "blender-vault": blender_renders,
    "gso": scans,
}


def list_objects(suite: str, folder: Path) -> list[str]:
    """Names of the objects in a suite's folder, in order.

    Raises:
        InputError: there are none; says what was looked for.
    """
    if not folder.is_dir():
        raise InputError(f"wanted a folder of {suite} objects, but {folder} is none")
    names = READERS[suite].list_objects(folder)
    if not names:
        raise InputError(
            f"wanted objects of suite {suite} in {folder}, found none: looked for "
            f"{READERS[suite].LOOKED_FOR}; docs/evaluation.md shows each layout"
        )
    return names


def truth_folder(suite: str, folder: Path, name: str, parent: Path, size: int) -> Path:
    """The folder of an object's truth, converted if it has to be.

    Args:
        suite: of the object.
        folder: of the suite.
        name: of the object.
        parent: where converted folders are kept.
        size: most rows of converted views.

    Raises:
        InputError: files are missing or damaged.
    """
    reader = READERS[suite]
    if reader is orbits:
        return folder / name
    try:
        files = reader.source_files(folder, name)
        about = {
            "files": [[str(f), f.stat().st_size, f.stat().st_mtime_ns] for f in files],
            "size": size,
            "code": code_digests(reader.__name__),
        }
        made = parent / f"{name}-{digest_json(about)[:12]}"
        if made.is_dir():
            return made
        parent.mkdir(parents=True, exist_ok=True)
        work = Path(tempfile.mkdtemp(dir=parent, prefix=".tmp-"))
        try:
            write_truth(reader.read_object(folder, name, size), work)
            work.replace(made)
        finally:
            shutil.rmtree(work, ignore_errors=True)
    except (ValueError, OSError) as error:
        raise InputError(f"{suite} object {name}: {error}") from error
    return made
