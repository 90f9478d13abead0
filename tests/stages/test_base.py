"""Contexts: random numbers by name, scalars and events that survive a kill, checkpoints."""

import json
from pathlib import Path

import pytest
import torch

from stages.base import MAX_NON_FINITE_STEPS, Checkpoints, Stage
from stages.errors import DivergenceError


def test_generators_depend_on_seed_stage_and_name_alone(make_context):
    def draw(stage="nerf", name="rays", seed=0):
        return float(torch.rand(1, generator=make_context(stage, seed=seed).generator(name)))

    assert draw() == draw()
    assert len({draw(), draw(stage="dmtet"), draw(name="views"), draw(seed=1)}) == 4


def test_checkpoint_returns_the_same_bits(tmp_path):
    state = {"p": torch.randn(3), "rng": torch.Generator().get_state()}
    Checkpoints(tmp_path).save(7, state)
    step, loaded = Checkpoints(tmp_path).load()
    assert step == 7 and all(torch.equal(loaded[name], state[name]) for name in state)


def test_no_checkpoint_is_the_beginning(tmp_path):
    assert Checkpoints(tmp_path).load() is None


def test_damaged_checkpoint_costs_time_only(tmp_path):
    Checkpoints(tmp_path).save(7, {"p": torch.zeros(3)})
    file = tmp_path / "checkpoint.safetensors"
    file.write_bytes(file.read_bytes()[:20])
    checkpoints = Checkpoints(tmp_path)
    assert checkpoints.load() is None and not checkpoints.exists


def flip_a_bit(content: bytes) -> bytes:
    return content[:-1] + bytes([content[-1] ^ 1])


def cut_in_half(content: bytes) -> bytes:
    return content[: len(content) // 2]


@pytest.mark.parametrize("spoil", [flip_a_bit, cut_in_half])
def test_damage_to_a_checkpoint_is_an_event_and_so_is_going_on(make_context, spoil):
    ctx = make_context("nerf")
    ctx.checkpoints.save(7, {"p": torch.ones(3)})
    file = ctx.work / "checkpoint.safetensors"
    file.write_bytes(spoil(file.read_bytes()))
    ctx = make_context("nerf")
    assert ctx.checkpoints.load() is None
    ctx.checkpoints.save(3, {"p": torch.ones(3)})
    ctx = make_context("nerf")
    assert ctx.checkpoints.load() is not None
    damage, resumption = ctx.events
    assert damage["kind"] == "damaged_checkpoint" and "started anew" in damage["message"]
    assert resumption["kind"] == "resumed" and "at step 3 " in resumption["message"]


def test_records_that_were_cut_or_spoilt_cost_a_line_each(make_context):
    ctx = make_context("nerf")
    ctx.event("a", "whole")
    (ctx.work / "events.jsonl").open("ab").write(b'{"kind": "\xff')
    (ctx.work / "scalars.csv").write_bytes(b"0,loss,1\n1x,lo\xff,0.1\n1,loss,2\n2,lo")
    make_context("nerf").event("b", "after the cut")
    with make_context("nerf") as ctx:
        ctx.report(2, 3, {"loss": 3.0})
    assert [entry["message"] for entry in ctx.events] == ["whole", "after the cut"]
    assert (ctx.work / "scalars.csv").read_text() == "0,loss,1\n1,loss,2\n2,loss,3\n"


def test_checkpoint_is_due_after_its_time(tmp_path):
    assert Checkpoints(tmp_path, every_s=0.0).due()
    assert not Checkpoints(tmp_path, every_s=60.0).due()


def test_scalars_of_a_resumed_stage_equal_those_of_an_undisturbed_one(make_context):
    def scalars(stage: str) -> bytes:
        return (make_context(stage).work / "scalars.csv").read_bytes()

    with make_context("whole") as ctx:
        for step in range(8):
            ctx.report(step, 8, {"loss": 1 / (step + 1), "psnr": step})
    with make_context("killed") as ctx:
        for step in range(6):
            ctx.report(step, 8, {"loss": 1 / (step + 1), "psnr": step})
    with (make_context("killed").work / "scalars.csv").open("a") as stream:
        stream.write("6,lo")  # the kill came in the middle of a row
    with make_context("killed") as ctx:
        for step in range(4, 8):
            ctx.report(step, 8, {"loss": 1 / (step + 1), "psnr": step})
    assert scalars("killed") == scalars("whole")


def test_rows_before_a_checkpoint_are_on_disk_with_it(make_context):
    ctx = make_context("nerf")
    ctx.report(0, 2, {"loss": 0.5})
    ctx.checkpoints.save(1, {})
    assert (ctx.work / "scalars.csv").read_text() == "0,loss,0.5\n"


def test_events_survive_a_kill_and_are_told_once(make_context):
    make_context("nerf").event("dropped_view", "view 3 is empty")
    ctx = make_context("nerf")
    ctx.event("dropped_view", "view 3 is empty")
    ctx.event("dropped_view", "view 4 is empty")
    assert [e["message"] for e in ctx.events] == ["view 3 is empty", "view 4 is empty"]
    lines = (ctx.work / "events.jsonl").read_text().splitlines()
    assert [json.loads(line) for line in lines if line] == ctx.events


def test_non_finite_steps_are_skipped_then_fatal_by_name(make_context):
    ctx = make_context("nerf")
    bad = {"rgb": torch.tensor(float("nan")), "mask": torch.tensor(1.0)}
    assert ctx.is_finite(0, {"rgb": torch.tensor(1.0)})
    for step in range(MAX_NON_FINITE_STEPS):
        assert not ctx.is_finite(step, bad)
    ctx.checkpoints.save(3, {"x": torch.ones(1)})
    with pytest.raises(DivergenceError, match="non-finite rgb; lower the learning rate"):
        ctx.is_finite(MAX_NON_FINITE_STEPS, bad)
    # The next attempt must not take up what has diverged.
    assert not ctx.checkpoints.exists
    assert not (ctx.work / "events.jsonl").exists()


def test_progress_is_told_sparingly_and_at_the_end(make_context):
    told = []
    ctx = make_context("nerf", on_progress=told.append)
    for step in range(1, 101):
        ctx.report(step, 100, {"loss": 1.0})
    assert told[0].step == 1 and told[-1].step == 100 and len(told) < 50


def test_stage_reads_its_inputs_from_the_signature():
    def run(source: Path, views: int | None, *, config: dict, ctx: object) -> str:
        return ""

    stage = Stage(run)
    assert stage.inputs == {"source": Path, "views": int}
    assert stage.output is str
