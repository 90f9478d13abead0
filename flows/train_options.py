"""The options of `svim3d train`."""

import argparse
from pathlib import Path

SMALL = Path(__file__).resolve().parents[1] / "configs" / "svim3d-small.json"


def train_options() -> argparse.ArgumentParser:
    """Options of `train`."""
    options = argparse.ArgumentParser(add_help=False)
    options.add_argument("data", type=Path, metavar="DATA", help="what svim3d data render left")
    options.add_argument(
        "-o", "--output", type=Path, required=True, metavar="OUT", help="folder of the training run"
    )
    options.add_argument(
        "--model",
        type=Path,
        default=SMALL,
        metavar="PATH",
        help="description of a model to train from nothing (.json), or a model folder to go on "
        "from (svim3d-small)",
    )
    options.add_argument("--config", type=Path, metavar="FILE", help="settings (.yaml)")
    options.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="PART.NAME=VALUE",
        help="change one setting, like generator.batch=4; may be repeated",
    )
    options.add_argument(
        "--minutes",
        type=float,
        metavar="N",
        help="stop after so long, once latents are there; the same command goes on",
    )
    options.add_argument("--seed", type=int, default=0, help="(%(default)s)")
    options.add_argument("--device", choices=("auto", "cpu", "cuda"), default="auto")
    return options
