"""What Prefect costs a run: start of the engine, and its share of a flow of seven cached tasks.

Each case runs in a process of its own; medians of `--repeats` runs, wall and CPU seconds (the
server's included). "Prefect's own" is the temporary server that Prefect starts when it is left
alone.
"""

import argparse
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

PROJECT = Path(__file__).resolve().parents[1]

FLOW = """
from prefect import flow, task
from prefect.settings import PREFECT_FLOWS_HEARTBEAT_FREQUENCY, temporary_settings

@task(persist_result=False)
def one(i):
    return i

@flow(persist_result=False)
def seven():
    for i in range(7):
        one(i)
"""
OURS = f"""
import sys, pathlib
from flows.engine import Engine
with Engine(pathlib.Path(sys.argv[1])) as engine:
    import torch
    {FLOW.replace(chr(10), chr(10) + "    ")}
    engine.wait()
    with temporary_settings({{PREFECT_FLOWS_HEARTBEAT_FREQUENCY: None}}):
        seven()
"""
PREFECTS_OWN = f"""
import os, pathlib, sys
from flows.engine import PRIVATE, SETTINGS
home = pathlib.Path(sys.argv[1])
home.mkdir(parents=True, exist_ok=True)
os.environ.update(SETTINGS | PRIVATE, PREFECT_HOME=str(home))
os.environ["PREFECT_SERVER_EPHEMERAL_STARTUP_TIMEOUT_SECONDS"] = "120"
import torch
{FLOW}
with temporary_settings({{PREFECT_FLOWS_HEARTBEAT_FREQUENCY: None}}):
    seven()
"""
IMPORT_ONLY = "import torch, prefect, prefect.flows"


def main() -> None:
    """Print one table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=5)
    repeats = parser.parse_args().repeats
    print(f"{'case':<42} {'wall s':>7} {'CPU s':>7}   n={repeats}")
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        cases = (
            ("imports alone (torch, prefect)", IMPORT_ONLY, "none", "seeds"),
            ("first run on a machine (migrations)", OURS, "cold", "seeds-cold"),
            ("first run in a project (seeded)", OURS, "seeded", "seeds"),
            ("later runs", OURS, None, "seeds"),
            ("later runs, Prefect's own server", PREFECTS_OWN, None, "seeds"),
        )
        _measure(OURS, root / "warm", root / "seeds")
        for name, script, home, seeds in cases:
            runs = [
                _measure(
                    script,
                    root / (f"{home}-{i}" if home else "warm"),
                    root / (f"{seeds}-{i}" if home == "cold" else seeds),
                )
                for i in range(repeats)
            ]
            wall, cpu = (statistics.median(values) for values in zip(*runs, strict=True))
            print(f"{name:<42} {wall:7.2f} {cpu:7.2f}", flush=True)


def _measure(script: str, home: Path, seeds: Path) -> tuple[float, float]:
    """Wall and CPU seconds of one process and its children."""
    environment = os.environ | {"XDG_CACHE_HOME": str(seeds), "PYTHONPATH": str(PROJECT)}
    environment.pop("PREFECT_API_URL", None)
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    command = [sys.executable, "-c", script, str(home)]
    subprocess.run(command, env=environment, check=True, stderr=subprocess.DEVNULL)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return time.perf_counter() - start, cpu


if __name__ == "__main__":
    main()
