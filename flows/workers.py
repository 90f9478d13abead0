"""Worker processes that outlive their jobs and are replaced when they die over one.

A pool of the standard library breaks as a whole when one of its processes is killed (14 of 20
jobs lost); here the job alone is affected, and is tried once more by a fresh process. Each process
computes in its main thread, where a time limit can stop it, and none has threads that another's
fork could find half-way.
"""

import contextlib
import multiprocessing
import os
import queue
import signal
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from types import TracebackType
from typing import Any, Self

import cloudpickle

from flows.stopping import interrupt_on_stop

LOST = 1  # further tries of a job whose worker died
STOP_S = 30.0  # longer than a stage needs to notice and write nothing more
# A worker ends with this code if a stage does not listen to its time limit (faulthandler).
OVER_TIME = 1
THREAD_SETTINGS = ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "MKL_NUM_THREADS")


class WorkerLostError(RuntimeError):
    """Workers died over a job as often as it was tried; says how."""


class StoppedError(RuntimeError):
    """The workers were told to stop before the job was done."""


@dataclass(frozen=True)
class _Answer:
    """What a worker says: a value, or the exception that came instead."""

    value: Any = None
    error: Exception | None = None


class Workers:
    """A number of processes, each started when it is first needed.

    Args:
        count: how many.
        threads: that each computes with; what the environment says where that is None.
    """

    def __init__(self, count: int, threads: int | None = None) -> None:
        self._threads = threads
        self._idle: queue.Queue[_Worker | None] = queue.Queue()
        self._all: set[_Worker] = set()
        self._lock = threading.Lock()
        self._stopping = False
        for _ in range(count):
            self._idle.put(None)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.stop()

    def call(self, make: Callable[[int], Callable[[], Any]]) -> Any:
        """Run a function in the next free process; waits for one, and for the answer.

        Args:
            make: the function to run, given how many workers were lost over it so far.

        Raises:
            WorkerLostError: its processes died.
            StoppedError: `stop` was called.
            Exception: what the function raised.
        """
        worker = self._idle.get()
        try:
            for lost in range(LOST + 1):
                worker = self._alive(worker)
                try:
                    answer = worker.ask(make(lost))
                except (EOFError, OSError):
                    self._require_going()
                    code = worker.end()
                    if code == OVER_TIME or lost == LOST:
                        raise WorkerLostError(_obituary(code, lost + 1)) from None
                    continue
                if answer.error is not None:
                    self._require_going()
                    raise answer.error
                return answer.value
        finally:
            self._idle.put(worker)

    def _alive(self, worker: "_Worker | None") -> "_Worker":
        with self._lock:
            self._require_going()
            if worker is not None and worker.is_alive:
                return worker
            if worker is not None:
                self._all.discard(worker)
            fresh = _Worker(self._threads)
            self._all.add(fresh)
            return fresh

    def _require_going(self) -> None:
        if self._stopping:
            raise StoppedError("the batch was stopped")

    def stop(self) -> None:
        """Interrupt what runs, as Ctrl-C would, and end all processes."""
        with self._lock:
            self._stopping = True
            workers = list(self._all)
        for worker in workers:
            worker.interrupt()
        deadline = time.monotonic() + STOP_S
        for worker in workers:
            worker.end(max(0.0, deadline - time.monotonic()))


class _Worker:
    """This side of a process."""

    def __init__(self, threads: int | None) -> None:
        context = multiprocessing.get_context("spawn")  # a fork would share locks and sockets
        self._connection, other = context.Pipe()
        self._process = context.Process(target=_serve, args=(other, threads))
        # An interrupt while the process still imports would end in a traceback; it comes later.
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            self._process.start()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
        other.close()  # so that the end of the process is the end of the pipe

    @property
    def is_alive(self) -> bool:
        return self._process.is_alive()

    def ask(self, function: Callable[[], Any]) -> _Answer:
        self._connection.send_bytes(cloudpickle.dumps(function))
        answer: _Answer = cloudpickle.loads(self._connection.recv_bytes())
        return answer

    def interrupt(self) -> None:
        if self._process.pid is not None and self._process.is_alive():
            with contextlib.suppress(ProcessLookupError):
                os.kill(self._process.pid, signal.SIGINT)

    def end(self, patience_s: float = STOP_S) -> int | None:
        """Wait for the end of the process, in the end force it; returns its exit code."""
        self._process.join(patience_s)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()
        return self._process.exitcode


def _obituary(code: int | None, times: int) -> str:
    if code == OVER_TIME:
        return "the process that computed it ended with code 1, as by --timeout in the last resort"
    how = f"by signal {signal.Signals(-code).name}" if code and code < 0 else f"with code {code}"
    memory = "; is there enough memory?" if code == -signal.SIGKILL else ""
    return f"the process that computed it ended {how}, {times} times{memory}"


def _serve(connection: Connection, threads: int | None) -> None:
    """The other side: answer until the pipe or the parent ends, or an interrupt comes."""
    os.setsid()  # Ctrl-C is for the parent, which passes it on
    signal.signal(signal.SIGINT, signal.default_int_handler)
    interrupt_on_stop()
    if threads is not None:
        for name in THREAD_SETTINGS:  # before torch and numba are imported
            os.environ.setdefault(name, str(threads))
    threading.Thread(target=_follow_parent, daemon=True).start()
    try:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
        while True:
            function = cloudpickle.loads(connection.recv_bytes())
            try:
                answer = _Answer(function())
            except Exception as error:
                answer = _Answer(error=_portable(error))
            connection.send_bytes(cloudpickle.dumps(answer))
    except (EOFError, OSError, KeyboardInterrupt):
        return


def _portable(error: Exception) -> Exception:
    """An exception that arrives: not all can be pickled, and not all of those be made again."""
    try:
        cloudpickle.loads(cloudpickle.dumps(error))
    except Exception:
        return RuntimeError(f"{type(error).__name__}: {error}")
    return error


def _follow_parent() -> None:
    """However the parent ends, what is computed here would be computed for nobody."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(STOP_S)
        os._exit(OVER_TIME)
