"""What the commands do: plan a run, run it, show the presets."""

import importlib.resources
import signal
import time
from dataclasses import dataclass
from pathlib import Path
from types import FrameType

from rich.console import Console
from rich.table import Table

from flows.config import PRESETS, PipelineConfig, load_config, preset_about
from flows.console import RunDisplay, plan_table, result_table, stage_warnings_on
from flows.engine import Engine
from flows.pipeline import IMAGE_TO_ASSET
from flows.plan import Plan, Selection, Verdict, make_plan
from flows.run_folder import write_run_folder
from stages.store import Store, Stored

EXAMPLE = "example"
OUTPUT_ROOT = Path("out")
DONE = 0


@dataclass(frozen=True)
class Request:
    """What the user asked for, as given on the command line; see `svim3d run --help`."""

    source: str
    out: Path | None
    preset: str
    overrides: tuple[str, ...]
    skip: frozenset[str]
    start: str | None
    until: str | None
    only: str | None
    force: frozenset[str]
    seed: int
    device: str
    store: Path

    @property
    def path(self) -> Path:
        """Where the input lies."""
        if self.source != EXAMPLE:
            return Path(self.source)
        return Path(str(importlib.resources.files("configs") / "example.json"))

    @property
    def run_folder(self) -> Path:
        """Where the results go."""
        return self.out or OUTPUT_ROOT / self.path.resolve().stem

    def plan(self, store: Store) -> Plan:
        """Resolve settings and look every stage up in the store."""
        config = load_config(PipelineConfig, self.preset, self.overrides, self.skip)
        selection = Selection(self.skip, self.start, self.until, self.only, self.force)
        return make_plan(
            IMAGE_TO_ASSET,
            config,
            source=self.path,
            seed=self.seed,
            store=store,
            selection=selection,
        )


def show_plan(request: Request) -> int:
    """Print each stage as hit or miss, and why; computes nothing."""
    console = Console()
    plan = request.plan(Store(request.store))
    console.print(plan_table(plan))
    missing = len(plan.to_compute)
    console.print(f"{missing} of {len(plan.steps)} stages would be computed", highlight=False)
    return DONE


def run(request: Request) -> int:
    """Make the asset, or find it made; ends with a table of all stages."""
    start = time.monotonic()
    console = Console()
    # A stop by the system must leave the same resumable state as Ctrl-C.
    signal.signal(signal.SIGTERM, _interrupt)
    store = Store(
        request.store,
        say=lambda text: console.print(text, style="yellow", highlight=False, markup=False),
    )
    plan = request.plan(store)
    if plan.to_compute:
        artifacts, waited_s = _compute(plan, request, store, console)
        about = {"engine_startup_s": round(waited_s, 2)}
    else:
        artifacts = {step.node.name: step.stored for step in plan.steps if step.stored}
        about = {}
    computed_s = sum(
        stored.manifest.record["seconds"] for stored in artifacts.values() if not stored.is_cached
    )
    total_s = time.monotonic() - start
    write_run_folder(
        request.run_folder,
        plan,
        artifacts,
        store,
        {
            "preset": request.preset,
            "device": request.device,
            **about,
            "stages_s": round(computed_s, 2),
            "total_s": round(total_s, 2),
        },
    )
    console.print(result_table(plan, artifacts))
    engine = f", {about['engine_startup_s']:.1f} s waiting for the engine" if about else ""
    console.print(
        f"{request.run_folder}: {total_s:.1f} s in all, {computed_s:.1f} s in stages{engine}",
        highlight=False,
    )
    return DONE


def _compute(
    plan: Plan, request: Request, store: Store, console: Console
) -> tuple[dict[str, Stored], float]:
    """Run the plan under Prefect; returns the artifacts and the seconds spent on its start."""
    forced = [s.node.name for s in plan.to_compute if s.stored is not None]
    kept = [s.node.name for s in plan.steps if s.verdict is Verdict.CACHED]
    if forced and kept:
        console.print(
            f"computing {', '.join(forced)} again; keys name recipes, so later stages that nothing "
            f"else changed keep their artifacts (--from {forced[0]} recomputes them too)",
            highlight=False,
        )
    with Engine(store.root / "prefect") as engine:
        # All of this takes seconds to import, and does so while the server starts.
        from flows.image_to_asset import run_plan
        from flows.tasks import Bench
        from stages.execution import choose_device

        device = choose_device(request.device)
        for step in plan.to_compute:
            step.node.load()
        engine.wait()
        with stage_warnings_on(console), RunDisplay(console) as display:
            return run_plan(Bench(plan, store, device, display)), engine.waited_s


def _interrupt(signal_number: int, frame: FrameType | None) -> None:
    raise KeyboardInterrupt


def show_presets() -> int:
    """Print each preset with its steps, what it leaves out and what it is for."""
    table = Table(box=None, pad_edge=False)
    for column in ("preset", "steps", "leaves out", "about"):
        table.add_column(column)
    for preset in PRESETS:
        config = load_config(PipelineConfig, preset)
        steps = [
            f"{name} {getattr(config, name).steps}"
            for name in IMAGE_TO_ASSET.names
            if hasattr(getattr(config, name), "steps") and name not in config.skip
        ]
        table.add_row(
            preset,
            ", ".join(steps),
            ", ".join(sorted(config.skip)) or "nothing",
            preset_about(preset),
        )
    Console().print(table)
    return DONE
