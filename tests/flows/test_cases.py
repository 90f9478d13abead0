"""Processes of cases: results come back, those that linger or die are told of, none outlives."""

import os
import time

import pytest

from flows.cases import CaseProcess, Outcome, run_cases

MODULE = """
import json, os, sys, time
from pathlib import Path
request = json.loads(Path(sys.argv[1]).read_text())
Path(request["pids"]).joinpath(str(os.getpid())).touch()
time.sleep(request["sleeps_s"])
if request["dies"]:
    sys.exit("out of luck")
assert not list(Path(request["work"]).glob("left*"))
Path(request["out"]).write_text(json.dumps({"outcome": "asset", "number": request["number"]}))
"""


@pytest.fixture
def start(tmp_path, monkeypatch):
    (tmp_path / "tiny_case_module.py").write_text(MODULE)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))

    def starter(sleeps_s=0.0, dies=False, limit_s=30.0):
        return lambda number: CaseProcess(
            "tiny_case_module",
            {"number": number, "sleeps_s": sleeps_s, "dies": dies, "pids": str(tmp_path)},
            limit_s,
        )

    return starter


def test_all_cases_are_run_however_many_at_a_time(start):
    found = dict(run_cases([3, 1, 2], start(), jobs=2))
    assert found == {n: {"outcome": "asset", "number": n} for n in (1, 2, 3)}


def test_what_dies_says_why(start):
    ((_, found),) = run_cases([0], start(dies=True))
    assert found["outcome"] == Outcome.CRASHED and "out of luck" in found["error"]


def test_what_lingers_is_ended(start):
    ((_, found),) = run_cases([0], start(sleeps_s=60.0, limit_s=0.5))
    assert found == {"outcome": Outcome.TOO_LONG, "error": "more than 0.5 s"}


def test_nothing_runs_on_where_the_caller_stops(start, tmp_path):
    # The second case would take a minute; it is ended with the loop.
    def begin(number):
        return start(sleeps_s=60.0 * number)(number)

    running = run_cases([0, 1], begin, jobs=2)
    next(running)
    deadline = time.monotonic() + 20.0
    while len(pids := [p.name for p in tmp_path.iterdir() if p.name.isdigit()]) < 2:
        assert time.monotonic() < deadline
        time.sleep(0.05)
    running.close()
    for pid in pids:
        with pytest.raises(ProcessLookupError):
            os.kill(int(pid), 0)
