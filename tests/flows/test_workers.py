"""Worker processes: answers and faults come back, the dead are replaced, none is left over."""

import os
import signal
import subprocess
import sys
import threading
import time
from functools import partial
from pathlib import Path

import pytest

from flows.workers import StoppedError, WorkerLostError, Workers

PROJECT = Path(__file__).resolve().parents[2]


def answer(lost: int):
    return partial(os.getpid)


def die(file: Path, times: int) -> int:
    """Kill this process as often as asked for, then say which one is left."""
    with file.open("a") as stream:
        stream.write("x")
    if file.stat().st_size <= times:
        os.kill(os.getpid(), signal.SIGKILL)
    return os.getpid()


class Awkward(Exception):
    """Cannot be made again from its arguments."""

    def __init__(self, one: int, two: int) -> None:
        super().__init__(f"{one} and {two}")


def refuse() -> None:
    raise Awkward(1, 2)


def wait_in(folder: Path) -> None:
    (folder / "pid").write_text(str(os.getpid()))
    time.sleep(60)


def wait_for(file: Path) -> str:
    deadline = time.monotonic() + 60
    while not (file.exists() and file.read_text()):
        assert time.monotonic() < deadline
        time.sleep(0.02)
    return file.read_text()


def is_gone(pid: int) -> bool:
    deadline = time.monotonic() + 30
    while time.monotonic() < deadline:
        stat = Path(f"/proc/{pid}/stat")
        if not stat.exists() or stat.read_text().rpartition(")")[2].split()[0] == "Z":
            return True
        time.sleep(0.05)
    return False


def test_processes_stay_are_replaced_and_end(tmp_path):
    with Workers(1, threads=1) as workers:
        first = workers.call(answer)
        assert first == workers.call(answer) != os.getpid()
        assert workers.call(lambda lost: partial(os.environ.get, "OMP_NUM_THREADS")) is not None
        with pytest.raises(RuntimeError, match="Awkward: 1 and 2"):
            workers.call(lambda lost: refuse)
        lost_before = []

        def once(lost: int):
            lost_before.append(lost)
            return partial(die, tmp_path / "once", 1)

        second = workers.call(once)
        assert second != first and lost_before == [0, 1]
        with pytest.raises(WorkerLostError, match=r"by signal SIGKILL, 2 times; is there enough"):
            workers.call(lambda lost: partial(die, tmp_path / "always", 9))
        third = workers.call(answer)
    assert is_gone(first) and is_gone(second) and is_gone(third)


def test_stop_interrupts_what_runs(tmp_path):
    workers, caught = Workers(2, threads=1), []

    def wait() -> None:
        try:
            workers.call(lambda lost: partial(wait_in, tmp_path))
        except StoppedError as error:
            caught.append(error)

    thread = threading.Thread(target=wait)
    thread.start()
    pid = int(wait_for(tmp_path / "pid"))
    workers.stop()
    thread.join(30)
    assert len(caught) == 1 and is_gone(pid)
    with pytest.raises(StoppedError):
        workers.call(answer)


def test_workers_follow_a_killed_parent(tmp_path):
    script = f"""
import sys
sys.path[:0] = {[str(PROJECT), str(Path(__file__).parent)]!r}
from functools import partial
from pathlib import Path
import test_workers
from flows.workers import Workers
if __name__ == "__main__":
    Workers(1, 1).call(lambda lost: partial(test_workers.wait_in, Path({str(tmp_path)!r})))
"""
    (tmp_path / "parent.py").write_text(script)
    parent = subprocess.Popen([sys.executable, str(tmp_path / "parent.py")])
    pid = int(wait_for(tmp_path / "pid"))
    parent.kill()
    parent.wait()
    assert is_gone(pid)
