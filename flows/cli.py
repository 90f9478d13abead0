"""The `svim3d` command: parse, then call what does the work.

Nothing heavy is imported before the command is known: `--help` answers at once, and a run that the
store can answer never loads torch or Prefect.
"""

import argparse
import importlib
import os
import sys
import traceback
from collections.abc import Iterator, Sequence

from flows.batch_options import batch_options
from flows.chart_options import chart_options
from flows.data_options import data_options
from flows.evaluate_options import evaluate_options
from flows.model_options import model_options
from flows.operator_options import (
    ON_END,
    ON_FAILURE,
    hook_options,
    logs_options,
    resume_options,
    status_options,
    store_options,
)
from flows.options import (
    edit_options,
    export_options,
    job_options,
    relight_options,
    shared_options,
)
from flows.report_options import report_options, view_options
from flows.serve_options import serve_options
from flows.stability_options import stability_options
from flows.train_options import train_options

DONE, FAILED, BAD_INPUT, CANCELLED = 0, 1, 2, 130

# Commands whose options go to the function of the same name in a module of their own.
DOERS = {
    "batch": "flows.batch",
    "relight": "flows.relight",
    "edit": "flows.edit",
    "export": "flows.export",
    "train": "flows.train",
    "data": "flows.data",
    "model": "flows.model",
    "serve": "flows.serve",
    "automations": "flows.automations",
    "status": "flows.runs",
    "resume": "flows.runs",
    "logs": "flows.runs",
    "store": "flows.store",
    "stability": "flows.stability",
    "chart": "flows.chart",
    "evaluate": "flows.evaluate",
    "report": "flows.report.command",
    "view": "flows.view",
}

# Thread pools that spin while they wait starve each other: two of them on two cores made the
# slowest tenth of 23 ms steps six times as long. Must be set before torch is imported.
THREADING = {"GOMP_SPINCOUNT": "0", "KMP_BLOCKTIME": "0"}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    for name, value in THREADING.items():
        os.environ.setdefault(name, value)
    parser = _parser()
    options = parser.parse_args(arguments)
    options.given = tuple(sys.argv[1:] if arguments is None else arguments)
    if options.command is None:
        parser.print_help()
        return BAD_INPUT
    for name, option in ((ON_FAILURE, "on_failure"), (ON_END, "on_end")):
        if (hook := getattr(options, option, None)) is not None:
            os.environ[name] = hook  # for all that this command starts, too
    try:
        return _dispatch(options)
    except KeyboardInterrupt:
        print("cancelled; the same command goes on where this one stopped", file=sys.stderr)
        return CANCELLED
    except Exception as error:
        from stages.errors import InputError

        if options.debug:
            traceback.print_exc()
        print(f"svim3d: {error or type(error).__name__}", file=sys.stderr)
        if isinstance(error, InputError):
            return BAD_INPUT
        if not options.debug:
            print("svim3d: run again with --debug for the whole traceback", file=sys.stderr)
        return FAILED


def _dispatch(options: argparse.Namespace) -> int:
    if options.command == "doctor":
        from flows.doctor import doctor

        return doctor(options.store)
    if options.command in DOERS:
        return getattr(importlib.import_module(DOERS[options.command]), options.command)(options)
    from flows import commands

    if options.command == "presets":
        return commands.show_presets()
    request = commands.Request.of(options)
    return commands.show_plan(request) if options.command == "plan" else commands.run(request)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="svim3d", description="A photo or views of an object in, a relightable 3D asset out."
    )
    parser.add_argument("--version", action=_Version, nargs=0, help="print the version and exit")
    shared = shared_options()
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", title="commands")
    for name, parents, purpose in _commands(shared):
        commands.add_parser(
            name, parents=parents, help=purpose, description=purpose[0].upper() + purpose[1:] + "."
        )
    return parser


def _commands(
    shared: argparse.ArgumentParser,
) -> Iterator[tuple[str, list[argparse.ArgumentParser], str]]:
    """Each command with the parsers of its options and what it is for."""
    job, hooks = job_options(), hook_options()
    yield from (
        ("run", [job, hooks, shared], "make the asset; finished stages are taken from the store"),
        ("batch", [batch_options(), hooks, shared], "make the assets of many inputs"),
        (
            "relight",
            [relight_options(), hooks, shared],
            "show views or an asset under another light",
        ),
        ("edit", [edit_options(), shared], "write an asset with other materials"),
        ("export", [export_options(), shared], "write a finished run's asset in other formats"),
        ("train", [train_options(), shared], "train a generator on rendered examples"),
        ("data", [data_options(), shared], "render training data for the generator"),
        ("model", [model_options(shared)], "convert a checkpoint, or tell what a model holds"),
        ("plan", [job, shared], "say which stages a run would compute, and why"),
        ("status", [status_options(), shared], "tell how runs go and went"),
        (
            "resume",
            [resume_options(), hooks, shared],
            "carry out again what did not come to its end",
        ),
        ("logs", [logs_options(), shared], "print what the stages of a run said"),
        ("report", [report_options(), shared], "write the page of a run again"),
        ("view", [view_options(), shared], "look at an asset, or at a run while it goes on"),
        ("store", [store_options(shared)], "look at the artifacts, clean up, move them"),
        (
            "serve",
            [serve_options(), hooks, shared],
            "do what a Prefect server, or HTTP, asks for",
        ),
        ("automations", [shared], "let a Prefect server find and resume runs that were killed"),
        ("stability", [stability_options(), shared], "run the suite of hazards, and report"),
        (
            "chart",
            [chart_options(), shared],
            "measure what settings cost and give, and draw their front",
        ),
        (
            "evaluate",
            [evaluate_options(), shared],
            "score assets of a benchmark's objects against the truth",
        ),
        ("presets", [shared], "list the presets: their steps and what they leave out"),
        ("doctor", [shared], "describe this machine, the installation and the store"),
    )


class _Version(argparse.Action):
    """Prints the installed version; metadata is read only when it is asked for."""

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
        from importlib.metadata import PackageNotFoundError, version

        try:
            print(f"svim3d {version('svim3d')}")
        except PackageNotFoundError:
            print("svim3d (not installed: running from a checkout)")
        parser.exit()


if __name__ == "__main__":
    sys.exit(main())
