"""The options of `svim3d chart`."""

import argparse
from pathlib import Path

NONE = "none"  # the word for an empty list


def chart_options() -> argparse.ArgumentParser:
    """What is measured, on which objects."""
    options = argparse.ArgumentParser(add_help=False)
    options.add_argument(
        "orbit",
        nargs="*",
        type=Path,
        metavar="ORBIT",
        help="folders of views with their truth: test views under three lights, those lights, a "
        "mesh; without any, objects are invented and rendered",
    )
    options.add_argument(
        "-o",
        "--output",
        type=Path,
        default=Path("out/chart"),
        metavar="OUT",
        help="folder of results.jsonl, cases.csv, chart.csv, .md, .png, .svg and .html, and the "
        "recommended presets (%(default)s)",
    )
    _add_points(options)
    options.add_argument(
        "--photos",
        action="store_true",
        help="start from each orbit's photo instead of its views; turns the generator's knobs, too",
    )
    options.add_argument(
        "--size", type=int, metavar="PX", help="average all given views down to this (as they are)"
    )
    options.add_argument(
        "--invented",
        type=int,
        default=3,
        metavar="N",
        help="objects to invent where no ORBIT is given (%(default)s)",
    )
    options.add_argument(
        "--repeats",
        type=int,
        default=2,
        metavar="N",
        help="seeds of the base; what they differ by is noise (%(default)s)",
    )
    options.add_argument(
        "--jobs", type=int, default=1, metavar="N", help="cases at a time (%(default)s)"
    )
    options.add_argument(
        "--limit", type=float, default=7200.0, metavar="S", help="seconds of a case (%(default)g)"
    )
    options.add_argument(
        "--keep", action="store_true", help="take results of other code and settings as well"
    )
    return options


def _add_points(options: argparse.ArgumentParser) -> None:
    points = options.add_argument_group("points")
    points.add_argument(
        "--base",
        default="preview",
        metavar="PRESET",
        help="a preset, or a .yaml file, that knobs are turned at (%(default)s)",
    )
    points.add_argument(
        "--presets",
        type=_names,
        default=["preview", "standard", "paper", "auto"],
        metavar="P,P,...",
        help="measured as they are, beside the base (preview,standard,paper,auto), or none",
    )
    points.add_argument(
        "--knobs",
        type=_names,
        metavar="K,K,...",
        help="by name, or K:V+V for some values of one alone, or none (all; see --list)",
    )
    points.add_argument(
        "--scales",
        type=_numbers,
        metavar="F,F,...",
        help="factors of all step counts of the base together (0.25,0.5,2,4), or none",
    )
    points.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="STAGE.NAME=VALUE",
        help="change one setting of all points; may be repeated",
    )
    points.add_argument(
        "--quick",
        action="store_true",
        help="the base, standard and the ends of the knobs that matter most",
    )
    points.add_argument("--list", action="store_true", help="name the points, and run nothing")


def _names(text: str) -> list[str]:
    """Comma-separated words; `none` is the empty list."""
    return [name.strip() for name in text.split(",") if name.strip() not in ("", NONE)]


def _numbers(text: str) -> list[float]:
    """Comma-separated numbers."""
    try:
        return [float(number) for number in _names(text)]
    except ValueError as error:
        raise argparse.ArgumentTypeError(
            f"wanted numbers like 0.5,2, or none, got {text!r}"
        ) from error
