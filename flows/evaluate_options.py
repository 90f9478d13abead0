"""The options of `svim3d evaluate`."""

import argparse
from pathlib import Path

from flows.options import add_machine

SUITES = ("orbits", "stanford-orb", "poly-haven", "blender-vault", "gso")
VIEWS, PHOTO = "views", "photo"  # what an asset is made of


def evaluate_options() -> argparse.ArgumentParser:
    """Which objects, made how, held against what."""
    options = argparse.ArgumentParser(
        add_help=False,
        epilog="docs/evaluation.md tells each suite's layout, and what every figure means.",
    )
    options.add_argument(
        "suite", choices=SUITES, metavar="SUITE", help=f"the folder's layout: {', '.join(SUITES)}"
    )
    options.add_argument("folder", type=Path, metavar="FOLDER", help="of the suite's objects")
    options.add_argument(
        "-o",
        "--output",
        type=Path,
        metavar="OUT",
        help="folder of the tables (out/evaluate-SUITE-INPUT)",
    )
    options.add_argument(
        "--from",
        dest="made_from",
        choices=(PHOTO, VIEWS),
        default=PHOTO,
        help="make assets of each object's one photo, or of its true views (%(default)s)",
    )
    options.add_argument(
        "--objects", nargs="+", default=[], metavar="NAME", help="some of the objects (all)"
    )
    options.add_argument(
        "--list", action="store_true", help="name the objects that were found, and run nothing"
    )
    _add_rows(options)
    options.add_argument(
        "--size",
        type=int,
        default=256,
        metavar="PX",
        help="most rows of views that are converted to our layout (%(default)s)",
    )
    _add_networks(options)
    options.add_argument(
        "--seeds",
        type=int,
        default=1,
        metavar="N",
        help="repeat every row with N seeds, from --seed on (%(default)s)",
    )
    options.add_argument(
        "--limit",
        type=float,
        default=7200.0,
        metavar="S",
        help="seconds of an object and row (%(default)g)",
    )
    add_machine(options)
    return options


def _add_rows(options: argparse.ArgumentParser) -> None:
    """How assets are made."""
    options.add_argument(
        "--preset",
        default="standard",
        help="of the first row: tiny, preview, standard, paper or auto (%(default)s)",
    )
    options.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="STAGE.NAME=VALUE",
        help="change one setting of all rows; may be repeated",
    )
    options.add_argument(
        "--row",
        action="append",
        nargs="+",
        default=[],
        metavar=("NAME", "STAGE.NAME=VALUE"),
        help="one more row with other settings, compared with the first; preset=NAME and "
        "skip=STAGE are settings, too; may be repeated",
    )


def _add_networks(options: argparse.ArgumentParser) -> None:
    """Weights of one's own, each for a figure."""
    options.add_argument(
        "--lpips",
        type=Path,
        metavar="FILE",
        help="also tell LPIPS, by these weights: the state of lpips.LPIPS(net='alex' or 'vgg')",
    )
    options.add_argument(
        "--fid",
        type=Path,
        metavar="FILE",
        help="also tell FID of all pictures, by pytorch-fid's pt_inception-2015-12-05",
    )
    options.add_argument(
        "--clip",
        type=Path,
        metavar="FOLDER",
        help="also tell CMMD and CLIP-S, by a CLIPModel as transformers saves it (published CMMD: "
        "openai/clip-vit-large-patch14-336)",
    )
