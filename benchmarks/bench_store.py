"""What the store costs with many artifacts in it, beside the standard library alone.

    python benchmarks/bench_store.py [--artifacts 10000] [--folder DIR] [--picture FILE]

Makes artifacts of two small files each in a temporary folder (below `--folder`: the disk decides
what syncing costs), and a page of a run for every eight of them. Each row gives operations per
second of wall clock, milliseconds of CPU per operation, and the same for the bare work behind it:

    publish    compute, hash, lock, sync, rename     write the same files
    hit        obtain what is there                  stat the folder
    verify     manifest, seal, sizes, hashes         hash the same files
    ls         manifests of all, newest first        read the manifests as JSON
    gc         `gc --dry-run` that finds half        stat all folders
    status     a process; table of the newest runs   a process that only lists the pages' names
"""

import argparse
import contextlib
import hashlib
import io
import json
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from flows import cli  # noqa: E402
from flows.processes import Process  # noqa: E402
from flows.run_records import DONE, RunIndex, RunRecord, StageRecord  # noqa: E402
from stages.keys import Recipe  # noqa: E402
from stages.store import Store  # noqa: E402

STAGES = 8  # of a run
STATUS_RUNS = 5  # processes that are timed
HEADER = "operation     per s   CPU ms   bare per s   bare CPU ms   times the bare CPU"


@dataclass(frozen=True)
class Cost:
    """Of one operation: seconds of wall clock, and of CPU with those of child processes."""

    wall_s: float
    cpu_s: float


def cpu_s() -> float:
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + children.ru_utime + children.ru_stime


def measure(count: int, work: Callable[[], object]) -> Cost:
    start, cpu_start = time.perf_counter(), cpu_s()
    work()
    return Cost((time.perf_counter() - start) / count, (cpu_s() - cpu_start) / count)


def recipe_of(number: int) -> Recipe:
    return Recipe(f"stage{number % STAGES}", {"number": number}, 0, {}, {}, {})


def write_payload(payload: Path, number: int) -> None:
    (payload / "values.bin").write_bytes(number.to_bytes(8, "little") * 128)
    (payload / "about.txt").write_text(f"number {number}")


def publish_all(store: Store, count: int) -> None:
    for number in range(count):

        def compute(payload: Path, _: Path, number: int = number) -> dict[str, object]:
            write_payload(payload, number)
            return {"seconds": 1.0, "headline": f"number {number}", "events": []}

        store.obtain(recipe_of(number), compute)


def write_bare(folder: Path, count: int) -> None:
    for number in range(count):
        payload = folder / str(number) / "files"
        payload.mkdir(parents=True)
        write_payload(payload, number)
        (folder / str(number) / "manifest.json").write_text(json.dumps({"number": number}))


def hash_bare(store: Store, keys: list[str]) -> None:
    for key in keys:
        for name in ("values.bin", "about.txt"):
            hashlib.sha256((store.artifact(key) / "files" / name).read_bytes()).hexdigest()


def read_bare(store: Store, keys: list[str]) -> None:
    for key in keys:
        json.loads((store.artifact(key) / "manifest.json").read_bytes())


def record_runs(store: Store, keys: list[str]) -> None:
    """A page for every eight artifacts; every second run is too old to be kept."""
    index = RunIndex(store.root)
    now = time.time()
    for number in range(0, len(keys), STAGES):
        wanted = keys[number : number + STAGES]
        stages = {f"stage{i}": StageRecord(key, "computed", 1.0) for i, key in enumerate(wanted)}
        started = now - number - 60.0
        index.write(
            RunRecord(
                id=f"asset-{number:08x}",
                command=("run", f"/in/{number}.png"),
                cwd="/",
                pipeline="image-to-asset",
                source=f"/in/{number // (2 * STAGES)}.png",
                preset="standard",
                folder=f"/out/{number}",
                process=Process.this(),
                state=DONE,
                stages=stages,
                stage="stage7",
                step=0,
                total=0,
                started=started,
                changed=started + 50.0,
                ended=started + 50.0,
                error="",
            )
        )


def command(store: Store, *arguments: str) -> None:
    """`svim3d` in this process, its output thrown away."""
    with contextlib.redirect_stdout(io.StringIO()):
        if cli.main([*arguments, "--store", str(store.root)]) != cli.DONE:
            raise RuntimeError(f"svim3d {' '.join(arguments)} failed")


def process(*arguments: str) -> Callable[[], object]:
    """So many processes one after the other."""
    return lambda: [
        subprocess.run([sys.executable, *arguments], cwd=ROOT, check=True, capture_output=True)
        for _ in range(STATUS_RUNS)
    ]


def run_all(folder: Path, count: int) -> dict[str, tuple[Cost, Cost]]:
    """Cost of each operation, and of the bare work behind it."""
    store = Store(folder / "store")
    rows = {
        "publish": (
            measure(count, lambda: publish_all(store, count)),
            measure(count, lambda: write_bare(folder / "bare", count)),
        )
    }
    keys = [recipe_of(number).key for number in range(count)]
    record_runs(store, keys)
    again = Store(store.root)
    for number in range(count):  # hashes once; a run asks for what it has seen again and again
        again.check(keys[number])
    rows["hit"] = (
        measure(count, lambda: publish_all(again, count)),
        measure(count, lambda: [store.artifact(key).stat() for key in keys]),
    )
    rows["verify"] = (
        measure(count, lambda: command(store, "store", "verify")),
        measure(count, lambda: hash_bare(store, keys)),
    )
    rows["ls"] = (
        measure(count, lambda: command(store, "store", "ls")),
        measure(count, lambda: read_bare(store, keys)),
    )
    rows["gc"] = (
        measure(count, lambda: command(store, "store", "gc", "--dry-run", "--older-than", "0s")),
        measure(count, lambda: [store.artifact(key).stat() for key in keys]),
    )
    names = f"import os; print(len(os.listdir({str(store.root / 'runs')!r})))"
    status = ("-m", "flows.cli", "status", "--store", str(store.root))
    rows["status"] = (
        measure(STATUS_RUNS, process(*status)),
        measure(STATUS_RUNS, process("-c", names)),
    )
    return rows


def draw(rows: dict[str, tuple[Cost, Cost]], file: Path) -> None:
    """Milliseconds of CPU per operation, on a logarithmic scale."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axis = plt.subplots(figsize=(7, 3.2), layout="constrained")
    for offset, label, which in ((-0.2, "svim3d", 0), (0.2, "standard library alone", 1)):
        places = [index + offset for index in range(len(rows))]
        axis.barh(places, [1e3 * costs[which].cpu_s for costs in rows.values()], 0.4, label=label)
    axis.set_yticks(range(len(rows)), list(rows))
    axis.invert_yaxis()
    axis.set_xscale("log")
    axis.set_xlabel("CPU milliseconds per operation")
    axis.legend()
    file.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(file, dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--artifacts", type=int, default=10_000)
    parser.add_argument("--folder", type=Path, help="where the temporary folder is made")
    parser.add_argument("--picture", type=Path)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(dir=arguments.folder) as folder:
        rows = run_all(Path(folder), arguments.artifacts)
    print(
        f"{arguments.artifacts} artifacts, {arguments.artifacts // STAGES} runs", HEADER, sep="\n"
    )
    for name, (ours, bare) in rows.items():
        print(
            f"{name:9}{1 / ours.wall_s:10.1f}{1e3 * ours.cpu_s:9.2f}{1 / bare.wall_s:13.1f}"
            f"{1e3 * bare.cpu_s:14.3f}{ours.cpu_s / max(bare.cpu_s, 1e-9):15.1f}"
        )
    ours, _ = rows["status"]
    print(f"svim3d status: {ours.wall_s:.2f} s of wall clock, {ours.cpu_s:.2f} s of CPU")
    if arguments.picture:
        draw(rows, arguments.picture)
        print(f"picture: {arguments.picture}")


if __name__ == "__main__":
    main()
