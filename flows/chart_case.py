"""One case of `svim3d chart`, in a process of its own: a run, what it cost, what the truth says."""

from pathlib import Path
from typing import Any

from flows.case_work import Listener, Request, answer, events_of, obtain_asset, plan_asset
from flows.cases import Outcome
from flows.config import PipelineConfig, load_config
from flows.scoring import obtain_scores, scores_recipe
from stages.given_views import given_views, photo_of
from stages.settings.evaluation import EvaluationConfig
from stages.store import Store, Stored

LAST_STAGE = "export"  # what the figures are about; the preview sheet is not counted
ASSET = "asset.glb"


def measured(request: Request, listener: Listener) -> dict[str, Any]:
    """Costs and figures of a case; what stages cost is read off the store's manifests."""
    truth, store = Path(request["orbit"]), Store(Path(request["store"]))
    source, overrides = truth, list(request["overrides"])
    if request["photos"]:
        source, told = photo_of(truth)
        overrides = [*told, *overrides]
    else:
        folder = store.shared / "views"
        source = given_views(truth, folder, views=request["views"], size=request["size"])
    config = load_config(PipelineConfig, request["preset"], overrides)
    plan = plan_asset(config, source, seed=request["seed"], store=store, until=LAST_STAGE)
    artifacts = obtain_asset(plan, store, listener)
    scoring = EvaluationConfig(**request["scoring"])
    recipe = scores_recipe(plan, truth, scoring)
    figures = obtain_scores(recipe, artifacts, truth, config=scoring, store=store)
    return {
        "outcome": Outcome.ASSET,
        **costs(artifacts),
        "figures": figures,
        "events": events_of(artifacts),
    }


def costs(artifacts: dict[str, Stored]) -> dict[str, Any]:
    """Time, memory and bytes, in all and by stage."""
    records = {name: stored.manifest.record for name, stored in artifacts.items()}
    seconds, cpu = (
        {name: float(record[key]) for name, record in records.items()}
        for key in ("seconds", "cpu_seconds")
    )
    return {
        "costs": {
            "seconds": round(sum(seconds.values()), 2),
            "cpu_s": round(sum(cpu.values()), 2),
            "peak_mib": max(float(r["peak_memory_mib"]["host"]) for r in records.values()),
            "bytes": (artifacts[LAST_STAGE].folder / ASSET).stat().st_size,
        },
        "stage_seconds": seconds,
        "stage_cpu_s": cpu,
    }


if __name__ == "__main__":
    answer(measured)
