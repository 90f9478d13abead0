"""What becomes of deployed runs when jobs, workers or both are killed.

    python benchmarks/bench_deployments.py [--cases job worker both ...]

Starts a Prefect server of its own, a process work pool with one worker, and deploys the tiny
pipeline of the tests beside the flow that resumes, scheduled every minute. Each case runs a walk
of about ten seconds, kills, and waits for what the automations make of it. An asset's bytes must
equal those of a run that nobody disturbed. One table, with seconds from the kill.
"""

import argparse
import contextlib
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from prefect.client.schemas.objects import FlowRun

PROJECT = Path(__file__).resolve().parents[1]
TINY = PROJECT / "tests" / "flows"
sys.path[:0] = [str(PROJECT), str(TINY)]
POOL, NAME = "svim3d", "pool"
# A walk of 40 steps, long enough to be killed in the middle.
WALK = ("walk.pause_s=0.25",)
PATIENCE_S = 420.0
SEED = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "svim3d"


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as listening:
        return int(listening.getsockname()[1])


@contextlib.contextmanager
def server(home: Path) -> Iterator[str]:
    """A Prefect server with a data base of its own; its address."""
    home.mkdir(parents=True)
    for seed in SEED.glob("prefect-*.db"):  # migrated already: saves 20 s
        shutil.copyfile(seed, home / "prefect.db")
    port = free_port()
    url = f"http://127.0.0.1:{port}/api"
    os.environ.update(
        PREFECT_HOME=str(home),
        PREFECT_API_URL=url,
        PREFECT_SERVER_ANALYTICS_ENABLED="false",
        DO_NOT_TRACK="1",
        OMP_NUM_THREADS="1",
        PYTHONPATH=os.pathsep.join(
            (str(PROJECT), str(TINY), *filter(None, [os.environ.get("PYTHONPATH")]))
        ),
    )
    command = ["prefect", "server", "start", "--port", str(port), "--no-ui"]
    with started(command, home / "server.log"):
        from prefect.client.orchestration import get_client

        with get_client(sync_client=True) as client:
            wait_for(lambda: client.api_healthcheck() is None, "the server")
        yield url


@contextlib.contextmanager
def started(command: list[str], log: Path) -> Iterator[subprocess.Popen[bytes]]:
    """A process in a group of its own, with default signals; nothing of it is left."""
    with log.open("ab") as stream:
        process = subprocess.Popen(
            [str(Path(sys.executable).parent / command[0]), *command[1:]],
            stdout=stream,
            stderr=stream,
            cwd=log.parent,
            start_new_session=True,
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
        )
    try:
        yield process
    finally:
        for number in (signal.SIGINT, signal.SIGKILL):
            with contextlib.suppress(ProcessLookupError, subprocess.TimeoutExpired):
                os.killpg(process.pid, number)
                process.wait(20)


def wait_for(is_so: Callable[[], bool], what: str, patience_s: float = PATIENCE_S) -> float:
    """Seconds until something is so."""
    start = time.monotonic()
    while not is_so():
        if time.monotonic() - start > patience_s:
            raise TimeoutError(f"{what} was not to be seen in {patience_s:g} s")
        time.sleep(0.2)
    return time.monotonic() - start


@dataclass
class Pool:
    """The work pool, its one worker at most, and the runs that are asked for."""

    folder: Path
    workers: contextlib.ExitStack = field(default_factory=contextlib.ExitStack)
    worker: subprocess.Popen[bytes] | None = None

    def __post_init__(self) -> None:
        from prefect.client.orchestration import get_client
        from prefect.client.schemas.actions import WorkPoolCreate
        from prefect.types.entrypoint import EntrypointType
        from tiny_deployment import make_tiny

        from flows.automations import HEARTBEAT_S, TAG, register
        from flows.deployments import resume_crashed

        self.client = get_client(sync_client=True).__enter__()
        self.client.create_work_pool(WorkPoolCreate(name=POOL, type="process"))
        env = {"PREFECT_FLOWS_HEARTBEAT_FREQUENCY": str(HEARTBEAT_S)}
        for deployed in (make_tiny, resume_crashed):
            deployed.to_deployment(
                NAME,
                tags=[TAG],
                cron=None if deployed is make_tiny else "* * * * *",  # in place of five minutes
                work_pool_name=POOL,
                job_variables={"working_dir": str(self.folder), "env": env},
                entrypoint_type=EntrypointType.MODULE_PATH,
            ).apply()
        register(self.client)
        self.deployment = self.client.read_deployment_by_name(f"tiny/{NAME}")
        (self.folder / "digits.txt").write_text("1 2 3")

    def start_worker(self) -> None:
        """One, and one only."""
        assert self.worker is None or self.worker.poll() is not None
        command = ["prefect", "worker", "start", "--pool", POOL, "--limit", "2"]
        log = self.folder / "worker.log"
        self.worker = self.workers.enter_context(started(command, log))

    def ask(self, name: str, *settings: str) -> "Run":
        """A new run."""
        parameters = {
            "source": str(self.folder / "digits.txt"),
            "output": str(self.folder / name / "out"),
            "store": str(self.folder / name / "store"),
            "settings": list(settings or WALK),
        }
        run = self.client.create_flow_run_from_deployment(self.deployment.id, parameters=parameters)
        return Run(self, run.id, self.folder / name)


@dataclass
class Run:
    """A deployed run, as the server and the disk tell of it."""

    pool: Pool
    id: object
    folder: Path

    @property
    def flow_run(self) -> "FlowRun":
        """As the server knows it."""
        return self.pool.client.read_flow_run(self.id)

    def until(self, *names: str) -> float:
        """Seconds until it is in one of these states."""
        return wait_for(
            lambda: self.flow_run.state.name in names, f"{self.folder.name} {' or '.join(names)}"
        )

    def until_walking(self) -> None:
        """Some checkpoints are there."""
        store = self.folder / "store"
        wait_for(lambda: any(store.glob("work/**/checkpoint*")), "a checkpoint")
        time.sleep(2.0)

    @property
    def pids(self) -> list[int]:
        """The job's processes: those that were told this run's id."""
        wanted = f"PREFECT__FLOW_RUN_ID={self.id}".encode()
        found = []
        for entry in Path("/proc").iterdir():
            if entry.name.isdigit():
                with contextlib.suppress(OSError):
                    if wanted in (entry / "environ").read_bytes().split(b"\0"):
                        found.append(int(entry.name))
        return found

    def kill(self) -> None:
        """End its processes at once."""
        for pid in self.pids:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)

    @property
    def crashes(self) -> int:
        """How often it has crashed."""
        return sum(s.is_crashed() for s in self.pool.client.read_flow_run_states(self.id))

    @property
    def total(self) -> bytes:
        """Its product."""
        return (self.folder / "out" / "total.safetensors").read_bytes()

    def inner_states(self) -> list[str]:
        """States of the flows inside of it."""
        from prefect.client.schemas.filters import FlowRunFilter, FlowRunFilterParentFlowRunId

        ours = FlowRunFilter(parent_flow_run_id=FlowRunFilterParentFlowRunId(any_=[self.id]))
        return [run.state.name for run in self.pool.client.read_flow_runs(flow_run_filter=ours)]


def kill_nothing(pool: Pool, run: Run) -> list[str]:
    run.until_walking()
    return [f"completed after {run.until('Completed', 'Failed', 'Crashed'):.0f} s"]


def kill_job(pool: Pool, run: Run) -> list[str]:
    run.until_walking()
    run.kill()
    crashed_s = run.until("Crashed")
    again_s = crashed_s + run.until("Running")
    return [f"crashed {crashed_s:.0f} s", f"running again {again_s:.0f} s"]


def kill_worker(pool: Pool, run: Run) -> list[str]:
    run.until_walking()
    pool.worker.kill()
    pool.worker.wait()
    done_s = run.until("Completed", "Crashed")
    seen = f"the job is {run.flow_run.state.name} {done_s:.0f} s"
    pool.start_worker()
    return [seen]


def kill_both(pool: Pool, run: Run) -> list[str]:
    run.until_walking()
    pool.worker.kill()
    pool.worker.wait()
    run.kill()
    pool.start_worker()
    crashed_s = run.until("Crashed")
    again_s = crashed_s + run.until("Running")
    return [f"crashed {crashed_s:.0f} s", f"running again {again_s:.0f} s"]


def stop_worker(pool: Pool, run: Run) -> list[str]:
    run.until_walking()
    pool.worker.send_signal(signal.SIGTERM)
    pool.worker.wait(60)
    state = run.flow_run.state.name
    pool.start_worker()
    crashed_s = run.until("Crashed", "Completed")
    again_s = crashed_s + run.until("Running", "Completed")
    return [
        f"{state} when the worker is gone",
        f"crashed {crashed_s:.0f} s",
        f"again {again_s:.0f} s",
    ]


def crash_always(pool: Pool, run: Run) -> list[str]:
    done_s = run.until("Failed", "Completed")
    return [f"given up {done_s:.0f} s after it was asked for", run.flow_run.state.message]


def cancel(pool: Pool, run: Run) -> list[str]:
    from prefect.states import Cancelling

    from flows.run_records import RunIndex

    run.until_walking()
    pool.client.set_flow_run_state(run.id, Cancelling())
    done_s = run.until("Cancelled", "Crashed")
    page = RunIndex(run.folder / "store").records()[0].now
    return [f"{run.flow_run.state.name} {done_s:.0f} s", f"svim3d status says {page}"]


FAULTY = ("walk.fault=killed", "walk.faults=99")
CASES: dict[str, tuple[Callable[[Pool, Run], list[str]], tuple[str, ...], str]] = {
    "nothing": (kill_nothing, WALK, "Completed"),
    "job": (kill_job, WALK, "Completed"),
    "worker": (kill_worker, WALK, "Completed"),
    "both": (kill_both, WALK, "Completed"),
    "worker, SIGTERM": (stop_worker, WALK, "Completed"),
    "every try": (crash_always, FAULTY, "Failed"),
    "cancelled": (cancel, WALK, "Cancelled"),
}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--cases", nargs="+", default=list(CASES), choices=list(CASES))
    parser.add_argument("--folder", type=Path, help="kept afterwards (a temporary one)")
    options = parser.parse_args()
    failures = 0
    with contextlib.ExitStack() as stack:
        folder = options.folder or Path(stack.enter_context(tempfile.TemporaryDirectory()))
        stack.enter_context(server(folder / "home"))
        pool = Pool(folder)
        stack.enter_context(pool.workers)
        pool.start_worker()
        truth = None
        print("| killed | what was seen | end | crashes | same bytes |\n|---|---|---|---|---|")
        for name in options.cases:
            case, settings, wanted = CASES[name]
            run = pool.ask(name.replace(", ", "-").replace(" ", "-"), *settings)
            try:
                seen = case(pool, run)
                run.until("Completed", "Failed", "Cancelled")
            except TimeoutError as error:
                seen = [str(error)]
            end, same = run.flow_run.state.name, "-"
            if end == "Completed":
                truth = truth or run.total
                same = "yes" if run.total == truth else "NO"
            failures += end != wanted or same == "NO"
            inner = ", ".join(run.inner_states())
            print(
                f"| {name} | {'; '.join(seen)} (inner: {inner}) | {end} | {run.crashes} | {same} |",
                flush=True,
            )
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
