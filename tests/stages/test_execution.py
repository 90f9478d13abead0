"""One stage against the store: inputs loaded, result saved, the making recorded."""

from dataclasses import dataclass
from pathlib import Path
from typing import Self

import pytest
import torch

from stages.base import Checkpoints, Context, Stage
from stages.errors import InputError
from stages.execution import choose_device, run_stage
from stages.keys import Recipe
from stages.settings.base import StageConfig
from stages.store import Store

CPU = torch.device("cpu")


@dataclass(frozen=True)
class Text:
    value: str

    def save(self, folder: Path) -> None:
        (folder / "text.txt").write_text(self.value)

    @classmethod
    def load(cls, folder: Path) -> Self:
        return cls((folder / "text.txt").read_text())

    def headline(self) -> str:
        return f"{len(self.value)} letters"


def read(source: Path, *, config: StageConfig, ctx: Context) -> Text:
    return Text(source.read_text())


def join(one: Text, two: Text | None, *, config: StageConfig, ctx: Context) -> Text:
    if two is None:
        ctx.event("no_second", "joined with nothing")
    ctx.report(1, 1, {"length": len(one.value)})
    return Text(one.value + (two.value if two else "-"))


def recipe(stage: str) -> Recipe:
    return Recipe(stage, {}, 3, {}, {}, {})


def test_stages_chain_through_the_store(tmp_path):
    store = Store(tmp_path / "store")
    (tmp_path / "in.txt").write_text("ab")
    options = {"config": StageConfig(), "device": CPU}
    first = run_stage(
        store, recipe("read"), Stage(read), {"source": tmp_path / "in.txt"}, **options
    )
    both = {"one": first, "two": None}
    second = run_stage(store, recipe("join"), Stage(join), both, **options)
    assert Text.load(second.folder).value == "ab-"
    record = second.manifest.record
    assert record["headline"] == "3 letters"
    assert record["events"] == [{"kind": "no_second", "message": "joined with nothing"}]
    assert record["consumed"] == {"one": first.manifest.seal}
    assert record["seconds"] >= 0 and record["peak_memory_mib"]["host"] > 1
    assert record["device"] == "cpu" and record["python"]
    assert (store.artifact(second.key) / "scalars.csv").read_text() == "1,length,2\n"
    assert run_stage(store, recipe("join"), Stage(join), both, **options).is_cached


def resume(source: Path, *, config: StageConfig, ctx: Context) -> Text:
    return Text("new" if ctx.checkpoints.load() is None else "resumed")


@pytest.mark.parametrize("is_sound", [True, False])
def test_resumed_stage_says_so_and_one_that_had_to_start_anew_does_not(tmp_path, is_sound):
    store = Store(tmp_path)
    work = store.work(recipe("resume").key)
    work.mkdir(parents=True)
    Checkpoints(work).save(7, {"x": torch.zeros(3)})
    if not is_sound:
        (work / "checkpoint.safetensors").write_bytes(b"whatever")
    stored = run_stage(
        store,
        recipe("resume"),
        Stage(resume),
        {"source": tmp_path},
        config=StageConfig(),
        device=CPU,
    )
    assert Text.load(stored.folder).value == ("resumed" if is_sound else "new")
    kinds = [event["kind"] for event in stored.manifest.record["events"]]
    assert kinds == (["resumed"] if is_sound else ["damaged_checkpoint"])


def test_device_is_chosen_by_what_there_is():
    assert choose_device("cpu") == CPU
    assert choose_device("auto").type == ("cuda" if torch.cuda.is_available() else "cpu")


@pytest.mark.skipif(torch.cuda.is_available(), reason="this machine has what the test refuses")
def test_absent_device_is_refused():
    with pytest.raises(InputError, match="torch sees none"):
        choose_device("cuda")
