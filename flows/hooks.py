"""Word of a run's end for whoever asked for it: a command that is run, or a URL that is posted to.

Two variables of the environment name them, so that whatever carries a run out, a worker of a batch,
a job of the service, a deployment, finds them where it is; `--on-failure` and `--on-end` set them
for a command and all that it starts. A hook has no effect on the run but a warning in its log.

Only a process that lives can tell. A killed one is told of by whoever sees it die (a batch whose
worker was killed), or by `svim3d status --failed`, asked from time to time.
"""

import json
import logging
import os
import re
import signal
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

from flows.operator_options import ON_END, ON_FAILURE
from flows.run_records import DIED, DONE, RunIndex, RunRecord
from stages.errors import InputError

log = logging.getLogger(__name__)

PREFIX = "SVIM3D_"  # of the variables that a command gets
TIMEOUT_S = 10.0
SHOWN_OUTPUT = 500  # characters of what a command prints
SCHEME = re.compile(r"([A-Za-z][A-Za-z0-9+.-]*)://")


@dataclass(frozen=True)
class Hooks:
    """Whom to tell.

    Attributes:
        on_failure: command or URL, for runs that failed, were cancelled or died; empty for none.
        on_end: the same for every run.
    """

    on_failure: str = ""
    on_end: str = ""

    @classmethod
    def of_environment(cls) -> Self:
        """Those that the environment names.

        Raises:
            InputError: a URL is of a kind that is not posted to.
        """
        hooks = cls(os.environ.get(ON_FAILURE, ""), os.environ.get(ON_END, ""))
        for name, hook in ((ON_FAILURE, hooks.on_failure), (ON_END, hooks.on_end)):
            scheme = SCHEME.match(hook)
            if scheme and scheme[1].lower() not in ("http", "https"):
                raise InputError(
                    f"{name}: wanted a command or a URL of http or https, got {scheme[0]}...; "
                    "correct the variable or the option that sets it"
                )
        return hooks

    def announce(self, record: RunRecord) -> None:
        """Tell that a run has ended; what goes wrong is logged, not raised."""
        is_failure = record.state != DONE
        for name, hook in (
            (ON_FAILURE, self.on_failure if is_failure else ""),
            (ON_END, self.on_end),
        ):
            if not hook:
                continue
            try:
                said = _deliver(hook, report_of(record))
            except Exception as error:
                # The hook itself may hold a secret and stays out of the log.
                log.warning("the hook %s did not work: %s", name, error)
            else:
                log.info("the hook %s was told%s", name, f" and said: {said}" if said else "")


def announce_death(index: RunIndex, folder: Path, error: str) -> None:
    """Tell of a run whose process is gone before it could tell so itself."""
    place = str(folder.resolve())
    for record in index.records():
        if record.folder == place:
            if record.now == DIED:
                died = replace(record, state=DIED, error=error, ended=record.changed)
                Hooks.of_environment().announce(died)
            return


def report_of(record: RunRecord) -> dict[str, Any]:
    """What a hook is told of a run."""
    return {
        "run": record.id,
        "asset": record.asset,
        "preset": record.preset,
        "pipeline": record.pipeline,
        "state": record.state,
        "stage": record.stage,
        "error": record.error,
        "input": record.source,
        "folder": record.folder,
        "host": record.process.host,
        "started": time.strftime("%Y-%m-%dT%H:%M:%S%z", time.localtime(record.started)),
        "seconds": round(record.duration_s, 1),
    }


def _deliver(hook: str, report: Mapping[str, Any]) -> str:
    """Run a command or post to a URL; what the command printed.

    Raises:
        Exception: the command failed, the server refused, or either took too long.
    """
    body = json.dumps(report).encode()
    if SCHEME.match(hook):
        _within(TIMEOUT_S, lambda: _post(hook, body))
        return ""
    return _run(hook, body, report)


def _post(url: str, body: bytes) -> None:
    from urllib import request as http  # 30 ms that most runs need not spend

    opener = http.OpenerDirector()
    # These and no others: no redirection, no file, no FTP.
    opener.add_handler(http.ProxyHandler())
    opener.add_handler(http.HTTPHandler())
    opener.add_handler(http.HTTPSHandler())
    opener.add_handler(http.HTTPErrorProcessor())
    opener.add_handler(http.HTTPDefaultErrorHandler())
    head = {"Content-Type": "application/json", "User-Agent": "svim3d"}
    request = http.Request(url, body, head, method="POST")
    with opener.open(request, timeout=TIMEOUT_S):
        pass


def _within(limit_s: float, work: Callable[[], None]) -> None:
    """Wait for a piece of work no longer than a time.

    The time-out of a socket starts anew with each byte, and looking up a name has none.
    """
    faults: list[Exception] = []

    def do() -> None:
        try:
            work()
        except Exception as error:
            faults.append(error)

    thread = threading.Thread(target=do, daemon=True)
    thread.start()
    thread.join(limit_s)
    if thread.is_alive():
        raise TimeoutError(f"no answer within {limit_s:g} s")
    if faults:
        raise faults[0]


def _run(command: str, body: bytes, report: Mapping[str, Any]) -> str:
    """Run a command of the shell with a report as its input and in its environment."""
    # A hook that runs svim3d must not be its own hook.
    inherited = {k: v for k, v in os.environ.items() if k not in (ON_FAILURE, ON_END)}
    told = {PREFIX + name.upper(): str(value).replace("\0", "") for name, value in report.items()}
    # Files instead of pipes: what a command leaves in the background holds nobody up.
    with tempfile.TemporaryFile() as given, tempfile.TemporaryFile() as printed:
        given.write(body)
        given.seek(0)
        process = subprocess.Popen(
            ["/bin/sh", "-c", command],
            stdin=given,
            stdout=printed,
            stderr=printed,
            env=inherited | told,
            start_new_session=True,
        )
        try:
            code = process.wait(TIMEOUT_S)
        except BaseException as error:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            if isinstance(error, subprocess.TimeoutExpired):
                raise TimeoutError(f"stopped after {TIMEOUT_S:g} s") from None
            raise
        printed.seek(0)
        said = " ".join(printed.read(1 << 16).decode(errors="replace").split())[-SHOWN_OUTPUT:]
    if code != 0:
        raise RuntimeError(f"exit code {code}{': ' if said else ''}{said}")
    return said
