"""The options of `svim3d stability`."""

import argparse
from pathlib import Path

TINY = "tiny"  # the word for settings of about eight CPU seconds a case


def stability_options() -> argparse.ArgumentParser:
    """Which hazards, how bad, with which settings."""
    options = argparse.ArgumentParser(add_help=False)
    options.add_argument("hazard", nargs="*", metavar="HAZARD", help="by name; all without any")
    options.add_argument("--list", action="store_true", help="name the hazards, and run nothing")
    options.add_argument(
        "-o",
        "--output",
        type=Path,
        default=Path("out/stability"),
        metavar="OUT",
        help="folder of results.jsonl, stability.csv and stability.html (%(default)s)",
    )
    options.add_argument(
        "--severities",
        type=_numbers,
        metavar="S,S,...",
        help="of each hazard's own, the harmless one and those at these shares of their number, "
        "from 0 to 1 (all)",
    )
    options.add_argument(
        "--variants",
        type=lambda text: text.split(","),
        metavar="V,V,...",
        help="of hazards that have some (all)",
    )
    options.add_argument("--seeds", type=int, default=1, metavar="N", help="(%(default)s)")
    options.add_argument(
        "--baseline",
        action="store_true",
        help="measure perturbations with the paper's plain method too",
    )
    options.add_argument(
        "--preset",
        default=TINY,
        help="tiny, preview, standard or paper (%(default)s, for pictures of 64 pixels)",
    )
    options.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="STAGE.NAME=VALUE",
        help="change one setting; may be repeated",
    )
    options.add_argument(
        "--size", type=int, default=64, metavar="PX", help="of views (%(default)s)"
    )
    options.add_argument("--views", type=int, default=12, metavar="K", help="(%(default)s)")
    options.add_argument(
        "--limit", type=float, default=300.0, metavar="S", help="seconds of a case (%(default)g)"
    )
    options.add_argument(
        "--keep",
        action="store_true",
        help="keep results of other code as well, where hazard and settings are the same",
    )
    return options


def _numbers(text: str) -> list[float]:
    """Comma-separated numbers; argparse tells of a ValueError."""
    return [float(number) for number in text.split(",")]
