"""A limit to the time that a block of code may take.

Two bounds. The first raises an exception in the block's own thread, between two bytecodes: it
leaves a resumable state and can be recorded, but a single call into compiled code ends first (a
15 s SVD under a limit of 2 s: 15 s). The second, a grace period later, ends the process, whatever
it is in; what was checkpointed is there for the next run, as after a kill.
"""

import contextlib
import ctypes
import faulthandler
import signal
import sys
import threading
from collections.abc import Iterator
from types import FrameType

from stages.errors import StageTimeoutError

GRACE_S = 60.0  # longer than our longest call into compiled code, and than writing a checkpoint
# An exception raised inside a finaliser is swallowed there, so that one may not be enough.
AGAIN_S = 5.0


@contextlib.contextmanager
def time_limit(limit_s: float | None, what: str, *, grace_s: float = GRACE_S) -> Iterator[None]:
    """Stop the block after `limit_s` seconds; no limit where that is None.

    Args:
        limit_s: seconds until the exception is raised.
        what: is limited, for the message.
        grace_s: seconds from then until the process ends with code 1; in the main thread only.

    Raises:
        StageTimeoutError: inside the block, when the time is over.
    """
    if limit_s is None:
        yield
        return
    message = (
        f"{what} was stopped after its {limit_s:g} s; the same command goes on from what it has "
        "kept, --timeout gives it longer"
    )
    is_main = threading.current_thread() is threading.main_thread()
    alarm = _alarm(limit_s, message, grace_s) if is_main else _timer(limit_s)
    try:
        with alarm:
            yield
    except StageTimeoutError as error:
        # Raised from outside of a thread it comes without words.
        raise StageTimeoutError(message) from error


@contextlib.contextmanager
def _alarm(limit_s: float, message: str, grace_s: float) -> Iterator[None]:
    """The kernel's timer, whose handler runs in the main thread; and a watch over that thread."""

    def stop(signal_number: int, frame: FrameType | None) -> None:
        raise StageTimeoutError(message)

    earlier = signal.signal(signal.SIGALRM, stop)
    if (errors := sys.__stderr__) is not None:
        faulthandler.dump_traceback_later(limit_s + grace_s, exit=True, file=errors)
    signal.setitimer(signal.ITIMER_REAL, limit_s, AGAIN_S)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, earlier)
        faulthandler.cancel_dump_traceback_later()


@contextlib.contextmanager
def _timer(limit_s: float) -> Iterator[None]:
    """A thread that raises the exception in this one, which is not the main thread."""
    target = ctypes.c_ulong(threading.get_ident())
    over = threading.Event()
    lock = threading.Lock()

    def watch() -> None:
        pause_s = limit_s
        while not over.wait(pause_s):
            with lock:  # once the block is over nothing may be raised any more
                if not over.is_set():
                    ctypes.pythonapi.PyThreadState_SetAsyncExc(
                        target, ctypes.py_object(StageTimeoutError)
                    )
            pause_s = AGAIN_S

    watcher = threading.Thread(target=watch, daemon=True)
    watcher.start()
    try:
        yield
    finally:
        with lock:
            over.set()
            # One that was asked for and has not come yet would come after the block.
            ctypes.pythonapi.PyThreadState_SetAsyncExc(target, None)
