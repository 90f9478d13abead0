"""A plan says what will be computed and why, before anything is."""

import subprocess
import sys
from pathlib import Path

import pytest
from tiny_runs import compute, plan_tiny

from flows.plan import Plan
from stages.errors import InputError
from stages.keys import Recipe
from stages.store import Store

PROJECT = Path(__file__).resolve().parents[2]


def verdicts(plan: Plan) -> list[str]:
    return [str(step.verdict) for step in plan.steps]


def reasons(plan: Plan) -> list[str]:
    return [step.reason for step in plan.steps]


def test_first_plan_computes_all_and_looking_writes_nothing(store, source):
    plan = plan_tiny(store, source)
    assert verdicts(plan) == ["compute"] * 3
    assert reasons(plan) == ["never computed"] * 3
    assert not store.root.exists()


def test_second_plan_is_all_hits(store, source):
    compute(plan_tiny(store, source), store)
    plan = plan_tiny(store, source)
    assert verdicts(plan) == ["cached"] * 3 and not plan.to_compute


@pytest.mark.parametrize(
    ("change", "verdict", "reason"),
    [
        ({"overrides": ["walk.steps=8"]}, "cached compute compute", "walk.steps 40 -> 8"),
        ({"seed": 4}, "compute compute compute", "seed 0 -> 4, another digits"),
        ({"text": "4 5"}, "compute compute compute", "another digits"),
        ({"skip": frozenset({"walk"})}, "cached skipped compute", "left out"),
    ],
)
def test_change_recomputes_what_is_below_it_and_is_named(store, source, change, verdict, reason):
    compute(plan_tiny(store, source), store)
    source.write_text(change.pop("text", source.read_text()))
    plan = plan_tiny(store, source, *change.pop("overrides", []), **change)
    assert verdicts(plan) == verdict.split()
    assert plan.steps[1].reason.startswith(reason)


def test_reasons_run_down_the_pipeline(store, source):
    compute(plan_tiny(store, source), store)
    source.write_text("7")
    assert reasons(plan_tiny(store, source)) == [
        "another input",
        "another digits",
        "another digits, another walk",
    ]


def test_skipping_is_named_where_it_matters(store, source):
    compute(plan_tiny(store, source), store)
    without = plan_tiny(store, source, skip=frozenset({"walk"}))
    assert without.steps[2].reason == "without walk now"
    compute(without, store)
    assert verdicts(plan_tiny(store, source)) == ["cached"] * 3
    again = plan_tiny(store, source, "walk.steps=3")
    assert again.steps[2].reason in ("with walk now", "another walk")


def test_nearest_earlier_artifact_explains(store, source):
    for steps in (3, 5, 7):
        compute(plan_tiny(store, source, f"walk.steps={steps}"), store)
    compute(plan_tiny(store, source, "walk.steps=5", "walk.pause_s=0.001", seed=9), store)
    plan = plan_tiny(store, source, "walk.steps=9")
    assert plan.steps[1].reason == "walk.steps 7 -> 9"


def test_changed_code_and_versions_are_named(store, source, monkeypatch):
    compute(plan_tiny(store, source), store)
    original = plan_tiny(store, source).steps[1].recipe
    import flows.plan as module

    changed = {name: "0" * 64 for name in original.code if name == "stages.base"}
    monkeypatch.setattr(module, "code_digests", lambda _: original.code | changed)
    monkeypatch.setattr(module, "library_versions", lambda: original.versions | {"torch": "9.0"})
    reason = plan_tiny(store, source).steps[1].reason
    assert "code of stages.base" in reason
    assert f"torch {original.versions['torch']} -> 9.0" in reason


def test_many_reasons_are_counted(store, source):
    compute(plan_tiny(store, source), store)
    plan = plan_tiny(store, source, "walk.steps=1", "walk.pause_s=1", "walk.faults=3", seed=2)
    assert plan.steps[1].reason.endswith("and 2 more")


def test_damage_is_the_reason(store, source):
    artifacts = compute(plan_tiny(store, source), store)
    file = artifacts["walk"].folder / "numbers.safetensors"
    file.write_bytes(file.read_bytes()[:-1] + b"\xff")
    plan = plan_tiny(Store(store.root), source)
    assert verdicts(plan) == ["cached", "compute", "cached"]
    assert "numbers.safetensors has changed its content" in plan.steps[1].reason


def test_interrupted_attempt_is_announced(store, source):
    recipe: Recipe = plan_tiny(store, source).steps[1].recipe
    store.work(recipe.key).mkdir(parents=True)
    assert "interrupted attempt" in plan_tiny(store, source).steps[1].reason


def test_selections_choose_their_part(store, source):
    assert verdicts(plan_tiny(store, source, until="walk")) == [
        "compute",
        "compute",
        "not asked for",
    ]
    compute(plan_tiny(store, source), store)
    assert verdicts(plan_tiny(store, source, start="walk")) == ["cached", "compute", "compute"]
    assert verdicts(plan_tiny(store, source, force=frozenset({"walk"}))) == [
        "cached",
        "compute",
        "cached",
    ]
    only = plan_tiny(store, source, "walk.steps=2", only="walk")
    assert verdicts(only) == ["cached", "compute", "not asked for"]


@pytest.mark.parametrize(
    ("wishes", "complaint"),
    [
        ({"until": "bake"}, "--until bake: no such stage; choose from digits, walk, total"),
        ({"skip": {"digits"}}, "--skip digits: later stages need it; walk can be left out"),
        ({"skip": {"walk"}, "force": {"walk"}}, "--force walk: the stage is skipped"),
        ({"only": "walk", "until": "walk"}, "drop --from and --until"),
        ({"only": "walk", "force": {"total"}}, "runs no other stage"),
        ({"start": "total", "until": "walk"}, "--from total comes after --until walk"),
        ({"only": "walk"}, "starts from digits, which is not in the store .*use --until walk"),
    ],
)
def test_impossible_wishes_are_refused(store, source, wishes, complaint):
    sets = {name: frozenset(w) if isinstance(w, set) else w for name, w in wishes.items()}
    with pytest.raises(InputError, match=complaint):
        plan_tiny(store, source, **sets)


def test_absent_input_is_refused(store, tmp_path):
    with pytest.raises(InputError, match="does not exist"):
        plan_tiny(store, tmp_path / "nowhere")


def test_planning_imports_neither_torch_nor_prefect():
    script = """
import sys
from pathlib import Path
import flows.commands
from flows.pipeline import IMAGE_TO_ASSET
from stages.keys import code_digests
for node in IMAGE_TO_ASSET.nodes:
    code_digests("stages.base")
heavy = {"torch", "prefect", "numba", "kornia"} & set(sys.modules)
assert not heavy, heavy
"""
    subprocess.run([sys.executable, "-c", script], cwd=PROJECT, check=True)
