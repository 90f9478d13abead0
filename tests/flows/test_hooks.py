"""Whoever asked is told how a run ended, and whatever becomes of that does not touch the run."""

import http.server
import json
import os
import threading
import time
from pathlib import Path

import pytest
from tiny_job import carry_out, gone_process, page

from flows import cli, hooks
from flows.hooks import Hooks, announce_death
from flows.run_records import CANCELLED, DONE, FAILED, RUNNING, RunIndex
from stages.errors import InputError


@pytest.fixture
def told(tmp_path, monkeypatch):
    """Hooks that keep what they are given: `told("on_end")` sets one, `told()` reads it."""
    file = tmp_path / "told"

    def tell(name: str | None = None) -> dict | None:
        if name is None:
            return json.loads(file.read_text()) if file.exists() else None
        monkeypatch.setenv(f"SVIM3D_{name.upper()}", f"cat > {file}")
        return None

    return tell


def log_of(store) -> str:
    index = RunIndex(store.root)
    return index.log(index.records()[0].id).read_text()


def test_failure_is_told_with_what_there_is_to_know(store, source, tmp_path, told):
    told("on_failure")
    record = carry_out(store, source, tmp_path / "out", "walk.fault=defect")
    assert told() == {
        "run": record.id,
        "asset": "digits",
        "preset": "standard",
        "pipeline": "tiny",
        "state": FAILED,
        "stage": "walk",
        "error": "RuntimeError: a defect",
        "input": str(source),
        "folder": str(tmp_path / "out"),
        "host": record.process.host,
        "started": time.strftime("%Y-%m-%dT%H:%M:%S%z", time.localtime(record.started)),
        "seconds": round(record.duration_s, 1),
    }


def test_only_failures_are_told_as_failures_and_every_end_as_an_end(
    store, source, tmp_path, told, monkeypatch
):
    def interrupt(plan, job):
        raise KeyboardInterrupt

    told("on_failure")
    carry_out(store, source, tmp_path / "out")
    assert told() is None
    carry_out(store, source, tmp_path / "out", "walk.steps=3", compute=interrupt)
    assert told()["state"] == CANCELLED
    monkeypatch.delenv("SVIM3D_ON_FAILURE")
    told("on_end")
    carry_out(store, source, tmp_path / "out")
    assert told()["state"] == DONE


def test_command_finds_it_in_its_environment_but_no_hooks_of_its_own(
    store, source, tmp_path, monkeypatch
):
    file = tmp_path / "environment"
    monkeypatch.setenv("SVIM3D_ON_END", f"env -0 > {file}")
    record = carry_out(store, source, tmp_path / "out")
    lines = dict(line.split("=", 1) for line in file.read_text().split("\0") if line)
    assert lines["SVIM3D_RUN"] == record.id and lines["SVIM3D_STATE"] == DONE
    assert lines["SVIM3D_FOLDER"] == str(tmp_path / "out") and lines["PATH"] == os.environ["PATH"]
    assert "SVIM3D_ON_END" not in lines
    assert "the hook SVIM3D_ON_END was told" in log_of(store)


class Listener(http.server.BaseHTTPRequestHandler):
    """Answers by the path, and keeps what it is sent."""

    received: list[tuple[str, dict]]

    def do_POST(self):
        body = self.rfile.read(int(self.headers["Content-Length"]))
        self.received.append((self.path, json.loads(body)))
        self.send_response({"/well": 204, "/elsewhere": 307}.get(self.path, 500))
        self.send_header("Location", "/well")
        self.send_header("Content-Length", "0")
        self.end_headers()

    def log_message(self, *_):
        pass


@pytest.fixture
def server(monkeypatch):
    monkeypatch.setattr(Listener, "received", [], raising=False)
    listening = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Listener)
    threading.Thread(target=listening.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{listening.server_port}"
    listening.shutdown()
    listening.server_close()


def test_url_is_posted_to(store, source, tmp_path, server, monkeypatch):
    monkeypatch.setenv("SVIM3D_ON_FAILURE", f"{server}/well")
    record = carry_out(store, source, tmp_path / "out", "walk.fault=defect")
    [(path, report)] = Listener.received
    assert path == "/well" and (report["run"], report["stage"]) == (record.id, "walk")


@pytest.mark.parametrize(
    ("hook", "complaint"),
    [
        ("echo no such channel; exit 3", "exit code 3: no such channel"),
        ("sleep 60", "stopped after 0.5 s"),
        ("URL/broken", "HTTP Error 500"),
        ("URL/elsewhere", "HTTP Error 307"),  # redirections are not followed
        ("http://127.0.0.1:9/", "refused"),
    ],
)
def test_hook_that_fails_is_a_warning(
    store, source, tmp_path, server, monkeypatch, hook, complaint
):
    monkeypatch.setattr(hooks, "TIMEOUT_S", 0.5 if "sleep" in hook else 10.0)
    monkeypatch.setenv("SVIM3D_ON_END", hook.replace("URL", server))
    start = time.monotonic()
    record = carry_out(store, source, tmp_path / "out")
    assert record.state == DONE and time.monotonic() - start < 30.0
    log = log_of(store)
    assert "WARNING" in log and "the hook SVIM3D_ON_END did not work: " in log and complaint in log
    assert (tmp_path / "out" / "run.log").read_text() == log
    assert len(Listener.received) == (hook in ("URL/broken", "URL/elsewhere"))


def test_what_a_hook_leaves_in_the_background_holds_nobody_up(store, source, tmp_path, monkeypatch):
    monkeypatch.setenv("SVIM3D_ON_END", "sleep 30 & echo started")
    start = time.monotonic()
    carry_out(store, source, tmp_path / "out")
    assert time.monotonic() - start < 25.0 and "and said: started" in log_of(store)


@pytest.mark.parametrize("url", ["file:///etc/passwd", "ftp://host/x", "gopher://host"])
def test_other_kinds_of_url_are_refused_before_anything_is_done(
    store, source, tmp_path, monkeypatch, url
):
    monkeypatch.setenv("SVIM3D_ON_FAILURE", url)
    with pytest.raises(InputError, match="SVIM3D_ON_FAILURE: wanted a command or a URL of http"):
        Hooks.of_environment()
    with pytest.raises(IndexError):  # there is no page
        carry_out(store, source, tmp_path / "out")
    assert store.keys() == []


def test_options_set_what_is_handed_on(tmp_path, monkeypatch):
    for name in ("SVIM3D_ON_FAILURE", "SVIM3D_ON_END"):
        monkeypatch.setenv(name, "an older one")
    given = ["--on-failure", "mail me", "--store", str(tmp_path), "-o", str(tmp_path / "out")]
    assert cli.main(["run", str(tmp_path / "missing.png"), *given]) == cli.BAD_INPUT
    assert Hooks.of_environment() == Hooks("mail me", "an older one")


def test_death_is_told_by_who_sees_it(store, told):
    store.root.mkdir()
    index = RunIndex(store.root)
    told("on_failure")
    index.write(page(1))
    announce_death(index, Path("/out/cat1"), "killed")  # it was done
    assert told() is None
    index.write(page(2, folder="/out/cat1", state=RUNNING, ended=None, process=gone_process()))
    announce_death(index, Path("/out/cat1"), "killed")
    assert (told()["run"], told()["state"], told()["error"]) == (page(2).id, "died", "killed")
