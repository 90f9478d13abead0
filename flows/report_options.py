"""The options of `svim3d report` and `svim3d view`."""

import argparse
from pathlib import Path


def report_options() -> argparse.ArgumentParser:
    """Which run, and where its page goes."""
    options = argparse.ArgumentParser(add_help=False)
    options.add_argument(
        "run", metavar="RUN", help="an id or its beginning, a run folder, or that one's name"
    )
    options.add_argument(
        "-o", "--output", type=Path, metavar="FILE", help="page (report.html in the run folder)"
    )
    options.add_argument(
        "--most-mib",
        type=float,
        metavar="MIB",
        help="of the asset inside the page; larger ones get smaller textures there (8)",
    )
    return options


def view_options() -> argparse.ArgumentParser:
    """What to look at, and where to serve it."""
    options = argparse.ArgumentParser(add_help=False)
    options.add_argument(
        "subject",
        metavar="RUN|ASSET",
        help="a run (id, folder or its name), which may still be at work, or a .glb file",
    )
    options.add_argument(
        "--host", default="127.0.0.1", help="where to listen (%(default)s: this machine alone)"
    )
    options.add_argument("--port", type=int, default=8080, metavar="N", help="(%(default)s)")
    return options
