"""Cases of a suite: each in a process of its own, its result a line in a file that outlives it."""

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from stages.keys import digest_json

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

    CaseT = TypeVar("CaseT", bound=DataclassInstance)
else:
    CaseT = TypeVar("CaseT")

RESULTS = "results.jsonl"
LAST_LINES = 3  # of what a crashed process said
POLL_S = 0.05  # between two looks at the processes that run


class Outcome(StrEnum):
    """How the process of a case ended."""

    ASSET = "asset"
    REFUSED = "refused"  # with an error that says what was wanted, what came, what to do
    CRASHED = "crashed"
    TOO_LONG = "too long"


class Results(Generic[CaseT]):
    """A line of JSON for each case that was run; a killed suite goes on where it was.

    Args:
        folder: of `results.jsonl`, made if it is not there.
        any_code: whether results of other code and settings are taken, too.
    """

    def __init__(self, folder: Path, *, any_code: bool = False) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._file = folder / RESULTS
        self._any_code = any_code
        self._known: dict[str, dict[str, Any]] = {}
        for line in self._lines():
            self._known[line["key"]] = line
            if any_code:
                self._known[digest_json(line["case"])] = line

    def _lines(self) -> Iterable[dict[str, Any]]:
        if not self._file.exists():
            return
        for line in self._file.read_text().splitlines():
            try:
                page = json.loads(line)
            except json.JSONDecodeError:
                continue  # cut off when the suite was killed
            if isinstance(page, dict) and {"key", "case"} <= page.keys():
                yield page

    def get(self, case: CaseT, key: str) -> dict[str, Any] | None:
        """What is known of a case."""
        other = self._known.get(digest_json(asdict(case))) if self._any_code else None
        return self._known.get(key, other)

    def put(self, case: CaseT, key: str, result: Mapping[str, Any]) -> dict[str, Any]:
        """Keep a result."""
        line = {"key": key, "case": asdict(case), **result}
        self._known[key] = line
        with self._file.open("a") as stream:
            # Begun anew, in case the last line was cut.
            stream.write("\n" + json.dumps(line) + "\n")
        return line


class CaseProcess:
    """A process that carries out a request, and writes its result where that says.

    Args:
        module: run with the file of the request.
        request: what the module reads; `work`, an empty folder, and `out`, the file of the result,
            are added.
        limit_s: seconds after which the process is ended.
    """

    def __init__(self, module: str, request: Mapping[str, Any], limit_s: float) -> None:
        self._work = tempfile.TemporaryDirectory(prefix="svim3d-case-")
        folder = Path(self._work.name)
        self._out, self._said = folder / "result.json", folder / "said.txt"
        page = {**request, "work": str(folder), "out": str(self._out)}
        (folder / "request.json").write_text(json.dumps(page))
        root = Path(__file__).resolve().parents[1]
        path = os.pathsep.join([str(root), os.environ.get("PYTHONPATH", "")])
        self._limit_s, self._start = limit_s, time.monotonic()
        with self._said.open("w") as said:
            self._process = subprocess.Popen(
                [sys.executable, "-m", module, str(folder / "request.json")],
                env=os.environ | {"PYTHONPATH": path},
                stdout=subprocess.DEVNULL,
                stderr=said,
            )

    def result(self) -> dict[str, Any] | None:
        """What it left, or how it ended if it left nothing; None while it runs."""
        code = self._process.poll()
        if code is None:
            if time.monotonic() - self._start < self._limit_s:
                return None
            self.end()
            return {"outcome": Outcome.TOO_LONG, "error": f"more than {self._limit_s:g} s"}
        try:
            if self._out.exists():
                found: dict[str, Any] = json.loads(self._out.read_text())
                return found
            said = " / ".join(self._said.read_text().strip().splitlines()[-LAST_LINES:])
            return {"outcome": Outcome.CRASHED, "error": f"ended with {code}: {said}"}
        finally:
            self.end()

    def end(self) -> None:
        """Stop it, if need be, and clean up."""
        self._process.kill()
        self._process.wait()
        self._work.cleanup()


def outcome_of(process: CaseProcess) -> dict[str, Any]:
    """Wait for a process; it does not run on where the caller stops."""
    try:
        while (result := process.result()) is None:
            time.sleep(POLL_S)
        return result
    finally:
        process.end()


def run_cases(
    cases: Sequence[CaseT], start: Callable[[CaseT], CaseProcess], jobs: int = 1
) -> Iterator[tuple[CaseT, dict[str, Any]]]:
    """Results of cases as they end, `jobs` at a time; none runs on where the caller stops."""
    waiting, running = list(cases), dict[int, tuple[CaseT, CaseProcess]]()
    number = 0
    try:
        while waiting or running:
            while waiting and len(running) < jobs:
                case = waiting.pop(0)
                running[number] = case, start(case)
                number += 1
            for at, (case, process) in list(running.items()):
                result = process.result()
                if result is not None:
                    del running[at]
                    yield case, result
            time.sleep(POLL_S)
    finally:
        for _, process in running.values():
            process.end()
