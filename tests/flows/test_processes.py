"""A process is known again, and told from others that come to have its number."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

from flows import processes
from flows.processes import Process

SCRIPT = """
import json
from dataclasses import asdict
from flows.processes import Process

print(json.dumps(asdict(Process.this())), flush=True)
input()
"""


def test_process_lives_until_it_is_killed_even_if_nobody_collects_it():
    child = subprocess.Popen(
        [sys.executable, "-c", SCRIPT],
        cwd=Path(__file__).resolve().parents[2],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    process = Process(**json.loads(child.stdout.readline()))
    assert process.pid == child.pid and process.is_alive() is True
    child.kill()
    # Its remains stay until the parent asks: a zombie with the same number and start.
    while (stat := (processes.PROC / str(child.pid) / "stat").read_text()).split()[2] != "Z":
        assert stat
    assert process.is_alive() is False
    child.communicate()
    assert process.is_alive() is False


def test_number_that_another_process_has_now_is_not_the_same_process():
    this = Process.this()
    assert this.is_alive() is True
    assert replace(this, started=f"{int(this.started) - 1}").is_alive() is False


def test_rebooted_machine_has_no_old_processes_and_others_cannot_be_asked():
    this = Process.this()
    assert replace(this, boot="before").is_alive() is False
    assert replace(this, boot="before", host="elsewhere").is_alive() is None
    assert replace(this, namespace="pid:[1]").is_alive() is None


def test_without_proc_the_number_must_do(monkeypatch, tmp_path):
    monkeypatch.setattr(processes, "PROC", tmp_path)
    this = Process.this()
    assert (this.boot, this.started) == ("", "")
    assert this.is_alive() is True
    assert replace(this, pid=2**22 + 1).is_alive() is False
