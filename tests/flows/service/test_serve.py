"""The command, and what the gate does to a request that never ends."""

import asyncio
import importlib.util
import itertools

import pytest
from fake_service import command

from flows import cli
from flows.serve_options import serve_options
from flows.service.api import make_app
from flows.service.limits import Limits
from flows.service.queue import JobQueue


def test_without_the_extra_the_command_says_what_to_install(monkeypatch, capsys):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    assert cli.main(["serve", "--http"]) == cli.BAD_INPUT
    assert "pip install 'svim3d[http]'" in capsys.readouterr().err


@pytest.mark.parametrize(
    "given",
    [["--jobs", "0"], ["--http", "--port", "65536"], ["--http", "--keep-h", "nan"]],
)
def test_options_are_checked(given, capsys):
    with pytest.raises(SystemExit) as stopped:
        cli.main(["serve", *given])
    assert stopped.value.code == cli.BAD_INPUT


def test_defaults_are_those_of_the_limits():
    options, limits = serve_options().parse_args(["--http"]), Limits()
    assert options.max_upload_mib * 2**20 == limits.upload_bytes
    assert options.timeout_h * 3600 == limits.timeout_s
    assert options.keep_h * 3600 == limits.keep_s
    assert options.queue == limits.queue


def test_a_request_that_never_ends_is_given_up(tmp_path):
    """A caller that sends a byte now and then would hold a place in the queue for ever."""
    queue = JobQueue(tmp_path, command, Limits(upload_s=0.2, queue=1), slots=1)
    app = make_app(queue, tmp_path)
    sent = []
    head = b'--x\r\nContent-Disposition: form-data; name="picture"; filename="a"\r\n\r\n'
    pieces = itertools.chain([head], itertools.repeat(b"x"))

    async def receive():
        await asyncio.sleep(0.05)
        return {"type": "http.request", "body": next(pieces), "more_body": True}

    async def send(message):
        sent.append(message)

    scope = {
        "type": "http",
        "method": "POST",
        "path": "/jobs",
        "query_string": b"",
        "headers": [(b"content-type", b"multipart/form-data; boundary=x")],
    }
    asyncio.run(app(scope, receive, send))
    assert sent[0]["status"] == 408 and b"upload_too_slow" in sent[1]["body"]
    with queue.place():  # it is free again
        pass
