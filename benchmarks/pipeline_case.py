"""A case of the pipeline in this process: all stages up to the export, then the figures.

The stages run through the real store, without the flow engine: what a stored artifact cost is read
from its manifest, so that an interrupted benchmark goes on where it stopped and stages that two
cases share run once.
"""

import sys
from pathlib import Path
from typing import Any

import torch

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from flows.config import PipelineConfig, load_config  # noqa: E402
from flows.pipeline import IMAGE_TO_ASSET, SOURCE  # noqa: E402
from flows.plan import Plan, Selection, Verdict, make_plan  # noqa: E402
from flows.scoring import obtain_scores, scores_recipe  # noqa: E402
from stages.execution import run_stage  # noqa: E402
from stages.settings.evaluation import EvaluationConfig  # noqa: E402
from stages.store import Store, Stored  # noqa: E402

LAST_STAGE = "export"  # what the figures are about; the preview sheet is not counted


def plan_case(
    orbit: Path, preset: str, overrides: list[str], skip: list[str], *, store: Store, seed: int
) -> Plan:
    """What the case has to compute."""
    config = load_config(PipelineConfig, preset, overrides, skip)
    selection = Selection(until=LAST_STAGE)
    return make_plan(
        IMAGE_TO_ASSET, config, source=orbit, seed=seed, store=store, selection=selection
    )


def case_key(plan: Plan) -> str:
    """Key of the asset that the case ends with."""
    return next(step.recipe.key for step in plan.steps if step.node.name == LAST_STAGE)


def run_case(plan: Plan, store: Store) -> dict[str, Stored]:
    """Artifacts of all stages, computed where the store has none."""
    done: dict[str, Stored] = {}
    for step in plan.steps:
        if step.verdict in (Verdict.SKIPPED, Verdict.NOT_ASKED):
            continue
        inputs = {n: plan.source if n == SOURCE else done.get(n) for n in step.node.inputs}
        name = step.node.name
        done[name] = run_stage(
            store,
            step.recipe,
            step.node.load(),
            inputs,
            config=getattr(plan.config, name),
            device=torch.device("cpu"),
        )
        record = done[name].manifest.record
        state = "cached" if done[name].is_cached else "computed"
        print(f"  {name:11s} {record['seconds']:7.1f} s  {state}  {record['headline']}", flush=True)
    return done


def measure(plan: Plan, store: Store, truth: Path) -> dict[str, Any]:
    """Seconds, memory and quality of one case; `truth` is the orbit that it is held against."""
    done = run_case(plan, store)
    records = {name: stored.manifest.record for name, stored in done.items()}
    config = EvaluationConfig()
    recipe = scores_recipe(plan, truth, config)
    figures = obtain_scores(recipe, done, truth, config=config, store=store)
    return {
        "key": case_key(plan),
        "seconds": {name: record["seconds"] for name, record in records.items()},
        "cpu_seconds": {name: record["cpu_seconds"] for name, record in records.items()},
        "peak_mib": max(record["peak_memory_mib"]["host"] for record in records.values()),
        "events": {name: record["events"] for name, record in records.items()},
        "figures": figures,
    }
