"""The tiny pipeline carried out for a person, without Prefect; and pages of runs that never ran."""

import io
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

from rich.console import Console
from tiny_runs import plan_tiny

from flows.commands import Request
from flows.job import Compute, Job, compute_here
from flows.processes import Process
from flows.run_records import DONE, RunIndex, RunRecord, StageRecord
from stages.store import Store


def carry_out(
    store: Store,
    source: Path,
    out: Path,
    *overrides: str,
    compute: Compute = compute_here,
    **wishes,
) -> RunRecord:
    """Do it, whatever becomes of it; the run's page."""
    request = Request(
        source=str(source),
        out=out,
        preset="standard",
        overrides=overrides,
        skip=wishes.get("skip", frozenset()),
        start=wishes.get("start"),
        until=wishes.get("until"),
        only=None,
        force=frozenset(),
        seed=0,
        device="cpu",
        store=store.root,
    )
    job = Job(store.root, out, "cpu", Console(file=io.StringIO()), request.command)
    plan = plan_tiny(job.store, source, *overrides, **wishes)
    try:
        job.carry_out(plan, {"preset": "standard"}, compute=compute)
    except BaseException as error:
        job.error = error
    return RunIndex(store.root).records()[0]


def gone_process() -> Process:
    """One that was and is no more."""
    child = subprocess.Popen([sys.executable, "-c", "pass"], stdin=subprocess.PIPE)
    this = Process.this()
    child.communicate()
    return replace(this, pid=child.pid)


def page(number: int = 0, **changes) -> RunRecord:
    """A run that was done a while ago, and took a minute."""
    began = time.time() - 1000.0 + number
    record = RunRecord(
        id=f"cat-{number:08x}",
        command=("run", f"/in/cat{number}.png"),
        cwd="/",
        pipeline="image-to-asset",
        source=f"/in/cat{number}.png",
        preset="standard",
        folder=f"/out/cat{number}",
        process=Process.this(),
        state=DONE,
        stages={"nerf": StageRecord(f"{number:064x}", "computed", 60.0)},
        stage="nerf",
        step=0,
        total=0,
        started=began,
        changed=began + 60.0,
        ended=began + 60.0,
        error="",
    )
    return replace(record, **changes)
