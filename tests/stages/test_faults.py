"""Faults are told apart, leave their trace, and make the next attempt smaller where that helps."""

import errno

import pytest
import torch
from small_texts import Text, recipe

from stages.base import MIN_CHUNK, Stage
from stages.errors import (
    DivergenceError,
    FullError,
    InputError,
    StageTimeoutError,
    TransientError,
)
from stages.execution import run_stage
from stages.faults import Fault, kind_of
from stages.settings.base import StageConfig
from stages.store import Store

CPU = torch.device("cpu")


@pytest.mark.parametrize(
    ("error", "kind"),
    [
        (InputError("no picture"), Fault.INPUT),
        (MemoryError(), Fault.MEMORY),
        (torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2 GiB"), Fault.MEMORY),
        (RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried 9"), Fault.MEMORY),
        (RuntimeError("CUDA error: out of memory"), Fault.MEMORY),
        (RuntimeError("cuDNN error: CUDNN_STATUS_ALLOC_FAILED"), Fault.MEMORY),
        (OSError(errno.ENOMEM, "Cannot allocate memory"), Fault.MEMORY),
        (OSError(errno.EIO, "Input/output error"), Fault.FILES),
        (OSError(errno.ESTALE, "Stale file handle"), Fault.FILES),
        (OSError(errno.ENETDOWN, "Network is down"), Fault.FILES),
        (TimeoutError("no answer"), Fault.FILES),
        (ConnectionResetError("peer"), Fault.FILES),
        (TransientError("a lock was held"), Fault.BUSY),
        (FullError("no space"), Fault.SPACE),
        (OSError(errno.ENOSPC, "No space left on device"), Fault.SPACE),
        (OSError(errno.EROFS, "Read-only file system"), Fault.SPACE),
        (StageTimeoutError("nerf"), Fault.TIME),
        (FileNotFoundError(errno.ENOENT, "gone"), Fault.DEFECT),
        (ValueError("out of memory, says a defect of ours"), Fault.DEFECT),
        (DivergenceError("nerf"), Fault.DEFECT),
        (KeyError("x"), Fault.DEFECT),
    ],
)
def test_kinds(error, kind):
    assert kind_of(error) is kind
    assert kind.is_passing == (kind in {Fault.MEMORY, Fault.FILES, Fault.BUSY})


def test_torchs_own_refusal_is_known():
    with pytest.raises(RuntimeError) as caught:
        torch.empty(2**60, dtype=torch.uint8)
    assert kind_of(caught.value) is Fault.MEMORY


def test_next_attempt_works_in_smaller_chunks_and_says_so(tmp_path):
    store, seen = Store(tmp_path), []

    def run(source, *, config, ctx) -> Text:
        seen.append((ctx.chunk(8 * MIN_CHUNK), ctx.chunk(10)))
        if len(seen) <= 5:
            raise (
                MemoryError("that was\ntoo much") if len(seen) != 2 else OSError(errno.EIO, "away")
            )
        return Text("done")

    def attempt():
        given = {"source": tmp_path}
        options = {"config": StageConfig(), "device": CPU}
        return run_stage(store, recipe("part"), stage, given, **options)

    run.__annotations__["source"] = type(tmp_path)
    stage = Stage(run)
    for _ in range(5):
        with pytest.raises((MemoryError, OSError)):
            attempt()
    stored = attempt()
    # The input/output fault between them changes nothing about memory; the least chunk has a bound.
    assert [chunk // MIN_CHUNK for chunk, _ in seen] == [8, 4, 4, 2, 1, 1]
    assert {least for _, least in seen} == {10}
    events = stored.manifest.record["events"]
    assert [event["kind"] for event in events] == ["out_of_memory", "io_fault"] + 3 * [
        "out_of_memory"
    ]
    assert events[0]["message"] == "attempt that failed, number 1: out of memory (that was)"
    assert stored.key == recipe("part").key


@pytest.mark.parametrize("error", [InputError("never"), KeyError("defect"), KeyboardInterrupt()])
def test_other_ends_leave_no_trace(tmp_path, error):
    store = Store(tmp_path)

    def run(*, config, ctx) -> Text:
        raise error

    with pytest.raises(type(error)):
        run_stage(store, recipe("part"), Stage(run), {}, config=StageConfig(), device=CPU)
    assert not (store.work(recipe("part").key) / "events.jsonl").exists()
