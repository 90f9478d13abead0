"""The queue on disk: restarts, orphans, time-outs, places, and what is removed."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from fake_run import QUICK, SLOW, STUBBORN
from fake_service import PATIENCE_S, command, png, send, wait_for

from flows.service import queue as queue_module
from flows.service.child import Child, kill_leftover
from flows.service.limits import Limits
from flows.service.queue import MAX_STARTS, JobQueue
from flows.service.records import Record
from stages.errors import InputError

HERE = Path(__file__).resolve().parent
PROJECT = HERE.parents[2]
# A service that is killed in the middle: it takes a slow job and a waiting one, and says their ids.
KILLED = """
import sys, time
from pathlib import Path
from fake_service import command
from flows.service.limits import Limits
from flows.service.queue import JobQueue
from flows.service.records import Record

home = Path(sys.argv[1])
queue = JobQueue(home, command, Limits(), slots=1)
def fill(seed):
    def write(job, folder):
        (folder / "photo.png").write_bytes(b"x")
        return Record(id=job, input="photo.png", preset="preview", seed=seed, created=time.time())
    return write
with queue:
    jobs = [queue.submit(fill(int(seed))).id for seed in sys.argv[2:]]
    while not (queue.folder(queue.get(jobs[0])) / "starts.txt").exists():
        time.sleep(0.01)
    print(*jobs, flush=True)
    time.sleep(60)
"""


def start_and_kill(home: Path, *seeds: int) -> list[str]:
    """Jobs of a service that was killed while the first was running."""
    path = os.pathsep.join([str(PROJECT), str(HERE)])
    words = [sys.executable, "-c", KILLED, str(home), *map(str, seeds)]
    service = subprocess.Popen(
        words, env=os.environ | {"PYTHONPATH": path}, stdout=subprocess.PIPE, text=True
    )
    jobs = service.stdout.readline().split()
    service.kill()
    service.wait()
    service.stdout.close()
    return jobs


def is_running(pid: int) -> bool:
    stat = Path(f"/proc/{pid}/stat")
    return stat.exists() and stat.read_text().rpartition(")")[2].split()[0] not in "ZX"


def test_a_killed_service_goes_on(home, serving):
    slow, waiting = start_and_kill(home, SLOW, QUICK)
    orphan = json.loads((home / "jobs" / slow / "job.json").read_text())["pid"]
    assert is_running(orphan)
    with serving(slots=1) as client:
        assert not is_running(orphan)
        view = wait_for(client, slow, "running")
        messages = [event["message"] for event in view["events"]]
        assert messages == [
            "queued",
            "started",
            "the service was started again",
            "started again (2)",
        ]
        assert client.get(f"/jobs/{waiting}").json()["state"] == "queued"
        # What was running is run again first, then comes what had waited.
        client.delete(f"/jobs/{slow}")
        wait_for(client, waiting, "done")


def test_a_stopped_service_stops_its_runs_and_resumes_them(home, serving):
    with serving() as client:
        job = send(client, SLOW)
        wait_for(client, job, "running")
        page = home / "jobs" / job / "job.json"
        pid = json.loads(page.read_text())["pid"]
    assert not is_running(pid)
    kept = json.loads(page.read_text())
    # A stop that was asked for does not count as a run that took the service down.
    assert (kept["state"], kept["starts"], kept["pid"]) == ("queued", 0, None)
    with serving() as client:
        wait_for(client, job, "running")


def test_a_run_that_takes_the_service_down_is_given_up(home, serving):
    (job,) = start_and_kill(home, SLOW)
    page = home / "jobs" / job / "job.json"
    page.write_text(json.dumps(json.loads(page.read_text()) | {"starts": MAX_STARTS}))
    with serving() as client:
        assert "together with the service" in wait_for(client, job, "failed")["error"]


def test_a_damaged_page_and_half_a_job_harm_nobody(home, serving, caplog):
    with serving() as client:
        job = send(client)
        wait_for(client, job, "done")
    (home / "jobs" / ("a" * 32)).mkdir()
    (home / "jobs" / "stray").mkdir()
    (home / "jobs" / "stray" / "job.json").write_text("{")
    (home / "incoming" / ("b" * 32)).mkdir()
    with serving() as client:
        assert client.get("/jobs").json()["total"] == 1
        assert client.get(f"/jobs/{job}/asset.glb").status_code == 200
    assert not list((home / "incoming").iterdir())
    assert len(caplog.records) == 2


def test_two_services_do_not_share_a_folder(home, serving):
    with serving(), pytest.raises(InputError, match="another service"), serving():
        pass


def test_a_folder_that_cannot_be_made_is_refused(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot be written"):
        JobQueue(tmp_path / "file" / "service", command, Limits(), slots=1).__enter__()


def test_slots_bound_what_runs(serving):
    with serving(slots=2) as client:
        jobs = [send(client, SLOW) for _ in range(3)]
        for job in jobs[:2]:
            wait_for(client, job, "running")
        health = client.get("/health").json()
        assert (health["running"], health["queued"]) == (2, 1)


def test_a_run_that_takes_too_long_is_stopped(serving):
    with serving(timeout_s=0.3) as client:
        view = wait_for(client, send(client, SLOW), "failed")
        assert view["error"].startswith("took longer than 0 s")
        assert "timed out" in [event["message"] for event in view["events"]]


def test_finished_jobs_are_removed_in_time(home, serving, monkeypatch):
    monkeypatch.setattr(queue_module, "TIDY_EVERY_S", 0.0)
    with serving(keep_s=0.5) as client:
        job = send(client)
        deadline = time.monotonic() + PATIENCE_S
        while client.get(f"/jobs/{job}").status_code == 200 and time.monotonic() < deadline:
            time.sleep(0.05)
        assert client.get("/jobs").json()["total"] == 0
        assert not list((home / "jobs").iterdir())


def test_a_full_queue_sends_callers_away(serving):
    with serving(queue=2) as client:
        running = send(client, SLOW)
        wait_for(client, running, "running")
        first = send(client)
        send(client)
        refused = client.post("/jobs", files={"picture": ("x", png())})
        assert refused.status_code == 503 and refused.json()["code"] == "queue_full"
        assert int(refused.headers["retry-after"]) > 0
        client.delete(f"/jobs/{first}")
        send(client)


def test_a_refused_upload_leaves_nothing(client, home):
    for _ in range(3):
        assert client.post("/jobs", files={"picture": ("x", b"text")}).status_code == 415
    assert not list((home / "incoming").iterdir()) and not list((home / "jobs").iterdir())
    assert client.get("/jobs").json()["total"] == 0


def test_one_run_at_a_time_per_job(tmp_path):
    """The lock is the child's: it is held while the child lives, whoever had started it."""
    record = Record(id="c" * 32, input="x", preset="preview", seed=STUBBORN, created=0.0)
    words = command(record, tmp_path)
    child = Child.start(words, tmp_path)
    assert child is not None and Child.start(words, tmp_path) is None
    kill_leftover(tmp_path, None)  # nobody knows its number: it is left alone
    assert child.exit_code() is None
    kill_leftover(tmp_path, child.pid)
    deadline = time.monotonic() + PATIENCE_S
    while (code := child.exit_code()) is None and time.monotonic() < deadline:
        time.sleep(0.01)
    assert code == -signal.SIGKILL
    # A number without a lock may long be somebody else's.
    kill_leftover(tmp_path, os.getpid())


def test_what_a_run_had_started_ends_with_it(tmp_path):
    script = (
        "import subprocess, sys; p = subprocess.Popen(['sleep', '60']); "
        "open('grandchild', 'w').write(str(p.pid))"
    )
    child = Child.start([sys.executable, "-S", "-c", script], tmp_path)
    deadline = time.monotonic() + PATIENCE_S
    while child.exit_code() is None and time.monotonic() < deadline:
        time.sleep(0.01)
    grandchild = int((tmp_path / "grandchild").read_text())
    while is_running(grandchild) and time.monotonic() < deadline:
        time.sleep(0.01)
    assert not is_running(grandchild)
