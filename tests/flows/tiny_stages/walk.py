"""A long stage: a random walk that checkpoints every few steps, and fails when told to."""

import errno
import os
import signal
import time
from pathlib import Path

import torch
from tiny_settings import WalkConfig
from tiny_stages.numbers import Numbers

from stages.base import Context, Stage
from stages.errors import InputError, TransientError

FAULTS = {
    "transient": TransientError("a lock was held"),
    "memory": MemoryError("host memory"),
    "cuda memory": torch.OutOfMemoryError("device memory"),
    "io": OSError(errno.EIO, "Input/output error"),
    "input": InputError("the walk cannot start here"),
    "defect": RuntimeError("a defect"),
}


def run(numbers: Numbers, *, config: WalkConfig, ctx: Context) -> Numbers:
    """Add noise `steps` times; the state is the numbers and the generator."""
    _fail(config, ctx.work / "attempts")
    generator = ctx.generator("noise")
    first, values = 0, numbers.values
    if (saved := ctx.checkpoints.load()) is not None:
        first, state = saved
        values = state["values"]
        generator.set_state(state["generator"])
    for step in range(first, config.steps):
        if step % 5 == 0:
            ctx.checkpoints.save(step, {"values": values, "generator": generator.get_state()})
        values = values + torch.randn(values.shape, generator=generator)
        ctx.report(step, config.steps, {"mean": float(values.mean())})
        time.sleep(config.pause_s)
    return Numbers(values)


def _fail(config: WalkConfig, attempts: Path) -> None:
    if config.fault:
        with attempts.open("a") as stream:
            stream.write("x")
        if attempts.stat().st_size <= config.faults:
            if config.fault == "killed":
                os.kill(os.getpid(), signal.SIGKILL)
            if config.fault == "lost interrupt":
                _lose_interrupt()
            raise FAULTS[config.fault]


def _lose_interrupt() -> None:
    """As numba's compiler does."""
    try:
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(10.0)
    except KeyboardInterrupt:
        raise RuntimeError("no compiled object yet") from None


WALK = Stage(run)
