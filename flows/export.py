"""`svim3d export`: a finished run's asset in other formats, from what the store holds."""

import argparse
import contextlib
import json
import shlex
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from rich.console import Console

from flows.commands import Request
from flows.job import Job, compute_here
from flows.options import job_options, shared_options
from flows.pipeline import IMAGE_TO_ASSET
from flows.plan import Plan
from flows.run_records import RunIndex, RunRecord
from stages.errors import InputError

WRITERS = ("export", "preview")  # stages that read the finished asset or write it: seconds
GLB = "glb"
BOUNDS = ("--until", "--only")  # options that end a run before its asset


def export(options: argparse.Namespace) -> int:
    """Write the files that the command line names into the run's folder."""
    record = RunIndex(options.store).find(options.run)
    request = again(record, settings_of(options))
    if options.output is not None:
        request = replace(request, out=options.output.resolve())
    request = replace(request, store=options.store.resolve(), device=options.device)
    # Settings may name files by the place where the run was started.
    with _within(record):
        job = Job(
            request.store, request.run_folder, request.device, Console(), command=request.command
        )
        plan = request.plan(job.store)
        _require_finished(plan, record)
        return job.carry_out(plan, {"preset": request.preset}, compute=compute_here)


def settings_of(options: argparse.Namespace) -> tuple[str, ...]:
    """What the options mean, as `--set` would say it.

    Raises:
        InputError: nothing is asked for.
    """
    given: dict[str, object] = {}
    if options.formats is not None:
        names = [name.strip() for name in options.formats.split(",") if name.strip()]
        given["formats"] = [GLB, *(name for name in names if name != GLB)]
    if options.lods is not None:
        given["lods"] = options.lods
    if options.compression is not None:
        given["compression"] = options.compression
    if not given:
        raise InputError("svim3d export: wanted --formats, --lods or --compression, got none")
    return tuple(f"export.{name}={json.dumps(value)}" for name, value in given.items())


def again(record: RunRecord, settings: Sequence[str]) -> Request:
    """What a run asked for, whole, with other settings.

    Raises:
        InputError: the run made no asset, or left no command.
    """
    if record.pipeline != IMAGE_TO_ASSET.name or record.command[:1] != ("run",):
        raise InputError(
            f"wanted a run that makes an asset, but {record.id} is of {record.pipeline} or left no "
            "command; svim3d status lists the runs"
        )
    parser = argparse.ArgumentParser(parents=[job_options(), shared_options()], exit_on_error=False)
    try:
        options, _ = parser.parse_known_args(record.command[1:])
    except argparse.ArgumentError as error:
        raise InputError(f"the command of {record.id} cannot be given again: {error}") from error
    request = Request.of(options)
    return replace(
        request,
        overrides=(*request.overrides, *settings),
        start=None,
        until=None,
        only=None,
        force=frozenset(),
    )


def _require_finished(plan: Plan, record: RunRecord) -> None:
    """Refuse what would take more than the export.

    Raises:
        InputError: naming the stages that are missing, and how to have them.
    """
    missing = [step for step in plan.to_compute if step.node.name not in WRITERS]
    if missing:
        first = missing[0]
        raise InputError(
            f"wanted a finished run, but {', '.join(s.node.name for s in missing)} of {record.id} "
            f"are not in the store ({first.node.name}: {first.reason}); carry it out again"
            f"{_how(record)}"
        )


def _how(record: RunRecord) -> str:
    """What brings a run to its end: one that was asked to stop before it would do so again."""
    if any(word.partition("=")[0] in BOUNDS for word in record.command):
        return f" without {', '.join(BOUNDS)}: svim3d {shlex.join(record.command)}"
    return f": svim3d resume {record.id}"


def _within(record: RunRecord) -> contextlib.AbstractContextManager[None]:
    """The folder that the run was started in, where it is still there."""
    if Path(record.cwd).is_dir():
        return contextlib.chdir(record.cwd)
    return contextlib.nullcontext()
