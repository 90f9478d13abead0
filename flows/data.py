"""`svim3d data render`: training data for the generator."""

import argparse

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeRemainingColumn

from flows.job import DONE
from stages.errors import InputError

BOUNDS = {
    "objects": (1, 10_000_000),
    "size": (8, 1024),
    "views": (1, 512),
    "lights": (1, 64),
    "workers": (1, 256),
    "cycles_samples": (1, 65_536),
    "cycles_timeout": (1, 1_000_000),
}


def data(options: argparse.Namespace) -> int:
    """Render what is missing, tell of files that were left out, and what there is now."""
    for name, (least, most) in BOUNDS.items():
        given = getattr(options, name)
        if not least <= given <= most:
            option = "--" + name.replace("_", "-")
            raise InputError(f"{option}: wanted {least} to {most}, got {given}; choose another")
    from stages.data_render import (
        DataRequest,
        cycles_with,
        environment_files,
        mesh_files,
        render_data,
    )
    from stages.store import Store

    cycles = None
    if options.backend == "cycles":
        cycles = cycles_with(
            options.cycles_python,
            samples=options.cycles_samples,
            device=options.cycles_device,
            timeout_s=options.cycles_timeout,
        )
    request = DataRequest(
        folder=options.output,
        seed=options.seed,
        size=options.size,
        views=options.views,
        lights=options.lights,
        meshes=mesh_files(options.meshes),
        environments=environment_files(options.environments),
        cache=Store(options.store).shared,
        cycles=cycles,
    )
    console = Console()
    tally = {"made": 0, "kept": 0, "skipped": 0}
    told = set()
    columns = ("{task.description}", BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, disable=not console.is_terminal) as bars:
        bar = bars.add_task("rendering", total=options.objects)
        for outcome in render_data(request, options.objects, options.workers):
            tally[outcome.status] += 1
            if outcome.message and outcome.message not in told:
                told.add(outcome.message)
                console.print(outcome.message, style="yellow", highlight=False, markup=False)
            bars.advance(bar)
    counts = ", ".join(f"{count} {status}" for status, count in tally.items() if count)
    console.print(f"{options.output}: {counts}", highlight=False, soft_wrap=True)
    return DONE
