"""The `svim3d` command over the tiny pipeline, in this process or as one of its own."""

import os
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from unittest import mock

from tiny_pipeline import TINY, TinyConfig

from flows import cli, commands

HERE = Path(__file__).resolve().parent
PROJECT = HERE.parents[1]


def main(arguments: Sequence[str]) -> int:
    """Exit code of the command."""
    with (
        mock.patch.object(commands, "IMAGE_TO_ASSET", TINY),
        mock.patch.object(commands, "PipelineConfig", TinyConfig),
    ):
        return cli.main(arguments)


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


if __name__ == "__main__":
    # A shell starts background jobs with interrupts ignored, and children inherit that.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    code = main(sys.argv[1:])
    loaded = sorted({"torch", "prefect"} & set(sys.modules))
    print(f"loaded: {' '.join(loaded) or 'nothing'}")
    sys.exit(code)
