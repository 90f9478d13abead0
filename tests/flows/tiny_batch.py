"""`svim3d batch` over the tiny pipeline, in this process or as one of its own."""

import csv
import os
import signal
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from unittest import mock

from tiny_pipeline import TINY, TinyConfig

from flows import batch, batch_inputs, cli

HERE = Path(__file__).resolve().parent
PROJECT = HERE.parents[1]
TINY_FILES = replace(TINY, takes=(".txt",))


def main(arguments: Sequence[object]) -> int:
    """Exit code of the command."""
    with (
        mock.patch.object(batch, "IMAGE_TO_ASSET", TINY_FILES),
        mock.patch.object(batch, "PipelineConfig", TinyConfig),
        mock.patch.object(batch_inputs, "PipelineConfig", TinyConfig),
    ):
        return cli.main(["batch", *map(str, arguments)])


def start(arguments: Sequence[object]) -> subprocess.Popen[str]:
    """The command as a process."""
    return subprocess.Popen(
        [sys.executable, str(Path(__file__)), *map(str, arguments)],
        cwd=HERE,
        env=os.environ | {"PYTHONPATH": f"{PROJECT}{os.pathsep}{HERE}"},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def rows(out: Path) -> dict[str, dict[str, str]]:
    """The table of results by name."""
    with (out / "results.csv").open(newline="") as stream:
        return {row["name"]: row for row in csv.DictReader(stream)}


def states(out: Path) -> dict[str, str]:
    return {name: row["state"] for name, row in rows(out).items()}


if __name__ == "__main__":
    # A shell starts background jobs with interrupts ignored, and children inherit that.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    sys.exit(main(sys.argv[1:]))
