"""`svim3d relight`: finished views and assets under another light, perhaps in other paint.

Relighting is one stage. It runs in this process, without waiting for an engine, unless
`PREFECT_API_URL` names a server on which it should show.
"""

import argparse
import math
import os
from pathlib import Path

from rich.console import Console

from flows.commands import EXAMPLE, OUTPUT_ROOT, input_path
from flows.config import RelightRunConfig, validated
from flows.job import Job, compute_here, compute_under_engine
from flows.pipeline import RELIGHT
from flows.plan import Selection, make_plan
from stages.errors import InputError
from stages.settings.relight import MAX_FRAMES

ORBIT_INDEX, ASSET = "orbit.json", "asset.glb"
INSIDE = ("", "files")  # a folder itself, and the payload of a store's artifact
BUILT_IN_LIGHT = "studio"
SCATTERING: dict[str, bool | str] = {"on": True, "off": False, "scaled": "scaled"}


def relight(options: argparse.Namespace) -> int:
    """Relight what the command line names; see `svim3d relight --help`."""
    source = find_subject(options.input)
    settings = {
        "environment": options.env,
        "layout": "cube cross" if options.layout == "cross" else options.layout,
        "azimuths_deg": parse_turns(options.rotate),
        "exposure": options.exposure,
        "edits": tuple(options.edit),
        "mask": options.mask,
        "quality": options.quality,
        "samples": options.samples,
        "occlusion": options.occlusion == "on",
        "multiple_scattering": SCATTERING[options.multiple_scattering],
        "engine": options.engine,
        "views": parse_views(options.views),
        "turntable": options.turntable,
        "frames_per_s": options.fps,
        "orbit_views": options.orbit_views,
        "size": options.size,
        "elevation_deg": options.elevation,
        "fov_y_deg": options.fov,
    }
    given = {name: value for name, value in settings.items() if value is not None}
    _require_files(options.env, options.mask)
    config = validated(RelightRunConfig, {"relight": given})
    job = Job(options.store, _run_folder(options), options.device, Console(), options.given)
    plan = make_plan(
        RELIGHT,
        config,
        source=source,
        seed=options.seed,
        store=job.store,
        selection=Selection(force=frozenset({"relight"} if options.force else ())),
    )
    compute = compute_under_engine if "PREFECT_API_URL" in os.environ else compute_here
    return job.carry_out(plan, {}, compute=compute)


def find_subject(given: str) -> Path:
    """What an input means: an orbit folder, one frame, a mesh, or the asset of a run folder.

    Raises:
        InputError: it is none of these.
    """
    path = input_path(given)
    if not path.is_dir():
        return path
    for name in (ORBIT_INDEX, ASSET):
        for folder in (path / inside for inside in INSIDE):
            if (folder / name).is_file():
                return folder if name == ORBIT_INDEX else folder / name
    raise InputError(
        f"wanted an orbit folder (with {ORBIT_INDEX}) or a run folder (with {ASSET}), but {path} "
        "holds neither; name a .exr frame or a mesh file to relight that"
    )


def parse_turns(text: str) -> tuple[float, ...]:
    """Azimuths of `90`, or of `0:360:5`: from, up to but not with, step, in degrees.

    Raises:
        InputError: the text is neither, or the turns are none or too many.
    """
    try:
        numbers = [float(part) for part in text.split(":")]
    except ValueError:
        numbers = []
    if len(numbers) not in (1, 3) or not all(math.isfinite(number) for number in numbers):
        raise InputError(f"--rotate {text!r}: wanted degrees like 90, or START:STOP:STEP")
    if len(numbers) == 1:
        return (numbers[0],)
    start, stop, step = numbers
    # The slack lets 0:1:0.1 end before 1 in spite of rounding; the bounds keep the count finite.
    steps = (stop - start) / step if step else 0.0
    count = math.ceil(min(max(steps, 0.0), 1e6) - 1e-9)
    if not 1 <= count <= MAX_FRAMES:
        raise InputError(
            f"--rotate {text}: wanted 1 to {MAX_FRAMES} turns, but from {start:g} to {stop:g} in "
            f"steps of {step:g} there are {max(count, 0)}"
        )
    return tuple(start + index * step for index in range(count))


def parse_views(text: str) -> tuple[int, ...] | str:
    """Indices of `0,5,20`; `all` and `reference` stay as they are.

    Raises:
        InputError: the text is none of these.
    """
    if text in ("all", "reference"):
        return text
    try:
        return tuple(int(part) for part in text.split(","))
    except ValueError:
        raise InputError(f"--views {text!r}: wanted all, reference, or indices like 0,5") from None


def _require_files(*files: Path | None) -> None:
    """Refuse missing files before anything is loaded."""
    for file in files:
        if file is not None and not file.is_file():
            raise InputError(f"there is no file {file}; check the path")


def _run_folder(options: argparse.Namespace) -> Path:
    """Where the pictures go."""
    if options.output is not None:
        return Path(options.output)
    name = options.input if options.input == EXAMPLE else Path(options.input).resolve().stem
    light = options.env.stem if options.env else BUILT_IN_LIGHT
    return OUTPUT_ROOT / f"{name}-in-{light}"
