"""`svim3d model`: single-file checkpoints as model folders, and what either holds."""

import argparse

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from flows.job import DONE

FAILED = 1


def model(options: argparse.Namespace) -> int:
    """Do what the action says; see `svim3d model --help`."""
    return convert(options) if options.action == "convert" else info(options)


def convert(options: argparse.Namespace) -> int:
    """Write a model folder and say what was taken, made and left out."""
    from stages import model_files

    spec, told = model_files.convert(
        options.file,
        options.out,
        groups=options.groups,
        copies=options.inflate,
        dtype=options.dtype,
    )
    console = Console()
    for line in told:
        console.print(line, highlight=False, markup=False)
    console.print(
        f"{options.out}: {spec.name}, under the licence of its source (see README.md and NOTICE)",
        highlight=False,
        markup=False,
    )
    return DONE


def info(options: argparse.Namespace) -> int:
    """Print a table; returns 1 if the model could not be used."""
    from stages import model_files

    rows, faults = model_files.describe(options.path)
    table = Table(box=None, pad_edge=False, show_header=False)
    for name, value in rows:
        table.add_row(name, escape(value))
    for fault in faults:
        table.add_row("[red]fault", f"[red]{escape(fault)}")
    Console().print(table)
    return FAILED if faults else DONE
