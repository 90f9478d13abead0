"""Run one stage against the store: load its inputs, measure it, save what it returns."""

import contextlib
import functools
import os
import platform
import resource
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import torch

from stages.base import OUT_OF_MEMORY, Artifact, Context, Progress, Stage
from stages.device_slot import device_slot
from stages.errors import InputError
from stages.faults import Fault, kind_of
from stages.keys import Recipe
from stages.settings.base import StageConfig
from stages.store import Store, Stored
from stages.time_limit import time_limit

# Faults that leave a trace in the artifact which comes about in spite of them.
EVENT_KINDS = {
    Fault.MEMORY: OUT_OF_MEMORY,
    Fault.FILES: "io_fault",
    Fault.BUSY: "transient_fault",
    Fault.TIME: "timeout",
}
PROJECT = Path(__file__).resolve().parents[1]


def choose_device(name: str) -> torch.device:
    """The device for "auto", "cpu" or "cuda".

    Raises:
        InputError: if CUDA is asked for and there is none.
    """
    has_cuda = torch.cuda.is_available()
    if name == "cuda" and not has_cuda:
        raise InputError("device cuda was asked for, but torch sees none; use --device auto")
    return torch.device("cuda" if has_cuda and name != "cpu" else "cpu")


def run_stage(
    store: Store,
    recipe: Recipe,
    stage: Stage,
    inputs: Mapping[str, Stored | Path | None],
    *,
    config: StageConfig,
    device: torch.device,
    force: bool = False,
    limit_s: float | None = None,
    on_progress: Callable[[Progress], None] | None = None,
) -> Stored:
    """The artifact of `recipe`, made by `stage` if the store has none.

    Args:
        store: where it is looked for and kept.
        recipe: everything the artifact depends on; gives the seed.
        stage: what to run.
        inputs: in the order of the stage's signature, by name of their origin: an upstream
            artifact, the path of an external input, or None where skipped.
        config: the stage's settings, the same as in the recipe.
        device: where to compute.
        force: run though the store has it.
        limit_s: seconds after which the stage is stopped.
        on_progress: told how far the stage is.
    """

    def compute(payload: Path, work: Path) -> dict[str, Any]:
        with device_slot(device):
            start, cpu_start = time.monotonic(), time.process_time()
            _reset_peak_memory(device)
            with (
                Context(
                    recipe.stage, device, recipe.seed, work, store.shared, on_progress=on_progress
                ) as ctx,
                _faults_noted(ctx),
                time_limit(limit_s, recipe.stage),
            ):
                artifact: Artifact = stage.run(*_load(stage, inputs), config=config, ctx=ctx)
                artifact.save(payload)
            return {
                "seconds": round(time.monotonic() - start, 3),
                "cpu_seconds": round(time.process_time() - cpu_start, 3),
                "peak_memory_mib": _peak_memory_mib(device),
                "headline": artifact.headline(),
                "events": ctx.events,
                # The key names the inputs' recipes; this names the bytes that were consumed.
                "consumed": {
                    n: i.manifest.seal for n, i in inputs.items() if isinstance(i, Stored)
                },
                **_surroundings(device),
            }

    return store.obtain(recipe, compute, force=force)


@contextlib.contextmanager
def _faults_noted(ctx: Context) -> Iterator[None]:
    """Leave a note of a passing fault for the next attempt, and for the manifest."""
    try:
        yield
    except Exception as error:
        fault = kind_of(error)
        if kind := EVENT_KINDS.get(fault):
            number = ctx.count(kind) + 1
            first_line = str(error).partition("\n")[0] or type(error).__name__
            message = f"attempt that failed, number {number}: {fault} ({first_line})"
            with contextlib.suppress(OSError):  # the fault may be the folder's own
                ctx.event(kind, message, tell=False)  # whoever watches is told of the exception
        if ctx.device.type == "cuda" and fault is Fault.MEMORY:
            torch.cuda.empty_cache()
        raise


def _load(stage: Stage, inputs: Mapping[str, Stored | Path | None]) -> list[Any]:
    """Values for the stage's positional arguments."""
    return [
        kind.load(given.folder) if isinstance(given, Stored) else given
        for kind, given in zip(stage.inputs.values(), inputs.values(), strict=True)
    ]


def _surroundings(device: torch.device) -> dict[str, Any]:
    """Where and with what a computation ran; kept in the manifest, no part of the key."""
    return {
        "device": torch.cuda.get_device_name(device) if device.type == "cuda" else "cpu",
        "cores": os.cpu_count(),
        "threads": torch.get_num_threads(),
        "host": socket.gethostname(),
        "platform": platform.platform(),
        "python": platform.python_version(),
        "torch": torch.__version__,
        "git_commit": _git_commit(),
        "finished": time.strftime("%Y-%m-%dT%H:%M:%S%z"),
    }


@functools.cache  # the code that was loaded; a process for each stage would be most of a short one
def _git_commit() -> str | None:
    """Commit of the checkout that runs, None where the code is no checkout."""
    if not (PROJECT / ".git").exists():
        return None
    try:
        command = ["git", "-C", str(PROJECT), "rev-parse", "HEAD"]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return None


def _reset_peak_memory(device: torch.device) -> None:
    """Let the peak be this stage's own; where the kernel offers no reset it is the process's."""
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        return


def _peak_memory_mib(device: torch.device) -> dict[str, float]:
    """Highest resident memory of the process, and of the device, in MiB."""
    peak = {"host": round(_peak_resident_mib(), 1)}
    if device.type == "cuda":
        peak["device"] = round(torch.cuda.max_memory_allocated(device) / 2**20, 1)
    return peak


def _peak_resident_mib() -> float:
    status = Path("/proc/self/status")
    if status.exists():
        lines = dict(line.split(":", 1) for line in status.read_text().splitlines() if ":" in line)
        return float(lines["VmHWM"].split()[0]) / 1024
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 2**20 if sys.platform == "darwin" else peak / 1024
