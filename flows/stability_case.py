"""One case of the stability suite, in a process of its own: a run, and what the truth says of it.

Called with the file of a request; writes its result where that says. Whatever happens is written
down, but for what ends the process.
"""

import base64
import hashlib
import json
import math
import sys
import tempfile
import time
import traceback
from pathlib import Path
from typing import Any

from flows.config import PipelineConfig, load_config
from flows.pipeline import IMAGE_TO_ASSET
from flows.plan import Selection, Step, make_plan
from flows.stability_cases import Outcome
from flows.steps import Bench, obtain_steps
from stages.base import Progress
from stages.errors import DivergenceError, InputError, StageTimeoutError, TransientError
from stages.execution import choose_device
from stages.hazard_trial import HAZARDS, judge, lay_out, make_trial, spread_of_files, unwrap_torture
from stages.store import Store, Stored

# These say what was wanted and what to do.
CLEAR = (InputError, DivergenceError, TransientError, StageTimeoutError)
ASSET = "asset.glb"
OTHER_SEED = 1000  # added to a run's seed where it is repeated with another one


class Listener:
    """Watches a run: remembers which stage failed."""

    def __init__(self) -> None:
        self.stage = ""

    def started(self, step: Step) -> None:
        """Nothing to tell."""

    def progressed(self, progress: Progress) -> None:
        """Nothing to tell."""

    def failed(self, step: Step, error: BaseException) -> None:
        """Remember where."""
        self.stage = step.node.name

    def finished(self, step: Step, stored: Stored) -> None:
        """Nothing to tell."""


def carry_out(request: dict[str, Any]) -> dict[str, Any]:
    """The result of a request, as the suite keeps it."""
    start = time.process_time()
    listener = Listener()
    try:
        result = _measured(request, listener)
    except CLEAR as error:
        message = f"{type(error).__name__}: {error}"
        result = {"outcome": Outcome.REFUSED, "error": message, "stage": listener.stage}
    except Exception:
        last = traceback.format_exc(limit=-4)
        result = {"outcome": Outcome.CRASHED, "error": last, "stage": listener.stage}
    return result | {"cpu_s": round(time.process_time() - start, 1)}


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
        plan = make_plan(
            IMAGE_TO_ASSET,
            config,
            source=given.source,
            seed=seed,
            store=store,
            selection=Selection(),
            explained=False,
        )
        return obtain_steps(Bench(plan, store, choose_device("cpu"), listener), retry_delays_s=())

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
        "events": _events(artifacts),
        "sha256": _digest(asset),
        "strip": base64.b64encode(strip).decode(),
    }


def _sheet_figures(artifacts: dict[str, Stored]) -> dict[str, float]:
    """How well the asset reproduces the given views, as the pipeline itself has it."""
    if "preview" not in artifacts:
        return {}
    page = json.loads((artifacts["preview"].folder / "metrics.json").read_text())
    return {f"given_{name}": value for name, value in page.items()}


def _events(artifacts: dict[str, Stored]) -> list[list[str]]:
    """Stage, kind and message of all events."""
    return [
        [name, str(event["kind"]), str(event["message"])]
        for name, stored in artifacts.items()
        for event in stored.manifest.record.get("events", ())
    ]


def _digest(asset: Path) -> str:
    with (asset / ASSET).open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def main() -> None:
    """Carry out the request in the file that the command line names."""
    request = json.loads(Path(sys.argv[1]).read_text())
    Path(request["out"]).write_text(json.dumps(carry_out(request)))


if __name__ == "__main__":
    main()
