"""A case of a suite in a process of its own, and how it ended."""

import os
import subprocess
from collections.abc import Sequence
from enum import StrEnum
from pathlib import Path
from typing import Any

LAST_LINES = 3  # of what a crashed process said


class Outcome(StrEnum):
    """How the process of a case ended."""

    ASSET = "asset"
    REFUSED = "refused"  # with an error that says what was wanted, what came, what to do
    CRASHED = "crashed"
    TOO_LONG = "too long"


def ended(command: Sequence[str], limit_s: float) -> dict[str, Any]:
    """Run a command; how it ended if it leaves no result."""
    root = Path(__file__).resolve().parents[1]
    path = os.pathsep.join([str(root), os.environ.get("PYTHONPATH", "")])
    try:
        done = subprocess.run(
            command,
            env=os.environ | {"PYTHONPATH": path},
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            timeout=limit_s,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return {"outcome": Outcome.TOO_LONG, "error": f"more than {limit_s:g} s"}
    said = " / ".join(done.stderr.strip().splitlines()[-LAST_LINES:])
    return {"outcome": Outcome.CRASHED, "error": f"ended with {done.returncode}: {said}"}
