"""The options of each command."""

import argparse
import json
from pathlib import Path

from flows.operator_options import RUN_HELP
from flows.pipeline import IMAGE_TO_ASSET

DEFAULT_STORE = Path(".svim3d")
STAGES = ", ".join(IMAGE_TO_ASSET.names)


def job_options() -> argparse.ArgumentParser:
    """Options that say what to make, shared by `run` and `plan`."""
    job = argparse.ArgumentParser(add_help=False, epilog=f"Stages: {STAGES}.")
    job.add_argument(
        "input",
        nargs="?",
        default="example",
        metavar="INPUT",
        help="a photo (.png, .jpg, .webp, .tif, ...), an orbit folder, a .glb, .gltf or .obj file, "
        "a scene file (.json), or one of the words 'photo' and 'example' (the default)",
    )
    job.add_argument(
        "-o", "--output", type=Path, metavar="OUT", help="run folder (out/<name of the input>)"
    )
    add_settings(job)
    add_photo(job)
    for option, target, purpose in (
        ("--from", "start", "recompute this stage and all after it"),
        ("--until", "until", "stop after this stage"),
        ("--only", "only", "this stage alone; what it needs must be in the store"),
    ):
        job.add_argument(option, dest=target, metavar="STAGE", help=purpose)
    job.add_argument(
        "--force",
        action="extend",
        type=_names,
        default=[],
        metavar="STAGE,...",
        help="recompute stages though nothing changed; may be repeated",
    )
    add_timeout(job)
    add_share(job)
    add_machine(job)
    return job


def shared_options() -> argparse.ArgumentParser:
    """Options that all commands have."""
    shared = argparse.ArgumentParser(add_help=False)
    shared.add_argument("--debug", action="store_true", help="show whole tracebacks")
    shared.add_argument(
        "--store",
        type=Path,
        default=DEFAULT_STORE,
        metavar="DIR",
        help="where artifacts are kept (%(default)s)",
    )
    return shared


def _names(text: str) -> list[str]:
    """Names between commas."""
    return [name.strip() for name in text.split(",")]


def add_share(parser: argparse.ArgumentParser) -> None:
    """The option for a store that machines share."""
    parser.add_argument(
        "--share",
        metavar="URL",
        help="also fetch artifacts from, and publish them to, a store that other machines use: "
        "file:///mnt/..., s3://bucket/... (pip install 'svim3d[s3]'), or what else fsspec knows",
    )


def add_settings(parser: argparse.ArgumentParser) -> None:
    """Preset, single settings, and what is left out."""
    parser.add_argument(
        "--preset",
        default="standard",
        help="preview, standard, paper, auto, or a .yaml file like those (%(default)s)",
    )
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="STAGE.NAME=VALUE",
        help="change one setting; may be repeated",
    )
    parser.add_argument(
        "--skip",
        action="extend",
        type=_names,
        default=[],
        metavar="STAGE,...",
        help=f"leave stages out ({', '.join(IMAGE_TO_ASSET.skippable)}); may be repeated",
    )


def add_timeout(parser: argparse.ArgumentParser) -> None:
    """The option for time limits; `flows.limits` reads it."""
    parser.add_argument(
        "--timeout",
        action="append",
        default=[],
        metavar="[STAGE=]SECONDS",
        help="stop a stage (without a name: any) that runs longer; what it has done so far is "
        "kept; may be repeated",
    )


def add_photo(job: argparse.ArgumentParser) -> None:
    """Short forms of settings that most photos are run with."""
    photo = job.add_argument_group("photos")
    photo.add_argument(
        "--samples",
        type=int,
        metavar="K",
        help="draw K orbits, keep the most agreed-on one and trust each pixel accordingly (1)",
    )
    photo.add_argument(
        "--model", type=Path, metavar="DIR", help="folder of the generator (the bundled one)"
    )
    photo.add_argument(
        "--matting",
        metavar="HOW",
        help="what cuts the object out: auto, alpha, plain, network, or a network's .onnx file "
        "(auto)",
    )


def photo_settings(options: argparse.Namespace) -> tuple[str, ...]:
    """What those options mean, as `--set` would say it."""
    given = {"generation.samples": options.samples, "generation.model": options.model}
    if options.matting is not None:
        is_file = options.matting.lower().endswith(".onnx")
        given["prepare.network" if is_file else "prepare.matting"] = options.matting
    # Quoted as JSON, which YAML reads too: paths may hold any character.
    return tuple(
        f"{name}={json.dumps(value if isinstance(value, int) else str(value))}"
        for name, value in given.items()
        if value is not None
    )


def relight_options() -> argparse.ArgumentParser:
    """Options of `relight`."""
    options = argparse.ArgumentParser(add_help=False)
    options.add_argument(
        "input",
        metavar="INPUT",
        help="an orbit folder, one frame of it (.exr), a .glb, .gltf or .obj asset, a run folder, "
        "or the word 'example'",
    )
    options.add_argument(
        "-o", "--output", type=Path, metavar="OUT", help="folder (out/<input>-in-<light>)"
    )
    _add_light_and_paint(options)
    _add_rendering(options)
    add_machine(options)
    options.add_argument("--force", action="store_true", help="compute again though it is there")
    return options


def export_options() -> argparse.ArgumentParser:
    """Options of `export`."""
    options = argparse.ArgumentParser(add_help=False)
    options.add_argument("run", metavar="RUN", help=RUN_HELP)
    options.add_argument(
        "--formats",
        metavar="NAMES",
        help="of obj, usdc, usdz, textures and aov, with commas between; glb is always written",
    )
    options.add_argument("--lods", type=int, metavar="N", help="coarser levels of detail, up to 3")
    options.add_argument(
        "--compression",
        choices=("none", "quantised", "draco"),
        help="of a second, smaller asset_small.glb",
    )
    options.add_argument(
        "-o",
        "--output",
        type=Path,
        metavar="OUT",
        help="folder (the run's, which is laid out anew)",
    )
    options.add_argument(
        "--device", choices=("auto", "cpu", "cuda"), default="auto", help="(%(default)s)"
    )
    return options


def edit_options() -> argparse.ArgumentParser:
    """Options of `edit`."""
    options = argparse.ArgumentParser(add_help=False)
    options.add_argument("input", type=Path, metavar="ASSET", help="a .glb file")
    options.add_argument(
        "-o", "--output", type=Path, metavar="FILE", help="new .glb (ASSET-edited.glb beside it)"
    )
    _add_edit(options)
    options.add_argument(
        "--mask", type=Path, metavar="FILE", help="region in texture space; white is edited"
    )
    options.add_argument(
        "--replay",
        type=Path,
        metavar="FILE",
        help="edits.json that svim3d relight left beside views of this asset",
    )
    return options


def _add_edit(parser: argparse.ArgumentParser | argparse._ArgumentGroup) -> None:
    parser.add_argument(
        "--edit",
        action="append",
        default=[],
        metavar="EDIT",
        help="like 'roughness*0.5', 'basecolor=#aa3311' or 'metallic=1'; may be repeated",
    )


def _add_light_and_paint(options: argparse.ArgumentParser) -> None:
    light = options.add_argument_group("light")
    light.add_argument(
        "--env", type=Path, metavar="FILE", help=".exr, .hdr or a picture (built-in studio)"
    )
    light.add_argument(
        "--layout",
        choices=("auto", "latlong", "octahedral", "cross"),
        help="how the picture shows directions (auto: by its sides)",
    )
    light.add_argument(
        "--rotate",
        default="0",
        metavar="DEG",
        help="turn the light counter-clockwise seen from above: degrees, or START:STOP:STEP for a "
        "turntable; write negative ones as --rotate=-90 (0)",
    )
    light.add_argument(
        "--exposure", type=float, metavar="STOPS", help="brighten pictures, not EXR files (0)"
    )
    paint = options.add_argument_group("materials")
    _add_edit(paint)
    paint.add_argument(
        "--mask",
        type=Path,
        metavar="FILE",
        help="region drawn on the reference view, white is edited; depth carries it to the others",
    )


def _add_rendering(options: argparse.ArgumentParser) -> None:
    how = options.add_argument_group("rendering")
    how.add_argument("--quality", choices=("fast", "exact"), help="split sum, or sampling (fast)")
    how.add_argument("--samples", type=int, metavar="N", help="per pixel, where sampled (256)")
    how.add_argument("--occlusion", choices=("on", "off"), default="on", help="(%(default)s)")
    how.add_argument(
        "--multiple-scattering",
        choices=("on", "off", "scaled"),
        default="on",
        help="what rough metals lose to one bounce comes back from everywhere, not at all, or "
        "scales the bounce (%(default)s)",
    )
    how.add_argument(
        "--engine", choices=("raster", "path"), help="for assets; path needs svim3d[path] (raster)"
    )
    views = options.add_argument_group("views")
    views.add_argument(
        "--views", default="all", metavar="WHICH", help="all, reference, or indices like 0,5 (all)"
    )
    views.add_argument(
        "--turntable", choices=("gif", "mp4", "png", "none"), help="mp4 needs ffmpeg (gif)"
    )
    views.add_argument("--fps", type=int, metavar="N", help="frames per second (20)")
    views.add_argument("--size", type=int, metavar="PX", help="of an asset's views (512)")
    views.add_argument("--orbit-views", type=int, metavar="N", help="around an asset (8)")
    views.add_argument("--elevation", type=float, metavar="DEG", help="of those cameras (10)")
    views.add_argument("--fov", type=float, metavar="DEG", help="vertical, of those cameras (33.8)")


def add_machine(parser: argparse.ArgumentParser) -> None:
    """What decides how numbers come about, shared by all commands that compute."""
    parser.add_argument("--seed", type=int, default=0, help="of all random numbers (%(default)s)")
    parser.add_argument(
        "--device", choices=("auto", "cpu", "cuda"), default="auto", help="(%(default)s)"
    )
