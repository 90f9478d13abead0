"""`svim3d` as the benchmark of kills runs it: the command, and a trap where one is asked for.

    python benchmarks/kill_subject.py TRAP ARGUMENTS...

TRAP is JSON. Without entries only checkpoints differ from the command's: they are due by the CPU
seconds of the process, as everything here, because a busy machine makes others mean little.

    {"stage": "nerf", "moment": "before rename", "signal": 9, "group": false}
        the process kills itself (or its group) at that moment of publishing
    {"clock_s": 259200, "after_cpu_s": 4}
        the clock jumps
"""

import json
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

CHECKPOINT_CPU_S = 0.3
MOMENTS = ("hashing", "half a manifest", "syncing", "before rename", "after rename")


def checkpoint_often() -> None:
    from stages.base import Checkpoints

    saved_s = 0.0
    save = Checkpoints.save

    def save_noting(self: Checkpoints, *arguments: Any) -> None:
        nonlocal saved_s
        save(self, *arguments)
        saved_s = time.process_time()

    Checkpoints.save = save_noting
    Checkpoints.due = lambda _: time.process_time() - saved_s > CHECKPOINT_CPU_S


def shift_clock(shift_s: float, after_cpu_s: float) -> None:
    now, now_ns = time.time, time.time_ns

    def shift() -> float:
        return shift_s if time.process_time() > after_cpu_s else 0.0

    time.time = lambda: now() + shift()
    time.time_ns = lambda: now_ns() + int(1e9 * shift())


def set_trap(stage: str, moment: str, kill: Callable[[], None]) -> None:
    """Kill at a moment of publishing that stage's artifact."""
    from stages import manifest, store

    is_publishing = False
    of, write = manifest.Manifest.of.__func__, manifest.Manifest.write
    digest, sync, rename = manifest.digest_file, store._sync, Path.rename

    def spring_at(this: str) -> None:
        if is_publishing and moment == this:
            kill()

    def describe(kind: type, folder: Path, recipe: Any, record: Any) -> Any:
        nonlocal is_publishing
        is_publishing = recipe.stage == stage
        return of(kind, folder, recipe, record)

    def hash_file(file: Path) -> str:
        spring_at("hashing")
        return digest(file)

    def write_page(page: Any, folder: Path) -> None:
        write(page, folder)
        if is_publishing and moment == "half a manifest":
            file = folder / manifest.MANIFEST_NAME
            file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
            kill()

    def sync_to_disk(path: Path) -> None:
        sync(path)
        spring_at("syncing")

    def rename_path(path: Path, target: Path) -> Path:
        spring_at("before rename")
        renamed = rename(path, target)
        spring_at("after rename")
        return renamed

    manifest.Manifest.of = classmethod(describe)
    manifest.Manifest.write = write_page
    manifest.digest_file, store._sync, Path.rename = hash_file, sync_to_disk, rename_path


def main() -> int:
    trap, arguments = json.loads(sys.argv[1]), sys.argv[2:]
    checkpoint_often()
    if "clock_s" in trap:
        shift_clock(trap["clock_s"], trap["after_cpu_s"])
    if "moment" in trap:
        send = os.killpg if trap["group"] else os.kill
        set_trap(trap["stage"], trap["moment"], lambda: send(os.getpid(), trap["signal"]))
    from flows import cli

    return cli.main(arguments)


if __name__ == "__main__":
    sys.exit(main())
