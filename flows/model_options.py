"""The options of `svim3d model`."""

import argparse
from pathlib import Path


def model_options(shared: argparse.ArgumentParser) -> argparse.ArgumentParser:
    """Options of `model convert` and `model info`, each with those that all commands share."""
    options = argparse.ArgumentParser(add_help=False)
    actions = options.add_subparsers(
        dest="action", metavar="ACTION", title="actions", required=True, prog="svim3d model"
    )
    convert, info = (
        actions.add_parser(
            name,
            parents=[shared],
            help=purpose,
            description=purpose[0].upper() + purpose[1:] + ".",
        )
        for name, purpose in (
            ("convert", "make a model folder of a single-file SV3D_p checkpoint"),
            ("info", "tell what a model folder or a single-file checkpoint holds"),
        )
    )
    convert.add_argument("file", type=Path, metavar="FILE", help="sv3d_p.safetensors")
    convert.add_argument("out", type=Path, metavar="OUT", help="new folder")
    convert.add_argument(
        "--groups",
        type=int,
        choices=(1, 4),
        default=4,
        help="pictures of a view: 4 adds basecolor, roughness and metallic, and normals; 1 is SV3D "
        "itself (%(default)s)",
    )
    convert.add_argument(
        "--inflate",
        choices=("mean", "copy"),
        default="mean",
        help="new input weights are the old ones divided by the number of groups, so that equal "
        "groups answer as before, or plain copies as in the paper (%(default)s)",
    )
    convert.add_argument(
        "--dtype",
        choices=("fp16", "bf16", "fp32"),
        default="fp16",
        help="of the stored weights; fp16 rounds them eight times finer than bf16 (%(default)s)",
    )
    info.add_argument("path", type=Path, metavar="PATH", help="folder or .safetensors file")
    return options
