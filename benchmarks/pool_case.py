"""A Prefect server, a process work pool with one worker, and runs of the tiny pipeline in it."""

import contextlib
import itertools
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from prefect.client.schemas.objects import FlowRun

PROJECT = Path(__file__).resolve().parents[1]
TINY = PROJECT / "tests" / "flows"
sys.path[:0] = [str(PROJECT), str(TINY)]
POOL, NAME = "svim3d", "pool"
PATIENCE_S = 420.0
PAGE = 200  # the most that the server tells at once
SEED = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "svim3d"


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as listening:
        return int(listening.getsockname()[1])


@contextlib.contextmanager
def server(home: Path, database: str | None = None) -> Iterator[str]:
    """A Prefect server with a data base of its own; its address.

    Args:
        home: where it keeps everything; not there yet.
        database: address of an empty one; without it, SQLite under `home`.
    """
    home.mkdir(parents=True)
    if database is not None:
        os.environ["PREFECT_API_DATABASE_CONNECTION_URL"] = database
    else:
        for seed in SEED.glob("prefect-*.db"):  # migrated already: saves 20 s
            shutil.copyfile(seed, home / "prefect.db")
    port = free_port()
    url = f"http://127.0.0.1:{port}/api"
    os.environ.update(
        PREFECT_HOME=str(home),
        PREFECT_API_URL=url,
        PREFECT_SERVER_ANALYTICS_ENABLED="false",
        DO_NOT_TRACK="1",
        # Calling each run late that waits makes writers meet: SQLite then refuses all others too.
        PREFECT_SERVER_SERVICES_LATE_RUNS_ENABLED="false",
        OMP_NUM_THREADS="1",
        PYTHONPATH=os.pathsep.join(
            (str(PROJECT), str(TINY), *filter(None, [os.environ.get("PYTHONPATH")]))
        ),
    )
    command = ["server", "start", "--port", str(port), "--no-ui"]
    with started(command, home / "server.log"):
        from prefect.client.orchestration import get_client

        with get_client(sync_client=True) as client:
            wait_for(lambda: client.api_healthcheck() is None, "the server")
        yield url


@contextlib.contextmanager
def started(command: list[str], log: Path) -> Iterator[subprocess.Popen[bytes]]:
    """`prefect` in a process group of its own, with default signals; nothing of it is left."""
    with log.open("ab") as stream:
        process = subprocess.Popen(
            [sys.executable, "-m", "prefect", *command],
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
    """The work pool, its one worker at most, and the runs that are asked for.

    Attributes:
        folder: where jobs run, and the worker's log.
        resume_cron: when the flow that looks at crashed runs is started without an event.
    """

    folder: Path
    resume_cron: str
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
                cron=None if deployed is make_tiny else self.resume_cron,
                work_pool_name=POOL,
                job_variables={"working_dir": str(self.folder), "env": env},
                entrypoint_type=EntrypointType.MODULE_PATH,
            ).apply()
        register(self.client)
        self.deployment = self.client.read_deployment_by_name(f"tiny/{NAME}")

    def start_worker(self) -> None:
        """One, and one only."""
        assert self.worker is None or self.worker.poll() is not None
        command = ["worker", "start", "--pool", POOL, "--limit", "2"]
        log = self.folder / "worker.log"
        self.worker = self.workers.enter_context(started(command, log))

    def ask(self, source: Path, out: Path, store: Path, settings: Sequence[str]) -> "Run":
        """A new run."""
        parameters = {
            "source": str(source),
            "output": str(out),
            "store": str(store),
            "settings": list(settings),
        }
        run = self.client.create_flow_run_from_deployment(self.deployment.id, parameters=parameters)
        return Run(self, run.id, out, store)

    def count(self, states: Sequence[str]) -> int:
        """How many of the runs that were asked for are in states of these types."""
        from prefect.client.schemas.filters import (
            FlowRunFilter,
            FlowRunFilterDeploymentId,
            FlowRunFilterState,
            FlowRunFilterStateType,
        )

        wanted = FlowRunFilter(
            deployment_id=FlowRunFilterDeploymentId(any_=[self.deployment.id]),
            state=FlowRunFilterState(type=FlowRunFilterStateType(any_=list(states))),
        )
        return self.client.count_flow_runs(flow_run_filter=wanted)

    def stage_spans_s(self, stages: Sequence[str]) -> Iterator[float]:
        """Of each run that did all stages: from the first one's start to the last one's end."""
        from prefect.client.schemas.sorting import TaskRunSort

        moments = defaultdict(list)
        page = {"sort": TaskRunSort.EXPECTED_START_TIME_DESC, "limit": PAGE}
        for offset in itertools.count(0, PAGE):
            found = self.client.read_task_runs(**page, offset=offset)
            for run in found:
                is_stage = any(run.name.startswith(f"{stage}-") for stage in stages)
                if is_stage and run.start_time and run.end_time:
                    moments[run.flow_run_id] += [run.start_time, run.end_time]
            if len(found) < PAGE:
                break
        for times in moments.values():
            if len(times) == 2 * len(stages):
                yield (max(times) - min(times)).total_seconds()


@dataclass
class Run:
    """A deployed run, as the server and the disk tell of it."""

    pool: Pool
    id: object
    out: Path
    store: Path

    @property
    def flow_run(self) -> "FlowRun":
        """As the server knows it."""
        return self.pool.client.read_flow_run(self.id)

    def until(self, *names: str) -> float:
        """Seconds until it is in one of these states."""
        return wait_for(
            lambda: self.flow_run.state.name in names, f"{self.out.name} {' or '.join(names)}"
        )

    def until_walking(self) -> None:
        """Some checkpoints are there."""
        wait_for(lambda: any(self.store.glob("work/**/checkpoint*")), "a checkpoint")
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
        return (self.out / "total.safetensors").read_bytes()

    def inner_states(self) -> list[str]:
        """States of the flows inside of it."""
        from prefect.client.schemas.filters import FlowRunFilter, FlowRunFilterParentFlowRunId

        ours = FlowRunFilter(parent_flow_run_id=FlowRunFilterParentFlowRunId(any_=[self.id]))
        return [run.state.name for run in self.pool.client.read_flow_runs(flow_run_filter=ours)]
