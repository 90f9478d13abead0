"""`svim3d status`, `resume` and `logs`: what runs there are, how they go, and once more."""

import argparse
import contextlib
import os
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from flows.pipeline import REPORT
from flows.run_records import (
    CACHED,
    CANCELLED,
    COMPUTED,
    COMPUTING,
    DIED,
    FAILED,
    RUNNING,
    UNFINISHED,
    RunIndex,
    RunRecord,
    newest_of_folders,
)
from stages.errors import InputError

EXIT_DONE, EXIT_FAILED, EXIT_CANCELLED = 0, 1, 130
PROJECT = Path(__file__).resolve().parents[1]
COMMAND = (sys.executable, "-m", "flows.cli")
SHOWN_RUNS = 40  # in a table, without --all
STYLES = {RUNNING: "cyan", "done": "green", FAILED: "red", DIED: "red", CANCELLED: "yellow"}
STOP_TIMEOUT_S = 20.0  # for a run to leave its state behind
FOLLOW_POLL_S = 0.5
FILE_WIDTH = 250  # columns of a table that goes into a file: scripts must get whole names


def table_console() -> Console:
    """Where tables are printed: as wide as the terminal, or as they need in a file."""
    console = Console()
    return console if console.is_terminal else Console(width=FILE_WIDTH)


def status(options: argparse.Namespace) -> int:
    """Tell of one run, or print a table of them."""
    index, console = RunIndex(options.store), table_console()
    if options.run is not None:
        record = index.find(options.run)
        _tell(record, index, console)
        return EXIT_FAILED if options.failed and record.now in UNFINISHED else EXIT_DONE
    records = newest_of_folders(index.records())
    states = {record.id: record.now for record in records}
    if options.failed:
        records = [record for record in records if states[record.id] in UNFINISHED]
    if not records:
        kind = "failed runs" if options.failed else "runs"
        console.print(f"no {kind} in {index.folder}", highlight=False)
        return EXIT_DONE
    _show_table(records, states, options.all, console)
    return EXIT_FAILED if options.failed else EXIT_DONE


def _show_table(
    records: Sequence[RunRecord], states: Mapping[str, str], is_whole: bool, console: Console
) -> None:
    """A line for each run, the newest ones where not all are wanted, and how many are how."""
    shown = records if is_whole else records[:SHOWN_RUNS]
    table = Table(box=None, pad_edge=False)
    # Where a terminal is too narrow, names that nobody types are cut.
    for column in ("run", "asset", "preset", "state", "stage", "progress"):
        is_cut = column in ("asset", "preset")
        table.add_column(column, no_wrap=not is_cut, overflow="ellipsis")
    for column in ("age", "took"):
        table.add_column(column, justify="right", no_wrap=True)
    for record in shown:
        state = states[record.id]
        table.add_row(
            escape(record.id),
            escape(record.asset),
            escape(record.preset),
            f"[{STYLES.get(state, 'default')}]{escape(state)}",
            escape(record.stage),
            progress_of(record),
            in_short(time.time() - record.started),
            in_short(record.duration_s),
        )
    console.print(table)
    tally = Counter(states[record.id] for record in records)
    counts = ", ".join(f"{n} {state}" for state, n in tally.most_common())
    hidden = f"; the newest {len(shown)} are shown, --all shows all" if shown != records else ""
    console.print(f"{len(records)} runs: {counts}{hidden}", highlight=False)


def _tell(record: RunRecord, index: RunIndex, console: Console) -> None:
    """All that is known of a run."""
    state = record.now
    page = Path(record.folder) / REPORT
    facts = {
        "run": record.id,
        "input": record.source,
        "preset": record.preset,
        "folder": record.folder,
        "state": state,
        "error": record.error,
        "stage": record.stage,
        "progress": progress_of(record),
        "started": time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(record.started)),
        "took": in_short(record.duration_s),
        "process": f"{record.process.pid} on {record.process.host}",
        "log": str(index.log(record.id)),
        "report": str(page) if page.is_file() else "",
        "command": " ".join(record.command),
    }
    table = Table(box=None, pad_edge=False, show_header=False)
    for name, fact in facts.items():
        if fact:
            table.add_row(name, escape(fact))
    console.print(table)
    stages = Table("stage", "state", "key", box=None, pad_edge=False)
    stages.add_column("seconds", justify="right")
    stages.add_column("events")
    for name, stage in record.stages.items():
        seconds = "" if stage.seconds is None else f"{stage.seconds:.1f}"
        became = "stopped" if stage.state == COMPUTING and state != RUNNING else stage.state
        stages.add_row(escape(name), escape(became), escape((stage.key or "")[:8]), seconds)
        for event in stage.events:
            stages.add_row("", "", "", "", f"[yellow]{escape(event)}")
    console.print(stages)
    if state in UNFINISHED and record.command:
        console.print(f"svim3d resume {record.id} goes on where it stopped", highlight=False)


def progress_of(record: RunRecord) -> str:
    """Stages that are there of those that are wanted, and how far the one at work is."""
    wanted = [stage for stage in record.stages.values() if stage.key]
    there = sum(stage.state in (CACHED, COMPUTED) for stage in wanted)
    share = f" {record.step / record.total:.0%}" if record.total else ""
    left = ""
    if record.due is not None and record.now == RUNNING:
        left = f", {in_short(record.due - time.time())} left"
    return f"{there}/{len(wanted)}{share}{left}"


def in_short(seconds: float) -> str:
    """A length of time to two digits or so, in the unit that fits it."""
    for unit, size in (("d", 86_400.0), ("h", 3600.0), ("min", 60.0)):
        if seconds >= 2 * size:
            return f"{seconds / size:.0f} {unit}"
    return f"{max(0.0, seconds):.0f} s"


def resume(options: argparse.Namespace) -> int:
    """Carry out again what did not come to its end; finished stages are in the store."""
    index, console = RunIndex(options.store), Console()
    if not options.all_failed:
        return _again(index.find(options.run))
    records = [r for r in newest_of_folders(index.records()) if r.now in UNFINISHED]
    records = [record for record in records if record.command]
    failed = 0
    for number, record in enumerate(records, start=1):
        console.print(f"{number} of {len(records)}: {record.id}", highlight=False, markup=False)
        try:
            code = _again(record)
        except InputError as error:
            console.print(f"{record.id}: {error}", style="red", highlight=False, markup=False)
            code = EXIT_FAILED
        if code == EXIT_CANCELLED:
            return EXIT_CANCELLED
        failed += code != EXIT_DONE
    console.print(f"{len(records)} resumed, {failed} failed", highlight=False)
    return EXIT_FAILED if failed else EXIT_DONE


def _again(record: RunRecord) -> int:
    """Give a run's command once more, in a process of its own; its exit code.

    Raises:
        InputError: it still runs, or left no command that can be given here.
    """
    if record.now == RUNNING:
        raise InputError(
            f"{record.id} still runs, as process {record.process.pid} on {record.process.host}"
        )
    if not record.command:
        raise InputError(
            f"{record.id} left no command that could be given again here; run it by hand"
        )
    if not Path(record.cwd).is_dir():
        raise InputError(f"{record.id} was started in {record.cwd}, which is gone")
    path = os.pathsep.join(p for p in (str(PROJECT), os.environ.get("PYTHONPATH")) if p)
    process = subprocess.Popen(
        [*COMMAND, *record.command], cwd=record.cwd, env=os.environ | {"PYTHONPATH": path}
    )
    before = signal.signal(signal.SIGTERM, lambda *_: process.terminate())
    try:
        code = process.wait()
    except KeyboardInterrupt:
        # The keyboard's interrupt reaches the run too, which then leaves a state to go on from.
        for insist in (process.terminate, process.kill):
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(STOP_TIMEOUT_S)
                break
            insist()
        return EXIT_CANCELLED
    finally:
        signal.signal(signal.SIGTERM, before)
    return code if code >= 0 else EXIT_FAILED


def logs(options: argparse.Namespace) -> int:
    """Print the log of a run."""
    index = RunIndex(options.store)
    record = index.find(options.run)
    file = index.log(record.id)
    if not file.exists():
        raise InputError(f"{record.id} left no log")
    with file.open(encoding="utf-8", errors="replace") as stream:
        while True:
            # Asked first: what a run writes last is there once it is over.
            goes_on = options.follow and index.read(record.id).now == RUNNING
            for line in stream:
                sys.stdout.write(line)
            sys.stdout.flush()
            if not goes_on:
                return EXIT_DONE
            time.sleep(FOLLOW_POLL_S)
