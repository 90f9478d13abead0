"""A block that runs too long is stopped in any thread, and its process in the last resort."""

import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
import torch
from small_texts import Text, recipe

from stages.base import Stage
from stages.errors import StageTimeoutError
from stages.execution import run_stage
from stages.settings.base import StageConfig
from stages.store import Store
from stages.time_limit import time_limit

PROJECT = Path(__file__).resolve().parents[2]
SLOW_S = 20.0  # what is never waited for


def spin(seconds: float = SLOW_S) -> None:
    """Keep to Python: a sleeping thread is woken by a signal, not by an exception."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        time.sleep(0.01)


def stopped_after_s() -> float:
    start = time.monotonic()
    words = r"nerf was stopped after its 0\.2 s"
    with pytest.raises(StageTimeoutError, match=words), time_limit(0.2, "nerf"):
        spin()
    return time.monotonic() - start


def test_main_thread_is_stopped_and_the_alarm_put_back():
    before = signal.getsignal(signal.SIGALRM)
    assert 0.2 <= stopped_after_s() < SLOW_S / 2
    assert signal.getsignal(signal.SIGALRM) is before
    assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)


def test_other_threads_are_stopped():
    taken = []
    thread = threading.Thread(target=lambda: taken.append(stopped_after_s()))
    thread.start()
    thread.join()
    assert 0.2 <= taken[0] < SLOW_S / 2


def test_what_is_in_time_is_left_alone():
    def work() -> None:
        with time_limit(0.1, "nerf"):
            pass
        spin(0.3)
        ended.append(True)

    ended: list[bool] = []
    work()
    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    with time_limit(None, "nerf"):
        pass
    assert ended == [True, True]


def test_process_that_does_not_listen_is_ended():
    # Blocked signals stand for a call into compiled code that does not return.
    script = """
import signal, time
from stages.time_limit import time_limit
signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGALRM})
with time_limit(0.1, "nerf", grace_s=0.2):
    time.sleep(60)
"""
    ended = subprocess.run(
        [sys.executable, "-c", script], cwd=PROJECT, capture_output=True, text=True, timeout=30
    )
    assert ended.returncode == 1 and "Timeout" in ended.stderr and "line 6" in ended.stderr


def test_stopped_stage_goes_on_from_its_checkpoint_and_tells_of_it(tmp_path):
    store, limits = Store(tmp_path), [0.3, None]

    def run(*, config, ctx) -> Text:
        step = int(saved[0]) if (saved := ctx.checkpoints.load()) else 0
        ctx.checkpoints.save(step + 1, {"x": torch.zeros(1)})
        if step == 0:
            spin()
        return Text(f"step {step}")

    def attempt(limit_s):
        options = {"config": StageConfig(), "device": torch.device("cpu"), "limit_s": limit_s}
        return run_stage(store, recipe("long"), Stage(run), {}, **options)

    with pytest.raises(StageTimeoutError, match="--timeout gives it longer"):
        attempt(limits[0])
    stored = attempt(limits[1])
    assert Text.load(stored.folder).value == "step 1"
    kinds = [event["kind"] for event in stored.manifest.record["events"]]
    assert kinds == ["timeout", "resumed"]
    assert store.check(stored.key).state == "ok"
