"""What the commands do: plan a run, run it, show the presets."""

import argparse
import importlib.resources
from dataclasses import dataclass
from pathlib import Path
from typing import Self

from rich.console import Console
from rich.table import Table

from flows.config import PRESETS, PipelineConfig, load_config, preset_about, resolved_preset
from flows.console import plan_table
from flows.job import DONE, Job, compute_under_engine
from flows.limits import parse_limits
from flows.options import photo_settings
from flows.pipeline import IMAGE_TO_ASSET
from flows.plan import Plan, Selection, make_plan
from stages.store import Store

EXAMPLE = "example"
# Words that stand for files that come with the program.
SHIPPED = {EXAMPLE: "example.json", "photo": "example_photo.png"}
OUTPUT_ROOT = Path("out")


def input_path(given: str) -> Path:
    """Where an input lies; `example` and `photo` stand for files that come with the program."""
    if given not in SHIPPED:
        return Path(given)
    return Path(str(importlib.resources.files("configs") / SHIPPED[given]))


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
    timeouts: tuple[str, ...] = ()
    share: str | None = None

    @property
    def path(self) -> Path:
        """Where the input lies."""
        return input_path(self.source)

    @property
    def run_folder(self) -> Path:
        """Where the results go."""
        name = self.source if self.source in SHIPPED else self.path.resolve().stem
        return self.out or OUTPUT_ROOT / name

    @classmethod
    def of(cls, options: argparse.Namespace) -> Self:
        """What `svim3d run` or `plan` was given."""
        return cls(
            source=options.input,
            out=options.output,
            preset=options.preset,
            overrides=(*photo_settings(options), *options.set),
            skip=frozenset(options.skip),
            start=options.start,
            until=options.until,
            only=options.only,
            force=frozenset(options.force),
            seed=options.seed,
            device=options.device,
            store=options.store,
            timeouts=tuple(options.timeout),
            share=options.share,
        )

    @property
    def command(self) -> tuple[str, ...]:
        """Arguments of `svim3d` that ask for the same; relative paths in overrides stay so."""
        source = self.source if self.source in SHIPPED else str(self.path.resolve())
        preset = resolved_preset(self.preset)
        lists = {
            "--set": self.overrides,
            "--skip": sorted(self.skip),
            "--from": [self.start],
            "--until": [self.until],
            "--only": [self.only],
            "--force": sorted(self.force),
            "--timeout": self.timeouts,
            "--share": [self.share],
        }
        return (
            *("run", source, "-o", str(self.run_folder.resolve()), "--preset", preset),
            *(f"{option}={value}" for option, values in lists.items() for value in values if value),
            *("--seed", str(self.seed), "--device", self.device),
            *("--store", str(self.store.resolve())),
        )

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
    job = Job(
        request.store,
        request.run_folder,
        request.device,
        Console(),
        command=request.command,
        share=request.share,
    )
    job.limits_s = parse_limits(request.timeouts, IMAGE_TO_ASSET.names)
    return job.carry_out(
        request.plan(job.store), {"preset": request.preset}, compute=compute_under_engine
    )


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
