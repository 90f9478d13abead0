"""The options of `svim3d batch`."""

import argparse
from pathlib import Path

from flows.options import add_machine, add_photo, add_settings, add_share, add_timeout


def batch_options() -> argparse.ArgumentParser:
    """Many inputs, one set of settings, and how many at a time."""
    options = argparse.ArgumentParser(add_help=False)
    options.add_argument(
        "input",
        nargs="+",
        metavar="INPUT",
        help="a manifest (.csv with a column 'input', or .jsonl; further columns are name, preset, "
        "seed, skip and settings like nerf.steps), a folder, a quoted pattern, or inputs",
    )
    options.add_argument(
        "-o",
        "--output",
        type=Path,
        required=True,
        metavar="OUT",
        help="folder for results.csv and a run folder per input",
    )
    add_settings(options)
    add_photo(options)
    add_timeout(options)
    add_share(options)
    add_machine(options)
    how = options.add_argument_group("many at a time")
    how.add_argument(
        "--jobs",
        type=int,
        default=1,
        metavar="N",
        help="inputs at a time; cores are shared out, a GPU takes one stage at a "
        "time (%(default)s)",
    )
    how.add_argument(
        "--runner",
        choices=("local", "dask", "ray"),
        default="local",
        help="processes of this machine, or a cluster (%(default)s)",
    )
    how.add_argument(
        "--address",
        metavar="URL",
        help="of a Dask or Ray cluster; without it one is started here for N inputs at a time",
    )
    return options
