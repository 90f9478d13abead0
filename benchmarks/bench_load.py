"""Many tiny runs by each way to run many, with workers killed in the middle, beside bare Python.

    python benchmarks/bench_load.py [--runs 200] [--rows bare local dask ray pool postgres]
                                    [--results FILE] [--chart FILE] [--folder DIR]

A run is the tiny pipeline of the tests: three stages of a few milliseconds, each row in a store of
its own. `local`, `dask` and `ray` are `svim3d batch --jobs 2`; the worker at work is killed when
half the assets are there. `pool` is a Prefect server, a process work pool and one worker with two
jobs at a time that asks for work every two seconds: a job is killed at a quarter, the worker and
its jobs at half; then another worker is started, and the automations find what was lost. `bare` is
a loop over the stages with the store. `postgres` is a pool whose server keeps its records in
PostgreSQL instead of SQLite.

    wall, CPU    seconds from the start of the command, or of the server, to its end; all processes
    first        seconds until the first asset
    per min      assets after the first, killing and finding included
    run + ms     beside bare Python for each asset: wall clock between first and last, and all CPU
    task + ms    beside bare Python for each stage: from the first stage's start to the last's end
    begun, cut   runs that left a page in the store, and those whose process died
    equal        assets that are there, whose artifacts are sound and all bytes those of `bare`
"""

import argparse
import contextlib
import ctypes
import importlib.util
import json
import os
import platform
import resource
import signal
import sqlite3
import statistics
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from datetime import datetime
from pathlib import Path
from unittest import mock

from pool_case import PROJECT, TINY, Pool, server, wait_for
from postgres_case import has_postgres, postgres
from tiny_batch import TINY_FILES, TinyConfig, start, states

from flows.batch_job import BatchJob
from flows.batch_results import DONE as DONE_STATES
from flows.run_folder import RUN_PAGE
from flows.run_records import DIED, RUNNING, RunIndex, RunRecord
from stages.store import Store

SETTINGS = ("walk.steps=10",)
AT_ONCE = 2
PRODUCT = "total.safetensors"
LONGEST_S = 3600.0  # of a row
SPANS = "spans.json"
ADOPT_ORPHANS = 36  # PR_SET_CHILD_SUBREAPER of prctl(2)
COLUMNS = (
    *("row", "runs", "wall s", "CPU s", "first s", "per min", "run + ms wall", "run + ms CPU"),
    *("task + ms", "begun", "cut", "failed", "equal"),
)


@dataclass(frozen=True)
class Scene:
    """The inputs of a row, and where its store and run folders are."""

    folder: Path
    runs: int

    @property
    def inputs(self) -> Path:
        """One small file for each run, shared by all rows."""
        return self.folder.parent / "in"

    @property
    def store(self) -> Path:
        """Folder of the artifacts."""
        return self.folder / "store"

    @property
    def out(self) -> Path:
        """Folder of the run folders."""
        return self.folder / "out"

    @property
    def jobs(self) -> list[BatchJob]:
        """What is to be made."""
        return [
            BatchJob(
                name=source.stem,
                pipeline=TINY_FILES,
                schema=TinyConfig,
                source=source,
                out=self.out / source.stem,
                preset="standard",
                overrides=SETTINGS,
                skip=frozenset(),
                seed=0,
                device="cpu",
                store=self.store,
            )
            for source in sorted(self.inputs.iterdir())
        ]

    def times(self) -> list[float]:
        """When each asset came to be, in order."""
        return sorted(file.stat().st_mtime for file in self.out.glob(f"*/{PRODUCT}"))

    def until(self, share: float) -> None:
        """Wait until so much of it is done."""
        wanted = max(1, round(share * self.runs))
        wait_for(lambda: len(self.times()) >= wanted, f"{wanted} assets", LONGEST_S)

    def at_work(self) -> list[RunRecord]:
        """Runs that go on."""
        return [record for record in RunIndex(self.store).records() if record.now == RUNNING]

    def kill_one(self) -> None:
        """End a process that is in the middle of a run."""
        wait_for(lambda: any(_kill(record) for record in self.at_work()[:1]), "a run to kill")


def _kill(record: RunRecord) -> bool:
    try:
        os.kill(record.process.pid, signal.SIGKILL)
    except ProcessLookupError:
        return False
    print(f"  killed process {record.process.pid} over {record.id}", flush=True)
    return True


def make_bare(folder: str) -> None:
    """The loop that all is measured by."""
    from tiny_runs import compute

    spans_s = []
    scene = Scene(Path(folder), 0)
    store = Store(scene.store)
    for job in scene.jobs:
        plan = job.plan(store)
        began = time.perf_counter()
        artifacts = compute(plan, store)
        spans_s.append(time.perf_counter() - began)
        job.finish(plan, artifacts, store)
    (scene.folder / SPANS).write_text(json.dumps(spans_s))


def run_bare(scene: Scene) -> int:
    script = "import sys, bench_load; bench_load.make_bare(sys.argv[1])"
    path = os.pathsep.join((str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")))
    command = [sys.executable, "-c", script, str(scene.folder)]
    subprocess.run(command, check=True, env=os.environ | {"PYTHONPATH": path})
    return 0


def run_batch(scene: Scene, runner: str) -> int:
    """Inputs that failed."""
    options = ["--runner", runner, "--jobs", AT_ONCE, "--device", "cpu", "--store", scene.store]
    settings = (f"--set={setting}" for setting in SETTINGS)
    process = start([scene.inputs, "-o", scene.out, *options, *settings])
    scene.until(0.5)
    scene.kill_one()
    said, complaints = process.communicate(timeout=LONGEST_S)
    print("  " + said.splitlines()[-1])
    (scene.folder / "said.log").write_text(said + complaints)
    return sum(state not in DONE_STATES for state in states(scene.out).values())


def run_pool(scene: Scene, in_postgres: bool = False) -> int:
    """Runs that did not end well."""
    with contextlib.ExitStack() as stack:
        stack.enter_context(mock.patch.dict(os.environ))
        database = stack.enter_context(postgres()) if in_postgres else None
        stack.enter_context(server(scene.folder / "home", database))
        workers = stack.enter_context(contextlib.ExitStack())
        from flows.automations import RESUME_CRON

        # Of ten seconds between two questions, five would be lost on each of these runs.
        os.environ["PREFECT_WORKER_QUERY_SECONDS"] = "2"
        pool = Pool(scene.folder, RESUME_CRON, workers)
        pool.start_worker()
        for job in scene.jobs:
            pool.ask(job.source, job.out, job.store, SETTINGS)
        scene.until(0.25)
        scene.kill_one()
        scene.until(0.5)
        pool.worker.kill()
        pool.worker.wait()
        for record in scene.at_work():
            _kill(record)
        pool.start_worker()
        wait_for(lambda: not pool.count(UNSETTLED), "the last run", LONGEST_S)
        spans_s = list(pool.stage_spans_s(TINY_FILES.names))
        (scene.folder / SPANS).write_text(json.dumps(spans_s))
        return scene.runs - pool.count(["COMPLETED"])


ROWS: dict[str, Callable[[Scene], int]] = {
    "bare": run_bare,
    "local": lambda scene: run_batch(scene, "local"),
    "dask": lambda scene: run_batch(scene, "dask"),
    "ray": lambda scene: run_batch(scene, "ray"),
    "pool": run_pool,
    "postgres": lambda scene: run_pool(scene, in_postgres=True),
}
# A crashed run is given another try.
UNSETTLED = ["SCHEDULED", "PENDING", "RUNNING", "PAUSED", "CANCELLING", "CRASHED"]


@dataclass(frozen=True)
class Cost:
    """What a row took and came to.

    Attributes:
        runs: that were asked for.
        wall_s: from start to end.
        cpu_s: of all its processes.
        first_s: until the first asset.
        apart_s: mean time between two assets.
        span_s: median time from the start of a run's first stage to the end of its last one.
        begun: runs that left a page.
        cut: of these, runs whose process died.
        failed: inputs that came to nothing.
        wrong: what is missing or not as it should be.
    """

    runs: int
    wall_s: float
    cpu_s: float
    first_s: float
    apart_s: float
    span_s: float
    begun: int
    cut: int
    failed: int
    wrong: list[str]


def measure(name: str, scene: Scene, bare: Scene) -> Cost:
    """Run a row and look at what it made."""
    scene.folder.mkdir()
    began, cpu_start = time.time(), _children_cpu_s()
    failed = ROWS[name](scene)
    _bury_orphans()
    wall_s, cpu_s = time.time() - began, _children_cpu_s() - cpu_start
    times = scene.times()
    records = RunIndex(scene.store).records()
    return Cost(
        runs=scene.runs,
        wall_s=wall_s,
        cpu_s=cpu_s,
        first_s=times[0] - began,
        apart_s=(times[-1] - times[0]) / (len(times) - 1),
        span_s=statistics.median(_spans_s(scene)),
        begun=len(records),
        cut=sum(record.now == DIED for record in records),
        failed=failed,
        wrong=list(_differences(scene, bare)),
    )


def _children_cpu_s() -> float:
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def _bury_orphans() -> None:
    """Wait for jobs whose worker was killed: only then does their CPU time count."""
    deadline = time.monotonic() + 30.0
    with contextlib.suppress(ChildProcessError):
        while time.monotonic() < deadline:
            if os.waitpid(-1, os.WNOHANG) == (0, 0):
                time.sleep(0.1)


def _spans_s(scene: Scene) -> Iterator[float]:
    """Of each whole run, from the start of the first stage to the end of the last, by the clock."""
    if (told := scene.folder / SPANS).exists():
        yield from json.loads(told.read_text())
        return
    (database,) = scene.folder.rglob("prefect.db")
    query = "SELECT flow_run_id, start_time, end_time FROM task_run WHERE name GLOB ?"
    moments = defaultdict(list)
    with contextlib.closing(sqlite3.connect(database)) as connection:
        for stage in TINY_FILES.names:
            for run, *both in connection.execute(query, [f"{stage}-*"]):
                if all(both):
                    moments[run] += [datetime.fromisoformat(text) for text in both]
    for of_run in moments.values():
        if len(of_run) == 2 * len(TINY_FILES.names):
            yield (max(of_run) - min(of_run)).total_seconds()


def _differences(scene: Scene, bare: Scene) -> Iterator[str]:
    """What is not there, not sound, or not the same."""
    store, true_store = Store(scene.store), Store(bare.store)
    for job, true_job in zip(scene.jobs, bare.jobs, strict=True):
        plan, true_plan = job.plan(store), true_job.plan(true_store)
        if plan.to_compute:
            yield f"{job.name}: {', '.join(s.node.name for s in plan.to_compute)} not in the store"
            continue
        for step, true_step in zip(plan.steps, true_plan.steps, strict=True):
            if step.stored.manifest.files != true_step.stored.manifest.files:
                yield f"{job.name}: {step.node.name} has other bytes"
        if not job.is_laid_out(plan):
            yield f"{job.name}: no {RUN_PAGE} that shows it"
        elif (job.out / PRODUCT).read_bytes() != (true_job.out / PRODUCT).read_bytes():
            yield f"{job.name}: {PRODUCT} has other bytes"


def cells(name: str, cost: Cost, bare: Cost) -> list[str]:
    """A row of the table."""
    stages = len(TINY_FILES.names)
    beyond = [
        cost.apart_s - bare.apart_s,
        (cost.cpu_s - bare.cpu_s) / cost.runs,
        (cost.span_s - bare.span_s) / stages,
    ]
    wrong = len({text.partition(":")[0] for text in cost.wrong})
    return [
        *(name, str(cost.runs), f"{cost.wall_s:.0f}", f"{cost.cpu_s:.0f}", f"{cost.first_s:.1f}"),
        f"{60.0 / cost.apart_s:.1f}",
        *("-" if cost is bare else f"{1e3 * seconds:.0f}" for seconds in beyond),
        *(str(count) for count in (cost.begun, cost.cut, cost.failed)),
        f"{cost.runs - wrong} of {cost.runs}",
    ]


def draw(costs: dict[str, Cost], file: Path) -> None:
    """Milliseconds of an asset by row, on a logarithmic scale."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axis = plt.subplots(figsize=(7, 0.9 + 0.5 * len(costs)), layout="constrained")
    values = {
        "wall clock between two assets": [1e3 * cost.apart_s for cost in costs.values()],
        "CPU per asset, starts included": [1e3 * c.cpu_s / c.runs for c in costs.values()],
    }
    for offset, (label, widths) in zip((-0.2, 0.2), values.items(), strict=True):
        places = [index + offset for index in range(len(costs))]
        bars = axis.barh(places, widths, 0.4, label=label)
        axis.bar_label(bars, fmt="{:,.0f}", padding=3)
    axis.set_yticks(range(len(costs)), list(costs))
    axis.invert_yaxis()
    axis.set_xscale("log")
    axis.margins(x=0.15)
    axis.set_xlabel("milliseconds")
    axis.legend()
    file.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(file, dpi=110)


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    there = [name for name in ROWS if _can_run(name)]
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--rows", nargs="+", default=there, choices=there)
    parser.add_argument("--results", type=Path, help="JSON file to write")
    parser.add_argument("--chart", type=Path, help="picture to draw")
    parser.add_argument("--folder", type=Path, help="where the temporary folder is made")
    given = parser.parse_args()
    ctypes.CDLL(None).prctl(ADOPT_ORPHANS, 1, 0, 0, 0)
    os.environ.pop("PREFECT_API_URL", None)  # each row has its own server
    os.environ["OMP_NUM_THREADS"] = "1"
    os.environ["PYTHONPATH"] = os.pathsep.join((str(PROJECT), str(TINY)))
    costs: dict[str, Cost] = {}
    with tempfile.TemporaryDirectory(dir=given.folder) as folder:
        inputs = Path(folder) / "in"
        inputs.mkdir()
        for number in range(given.runs):
            (inputs / f"n{number:04}.txt").write_text(f"{number} 2 3")
        bare = Scene(Path(folder) / "bare", given.runs)
        print("| " + " | ".join(COLUMNS) + " |", "|" + "---|" * len(COLUMNS), sep="\n")
        # Bare Python comes first: all others are held against it.
        for name in ("bare", *(name for name in given.rows if name != "bare")):
            costs[name] = measure(name, Scene(Path(folder) / name, given.runs), bare)
            print("| " + " | ".join(cells(name, costs[name], costs["bare"])) + " |", flush=True)
            for problem in costs[name].wrong:
                print(f"  WRONG: {problem}")
    if given.results:
        machine = {"cores": os.cpu_count(), "load": os.getloadavg(), "python": sys.version}
        page = {"machine": machine | {"kernel": platform.release()}}
        page["rows"] = {name: asdict(cost) for name, cost in costs.items()}
        given.results.write_text(json.dumps(page, indent=1))
    if given.chart:
        draw(costs, given.chart)
    return int(any(cost.failed or cost.wrong for cost in costs.values()))


def _can_run(name: str) -> bool:
    if name == "postgres":
        return has_postgres()
    return name not in ("dask", "ray") or importlib.util.find_spec(f"prefect_{name}") is not None


if __name__ == "__main__":
    sys.exit(main())
