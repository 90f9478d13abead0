"""Artifacts of a few bytes, made by the store itself, and the passing of days."""

import os
import time
from pathlib import Path

from stages.keys import Recipe
from stages.store import Store

DAY_S = 24 * 3600.0


def recipe_of(number: int, stage: str = "blur") -> Recipe:
    return Recipe(stage, {"number": number}, 0, {}, {}, {})


def publish(store: Store, number: int, stage: str = "blur") -> str:
    """Key of an artifact with two files of known content: 7 bytes, and 3 in a folder."""

    def compute(payload: Path, work: Path) -> dict:
        (payload / "maps").mkdir()
        (payload / "maps" / "a.bin").write_bytes(b"%07d" % number)
        (payload / "b.txt").write_text("abc")
        return {"seconds": 0.5, "headline": f"number {number}", "events": []}

    return store.obtain(recipe_of(number, stage), compute).key


def make_old(path: Path, days: float) -> None:
    """Let a file, or a folder with all in it, have been changed last some days ago."""
    then = time.time() - days * DAY_S
    for inside in [*path.rglob("*"), path] if path.is_dir() else [path]:
        os.utime(inside, (then, then), follow_symlinks=False)


def tree(folder: Path) -> dict[str, tuple[int, int]]:
    """Every path below a folder, with size and time of change."""
    return {
        path.relative_to(folder).as_posix(): (path.lstat().st_size, path.lstat().st_mtime_ns)
        for path in folder.rglob("*")
    }
