"""Corrupted orbits as folders: what the cases of inconsistent views start from."""

import shutil
import tempfile
from dataclasses import asdict
from pathlib import Path

from stages.artifacts import MaterialViews
from stages.given_views import shrunken
from stages.keys import code_digests, digest_file, digest_json
from svim3d.io.image import write_png
from svim3d.io.orbit import read_orbit, write_orbit
from svim3d.io.orbit_sheet import orbit_sheet
from svim3d.synthesis import inconsistency
from svim3d.synthesis.inconsistency import Strengths, make_inconsistent


def corrupted_orbit(
    orbit: Path, parent: Path, *, size: int, strengths: Strengths, seed: int
) -> Path:
    """The folder of an orbit's training views, made smaller and then corrupted.

    It is named after all that it depends on, so that one that is there is taken as it is. Depth,
    which no generator knows, is left out. Beside the views lies `views.png` to look at.
    """
    recipe = {
        "size": size,
        "strengths": asdict(strengths),
        "seed": seed,
        "code": {**code_digests(inconsistency.__name__), "here": digest_file(Path(__file__))},
    }
    folder = parent / f"{orbit.name}-{digest_json(recipe)[:16]}"
    if folder.exists():
        return folder
    cameras, images, reference = read_orbit(orbit)
    images.pop("depth", None)
    cameras, images = shrunken(MaterialViews(cameras=cameras, reference=reference, **images), size)
    corrupted = make_inconsistent(cameras, images, reference, strengths, seed)
    parent.mkdir(parents=True, exist_ok=True)
    work = Path(tempfile.mkdtemp(dir=parent, prefix=".tmp-"))
    try:
        write_orbit(work, cameras, corrupted.images, reference=reference)
        write_png(work / "views.png", orbit_sheet(cameras, corrupted.images))
        work.replace(folder)
    finally:
        shutil.rmtree(work, ignore_errors=True)
    return folder
