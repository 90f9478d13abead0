"""The options of `data`."""

import argparse
from pathlib import Path


def data_options() -> argparse.ArgumentParser:
    """Options of `data render`."""
    options = argparse.ArgumentParser(add_help=False)
    options.add_argument("action", choices=("render",), help="render: make training data")
    options.add_argument("output", type=Path, metavar="OUT", help="folder of the examples")
    options.add_argument(
        "--objects", type=int, required=True, metavar="N", help="examples that OUT shall hold"
    )
    options.add_argument("--seed", type=int, default=0, help="of all random numbers (%(default)s)")
    options.add_argument(
        "--size", type=int, default=64, metavar="PX", help="of the pictures (%(default)s)"
    )
    options.add_argument(
        "--views", type=int, default=21, metavar="K", help="of each object (%(default)s)"
    )
    options.add_argument(
        "--lights", type=int, default=4, metavar="E", help="of each object (%(default)s)"
    )
    options.add_argument(
        "--meshes",
        type=Path,
        metavar="FOLDER",
        help=".glb, .gltf and .obj files to show, each from a random side (objects are invented)",
    )
    options.add_argument(
        "--environments",
        type=Path,
        metavar="FOLDER",
        help=".exr and .hdr files for every other light (lights are invented)",
    )
    options.add_argument(
        "--workers", type=int, default=1, metavar="W", help="processes (%(default)s)"
    )
    _add_backend(options)
    return options


def _add_backend(options: argparse.ArgumentParser) -> None:
    """What renders RGB, and how Cycles is reached."""
    options.add_argument(
        "--backend",
        choices=("raster", "cycles"),
        default="raster",
        help="what renders RGB: the built-in rasteriser, or Blender's path tracer (%(default)s)",
    )
    options.add_argument(
        "--cycles-python",
        type=Path,
        metavar="PATH",
        help="Python 3.11 of an environment with bpy 4.5, for --backend cycles",
    )
    options.add_argument(
        "--cycles-samples", type=int, default=64, metavar="N", help="paths a pixel (%(default)s)"
    )
    options.add_argument(
        "--cycles-device",
        choices=("cpu", "gpu"),
        default="cpu",
        help="cpu: one thread for each worker (%(default)s)",
    )
    options.add_argument(
        "--cycles-timeout",
        type=float,
        default=3600.0,
        metavar="S",
        help="seconds that one example may take (%(default).0f)",
    )
