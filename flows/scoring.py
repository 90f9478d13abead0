"""Scores of an asset that a plan makes: answered by the store, or computed.

The truth is not the plan's input: a photo is held against the orbit that it shows. So scoring is
a stage of its own beside the pipeline, whose key names the asset and the truth.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from flows.plan import Plan
from stages.keys import SKIPPED_INPUT, Recipe, code_digests, digest_input, library_versions
from stages.settings.evaluation import EvaluationConfig

if TYPE_CHECKING:
    from stages.store import Store, Stored

EVALUATION, MODULE = "evaluation", "stages.evaluation"
ASSET, LIGHT = "export", "env_preopt"  # the stages whose artifacts are scored
NO_SEED = 0  # nothing random is left to the run: its generators have seeds of their own


def scores_recipe(plan: Plan, truth: Path, config: EvaluationConfig) -> Recipe:
    """What the scores of a plan's asset depend on."""
    keys = {step.node.name: step.recipe.key for step in plan.steps if step.recipe is not None}
    return Recipe(
        stage=EVALUATION,
        config=config.model_dump(mode="json"),
        seed=NO_SEED,
        inputs={
            "truth": digest_input(truth),
            ASSET: keys[ASSET],
            LIGHT: keys.get(LIGHT, SKIPPED_INPUT),
        },
        code=code_digests(MODULE),
        versions=library_versions(),
    )


def obtain_scores(
    recipe: Recipe,
    artifacts: Mapping[str, "Stored"],
    truth: Path,
    *,
    config: EvaluationConfig,
    store: "Store",
) -> dict[str, Any]:
    """The scores of an asset, from the store or from its stage.

    Args:
        recipe: of `scores_recipe`.
        artifacts: of the plan, by stage.
        truth: as in the recipe.
        config: as in the recipe.
        store: where scores are looked for and kept.
    """
    import torch

    from stages.evaluation import EVALUATION as STAGE
    from stages.evaluation import AssetScores
    from stages.execution import run_stage

    stored = run_stage(
        store,
        recipe,
        STAGE,
        {"truth": truth, ASSET: artifacts[ASSET], LIGHT: artifacts.get(LIGHT)},
        config=config,
        device=torch.device("cpu"),
    )
    return AssetScores.load(stored.folder).figures
