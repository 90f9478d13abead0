"""What is read of a run: the console's own lines, the store's page, the last complaint."""

import io
import json
import signal
import types

import pytest
from rich.console import Console

from flows.console import RunDisplay
from flows.service.child import LOG
from flows.service.outcome import Progress, explain_end, read_progress
from flows.service.problems import without_paths


def test_lines_of_the_console_are_understood(tmp_path):
    """What a run prints where nobody watches is what this reads: the two cannot drift apart."""
    said = io.StringIO()
    display = RunDisplay(Console(file=said, width=1000))
    manifest = types.SimpleNamespace(record={"headline": "a square, 3 views", "seconds": 12.34})

    def step(name):
        return types.SimpleNamespace(
            node=types.SimpleNamespace(name=name), reason="never [computed]"
        )

    display.started(step("prepare"))
    display.finished(step("prepare"), types.SimpleNamespace(manifest=manifest, is_cached=False))
    display.finished(step("generation"), types.SimpleNamespace(manifest=manifest, is_cached=True))
    display.started(step("nerf"))
    display.failed(step("nerf"), ValueError("/a/b.png, 3 s"))
    (tmp_path / LOG).write_text(said.getvalue() + "nerf: dropped 2 views\n")
    progress = read_progress(tmp_path, tmp_path, since=0.0)
    assert progress == Progress(
        stage="nerf",
        step=None,
        total=None,
        finished={
            "prepare": "12.3 s, a square, 3 views",
            "generation": "cached, a square, 3 views",
        },
        notes=["nerf: dropped 2 views"],
    )


def test_steps_come_from_the_stores_page(tmp_path):
    (tmp_path / LOG).write_text("nerf: computing (x)\n")
    pages = tmp_path / "store" / "runs"
    pages.mkdir(parents=True)
    (pages / "damaged.json").write_text("{")
    (pages / "other.json").write_text(json.dumps({"folder": "/x", "stage": "nerf", "step": 9}))
    page = {"folder": str(tmp_path / "run"), "stage": "nerf", "step": 3, "total": 20}
    (pages / "this.json").write_text(json.dumps(page))
    progress = read_progress(tmp_path, tmp_path / "store", since=0.0)
    assert (progress.stage, progress.step, progress.total) == ("nerf", 3, 20)
    # A page of an earlier run of the same folder says nothing about this one.
    late = read_progress(tmp_path, tmp_path / "store", since=2e10)
    assert (late.stage, late.step, late.total) == ("nerf", None, None)


@pytest.mark.parametrize(
    ("log", "code", "expected"),
    [
        ("svim3d: no\nsvim3d: run again with --debug", 1, "no"),
        ("x\nsvim3d: first\nsvim3d: input /a/b c.png is none", 2, "input b c.png is none"),
        ("Traceback", 1, "the run ended with exit code 1 and no word of why"),
        ("", -signal.SIGKILL, "too little memory"),
        ("", -signal.SIGSEGV, f"signal {signal.SIGSEGV.value}"),
    ],
)
def test_an_end_is_explained(tmp_path, log, code, expected):
    (tmp_path / LOG).write_text(log)
    assert expected in explain_end(tmp_path, code)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("no folder /srv/store/prefect (denied)", "no folder prefect (denied)"),
        ("'/a/b/photo.png': broken", "'photo.png': broken"),
        ("[Errno 2] '/a/b/'", "[Errno 2] 'a folder'"),
        ("read /jobs/{id}, 1/2 of it at 3 m/s and/or 4", None),
        ("http://host/a/b", None),
    ],
)
def test_paths_are_cut_and_other_words_stay(text, expected):
    if expected is None and text.startswith("read"):
        expected = text.replace("/jobs/{id}", "{id}")
    assert without_paths(text) == (expected or text)
