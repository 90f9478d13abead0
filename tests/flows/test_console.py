"""What a person sees: progress, faults and tables, whatever the messages hold."""

import io
from types import SimpleNamespace

import pytest
from rich.console import Console
from tiny_runs import compute, plan_tiny

from flows.console import RunDisplay, plan_table, result_table
from stages.base import Progress


@pytest.fixture(params=[False, True], ids=["file", "terminal"])
def console(request) -> Console:
    return Console(file=io.StringIO(), force_terminal=request.param, width=200, color_system=None)


def shown(console: Console) -> str:
    return console.file.getvalue()


def test_bar_counts_steps_and_tells_the_time_left(store, source):
    console = Console(file=io.StringIO(), force_terminal=True, width=200, color_system=None)
    step = plan_tiny(store, source).steps[1]
    with RunDisplay(console) as display:
        display.started(step)
        display.progressed(Progress("walk", 10, 40, {"mean": 0.25}))
    assert all(part in shown(console) for part in ("walk", "10/40", "left", "mean 0.25"))


def test_brackets_in_a_message_are_text(console, store, source):
    step = plan_tiny(store, source).steps[1]
    with RunDisplay(console) as display:
        display.started(step)
        display.failed(step, ValueError("[alloc_cpu.cpp:117] no memory for [/data/x]"))
    assert "ValueError: [alloc_cpu.cpp:117] no memory for [/data/x]" in shown(console)


def test_tables_name_every_stage_its_key_and_its_events(console, store, source):
    plan = plan_tiny(store, source)
    artifacts = compute(plan, store)
    told = {"kind": "odd", "message": "dropped [/data/x]"}
    record = artifacts["walk"].manifest.record | {"events": [told], "headline": "[bold] 3"}
    manifest = SimpleNamespace(record=record)
    artifacts["walk"] = SimpleNamespace(manifest=manifest, is_cached=False)
    console.print(plan_table(plan))
    console.print(result_table(plan, artifacts))
    assert all(shown(console).count(step.key8) == 2 for step in plan.steps)
    assert "dropped [/data/x]" in shown(console) and "[bold] 3" in shown(console)
