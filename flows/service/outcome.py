"""What a run has said and left: how far it is, why it failed, what can be fetched."""

import contextlib
import json
import re
import signal
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from flows.pipeline import IMAGE_TO_ASSET
from flows.service.child import LOG
from flows.service.problems import strip_paths, without_paths

TAIL_BYTES = 1 << 16  # of a log; a run says a few lines per stage
MAX_LINE = 400
MAX_NOTES = 50
RUN = "run"
REPORT = "run.json"
CLOCK_SLACK_S = 1.0  # file systems keep coarse times
PAGES = "runs"  # where a store keeps a page about each run
LINE = re.compile(rf"({'|'.join(IMAGE_TO_ASSET.names)}): (.*)")
# The forms of `flows.console`.
BEGUN = "computing ("
FINISHED = re.compile(r"(?:cached|[\d.]+ s), ")
FAULT = re.compile(r"[A-Z]\w*(?:Error|Exception|Exit|Interrupt): ")
COMPLAINT = "svim3d: "
ADVICE = "svim3d: run again"
# What may be fetched of a finished job.
FILES = ("asset.glb", "preview.png", "views.png")


@dataclass(frozen=True)
class Progress:
    """How far a run is.

    Attributes:
        stage: at work; None between two.
        step: of that stage, where it is known.
        total: steps of that stage.
        finished: what each finished stage has made, in a line.
        notes: what stages had to say: fallbacks taken, views dropped.
    """

    stage: str | None
    step: int | None
    total: int | None
    finished: dict[str, str]
    notes: list[str]


def read_progress(folder: Path, store: Path, *, since: float) -> Progress:
    """How far a job's run is: stages from its log, steps from its page in the store.

    Args:
        folder: of the job.
        store: root folder of the store.
        since: when the run was started, seconds since 1970; older pages are not read.
    """
    stage: str | None = None
    finished: dict[str, str] = {}
    notes = []
    for line in _last_lines(folder):
        found = LINE.fullmatch(line)
        if found is None:
            continue
        said = without_paths(found[2])[:MAX_LINE]
        if said.startswith(BEGUN):
            stage = found[1]
            finished.pop(stage, None)
        elif FINISHED.match(said):
            finished[found[1]] = said
            stage = None if stage == found[1] else stage
        elif not FAULT.match(said):  # a fault is told as the job's error, or was mended
            notes.append(f"{found[1]}: {said}")
    page = _page(folder / RUN, store, since)
    step, total = page.get("step"), page.get("total")
    if page.get("stage") != stage or not isinstance(step, int) or not isinstance(total, int):
        step = total = None
    return Progress(stage, step, total or None, finished, notes[-MAX_NOTES:])


def _page(run: Path, store: Path, since: float) -> dict[str, Any]:
    """The store's page about the run in this folder; empty where there is none."""
    for file in (store / PAGES).glob("*.json"):
        with contextlib.suppress(OSError, ValueError):
            if file.stat().st_mtime < since - CLOCK_SLACK_S:
                continue
            page = json.loads(file.read_bytes())
            if isinstance(page, dict) and page.get("folder") == str(run):
                return page
    return {}


def explain_end(folder: Path, exit_code: int) -> str:
    """Why a run failed, in a line."""
    if exit_code == -signal.SIGKILL:
        return "the run was killed: most likely this machine had too little memory"
    if exit_code < 0:
        return f"the run was ended by signal {-exit_code}"
    complaints = [
        line.removeprefix(COMPLAINT)
        for line in _last_lines(folder)
        if line.startswith(COMPLAINT) and not line.startswith(ADVICE)
    ]
    if not complaints:
        return f"the run ended with exit code {exit_code} and no word of why"
    return without_paths(complaints[-1])[:MAX_LINE]


def _last_lines(folder: Path) -> list[str]:
    """The end of what the last run said."""
    try:
        with (folder / LOG).open("rb") as log:
            log.seek(max(0, log.seek(0, 2) - TAIL_BYTES))
            return log.read().decode(errors="replace").splitlines()
    except OSError:
        return []


def read_report(folder: Path) -> dict[str, Any] | None:
    """What was done and with which settings, without paths of the machine; None if there is none.

    A run writes the page at its end; before that it may be there, but empty.
    """
    try:
        page = json.loads((folder / RUN / REPORT).read_bytes())
    except (OSError, ValueError):
        return None
    return strip_paths(page) if isinstance(page, dict) and page else None
