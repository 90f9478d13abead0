"""Plan and execute the tiny pipeline without Prefect: what a task does, in a loop."""

from pathlib import Path

import torch
from tiny_pipeline import TINY, TinyConfig

from flows.config import load_config
from flows.pipeline import SOURCE
from flows.plan import Plan, Selection, Verdict, make_plan
from stages.execution import run_stage
from stages.store import Store, Stored


def plan_tiny(store: Store, source: Path, *overrides: str, seed: int = 0, **wishes) -> Plan:
    config = load_config(TinyConfig, "standard", overrides)
    selection = Selection(**wishes)
    return make_plan(TINY, config, source=source, seed=seed, store=store, selection=selection)


def compute(plan: Plan, store: Store) -> dict[str, Stored]:
    artifacts: dict[str, Stored] = {}
    for step in plan.steps:
        if step.verdict is Verdict.COMPUTE:
            artifacts[step.node.name] = run_stage(
                store,
                step.recipe,
                step.node.load(),
                {n: plan.source if n == SOURCE else artifacts.get(n) for n in step.node.inputs},
                config=getattr(plan.config, step.node.name),
                device=torch.device("cpu"),
                force=step.stored is not None,
            )
        elif step.stored:
            artifacts[step.node.name] = step.stored
    return artifacts
