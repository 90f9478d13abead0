"""One case of the stability suite, in a process of its own: a run, and what the truth says of it.

Called with the file of a request; writes its result where that says. Whatever happens is written
down, but for what ends the process.
"""

import base64
import hashlib
import json
import math
import tempfile
from pathlib import Path
from typing import Any

from flows.case_work import Listener, answer, events_of, obtain_asset, plan_asset
from flows.cases import Outcome
from flows.config import PipelineConfig, load_config
from stages.hazard_trial import HAZARDS, judge, lay_out, make_trial, spread_of_files, unwrap_torture
from stages.store import Store, Stored

ASSET = "asset.glb"
OTHER_SEED = 1000  # added to a run's seed where it is repeated with another one


def _measured(request: dict[str, Any], listener: Listener) -> dict[str, Any]:
    case = request["case"]
    hazard = HAZARDS[case["hazard"]]
    if hazard.measured == "atlas":
        figures = unwrap_torture(case["variant"], case["severity"], case["seed"])
        events = [["atlas", "note", note] for note in str(figures.pop("notes")).split("; ") if note]
        return {"outcome": Outcome.ASSET, "figures": figures, "events": events}
    store = Store(Path(request["store"]))
    trial = make_trial(
        hazard.name,
        case["variant"],
        case["severity"],
        case["seed"],
        shared=store.shared,
        size=request["size"],
        views=request["views"],
    )
    folder = Path(request["work"]) / "input"
    folder.mkdir()
    given = lay_out(trial, folder)
    overrides = [*request["overrides"], *given.overrides]
    config = load_config(PipelineConfig, request["preset"], overrides)

    def run(store: Store, seed: int) -> dict[str, Stored]:
        plan = plan_asset(config, given.source, seed=seed, store=store)
        return obtain_asset(plan, store, listener)

    artifacts = run(store, case["seed"])
    asset = artifacts["export"].folder
    figures, strip = judge(trial, asset, shared=store.shared)
    sheet = _sheet_figures(artifacts)
    figures |= {name: value for name, value in sheet.items() if math.isfinite(value)}
    figures["finite"] = figures["finite"] and not any(map(math.isnan, sheet.values()))
    if hazard.measured == "repeat":
        with tempfile.TemporaryDirectory(dir=request["work"]) as fresh:
            again = run(Store(Path(fresh)), case["seed"])["export"].folder
            figures["equal_bytes"] = _digest(again) == _digest(asset)
        other = run(store, case["seed"] + OTHER_SEED)["export"].folder
        figures["seed_distance"] = spread_of_files(asset / ASSET, other / ASSET)
    return {
        "outcome": Outcome.ASSET,
        "figures": figures,
        "events": events_of(artifacts),
        "sha256": _digest(asset),
        "strip": base64.b64encode(strip).decode(),
    }


def _sheet_figures(artifacts: dict[str, Stored]) -> dict[str, float]:
    """How well the asset reproduces the given views, as the pipeline itself has it."""
    if "preview" not in artifacts:
        return {}
    page = json.loads((artifacts["preview"].folder / "metrics.json").read_text())
    return {f"given_{name}": value for name, value in page.items()}


def _digest(asset: Path) -> str:
    with (asset / ASSET).open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


if __name__ == "__main__":
    answer(_measured)
