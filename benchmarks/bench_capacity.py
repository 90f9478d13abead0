"""What preset `auto` saves, and what that costs: scene by scene against another preset.

    python benchmarks/bench_capacity.py [--data FOLDER] [--invented 30] [--against paper]

Scenes are a sphere of one material, a patterned one, invented objects (`random-K`) and, with
`--data` (default: SVIM3D_DATA), the path-traced orbits of that folder. Each is made into an asset
twice, by `auto` and by the preset of `--against`. Time is CPU seconds of all stages from the views
to the export; figures are those of `svim3d.render.asset_figures`: relighting under two lights
never seen (dB) and surface distance. A scene is kept where `auto` is within 0.2 dB and 2 % of the
other.

`--scale 0.25 --size 128` makes both cheaper alike: step counts by the scale, grids, textures and
rays by the views' size against 256. Results lie in `--results` as they come in; a case whose code,
settings and views are unchanged is not run again, so an interrupted benchmark goes on. The chart
shows what the plan foresaw against what the stages found to be enough.
"""

import argparse
import json
import math
import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path
from statistics import median
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from benchmarks.capacity_scenes import SIMPLE, scene_orbit  # noqa: E402
from benchmarks.pipeline_case import case_key, plan_case  # noqa: E402
from flows.config import PRESETS, PipelineConfig, load_config  # noqa: E402
from stages.store import Store  # noqa: E402

ORBITS = ("boombox", "barrel", "cat", "oculus", "spheres")
FULL_PX = 256  # size of the views that presets are made for
STAGES = ("capacity", "env_preopt", "nerf", "dmtet", "uv_bake", "export")  # whose time counts
LOST_DB, LOST_DISTANCE = 0.2, 0.02  # what `auto` may lose on a scene
LEAST_RAYS, LEAST_NODES, LEAST_TEXTURE = 512, 32, 64
CASE_TIMEOUT_S = 3600.0  # of wall clock, on a loaded machine
COLUMNS = (
    "scene",
    "CPU s",
    "of",
    "time",
    "bytes",
    "of",
    "size",
    "relit, dB",
    "change",
    "distance",
    "change",
    "steps",
    "kept",
)


def scaled(preset: str, size: int, scale: float) -> list[str]:
    """Overrides that make a preset cheaper without changing what it stands for."""
    config = load_config(PipelineConfig, preset)
    share = min(1.0, size / FULL_PX)
    steps = {s: getattr(config, s).steps for s in ("env_preopt", "nerf", "dmtet")}
    rays = max(LEAST_RAYS, 4 * round(config.nerf.rays_per_step * share**2 / 4))
    nodes = [max(LEAST_NODES, 8 * round(n * share / 8)) for n in config.nerf.grid_nodes]
    cells = max(LEAST_NODES, 8 * round(config.dmtet.cells * share / 8))
    texture = max(LEAST_TEXTURE, 2 ** round(math.log2(config.uv_bake.texture_size * share)))
    return [
        *(f"{stage}.steps={max(1, round(count * scale))}" for stage, count in steps.items()),
        f"env_preopt.max_pixels={max(100, round(config.env_preopt.max_pixels * share**2))}",
        f"nerf.rays_per_step={rays}",
        f"nerf.grid_nodes={nodes}",
        f"dmtet.cells={cells}",
        f"uv_bake.texture_size={texture}",
        f"uv_bake.max_faces={round(config.uv_bake.max_faces * share)}",
    ]


def run_case(
    scene: str, preset: str, given: argparse.Namespace, known: dict[str, Any]
) -> dict[str, Any]:
    """The result of a case: the known one if it is up to date."""
    views, truth = scene_orbit(scene, given.data, given.results / "orbits", given.size)
    overrides = [*scaled(preset, given.size, given.scale), *given.overrides]
    store = Store(given.results / "store")
    key = case_key(plan_case(views, preset, overrides, [], store=store, seed=0))
    result = known.get(f"{scene}/{preset}")
    if result is not None and (given.keep or result["key"] == key):
        return result
    with tempfile.TemporaryDirectory() as work:
        file = Path(work) / "result.json"
        command = [sys.executable, str(Path(__file__).with_name("inconsistent_case.py"))]
        command += [str(views), str(truth), "--preset", preset, "--store", str(store.root)]
        command += ["--out", str(file), *(f"--set={override}" for override in overrides)]
        path = f"{ROOT}{os.pathsep}{os.environ.get('PYTHONPATH', '')}"
        # Idle pools that spin take the cores from those that work.
        environment = {"GOMP_SPINCOUNT": "0"} | os.environ | {"PYTHONPATH": path}
        subprocess.run(
            command,
            env=environment,
            stdout=subprocess.DEVNULL,
            timeout=given.timeout,
            check=False,
        )
        if not file.exists():
            return {"key": key, "outcome": "crashed", "error": "the process left no result"}
        return json.loads(file.read_text())


def cpu_s(result: dict[str, Any]) -> float:
    """CPU seconds from the views to the export."""
    return sum(s for name, s in result["cpu_seconds"].items() if name in STAGES)


def told(result: dict[str, Any], stage: str, pattern: str) -> tuple[int, ...] | None:
    """Numbers in the first event of a stage that fits a pattern."""
    for event in result["events"].get(stage, ()):
        if found := re.match(pattern, event["message"]):
            return tuple(int(number) for number in found.groups())
    return None


def row(scene: str, auto: dict[str, Any], other: dict[str, Any]) -> dict[str, Any]:
    """A scene's figures and verdict."""
    figures, others = auto["figures"], other["figures"]
    gain = figures["relight_db"] - others["relight_db"]
    farther = figures["distance"] / others["distance"] - 1.0
    return {
        "scene": scene,
        "auto_s": cpu_s(auto),
        "other_s": cpu_s(other),
        "auto_kb": figures["file_mib"] * 1024.0,
        "other_kb": others["file_mib"] * 1024.0,
        "relight_db": figures["relight_db"],
        "gain_db": gain,
        "distance": figures["distance"],
        "farther": farther,
        "steps": told(auto, "nerf", r"steps (\d+) of (\d+)"),
        "kept": gain >= -LOST_DB and farther <= LOST_DISTANCE,
    }


def table(rows: list[dict[str, Any]], against: str) -> str:
    """All scenes, then what counts of them."""
    lines = [f"`auto` against `{against}`", "", f"| {' | '.join(COLUMNS)} |"]
    lines.append(f"|{'---|' * len(COLUMNS)}")
    for r in rows:
        steps = "" if r["steps"] is None else f"{r['steps'][0]} of {r['steps'][1]}"
        cells = (
            r["scene"],
            f"{r['auto_s']:.1f}",
            f"{r['other_s']:.1f}",
            f"{r['auto_s'] / r['other_s']:.2f}",
            f"{r['auto_kb']:.0f} k",
            f"{r['other_kb']:.0f} k",
            f"{r['auto_kb'] / r['other_kb']:.2f}",
            f"{r['relight_db']:.2f}",
            f"{r['gain_db']:+.2f}",
            f"{r['distance']:.4f}",
            f"{r['farther']:+.1%}",
            steps,
            "yes" if r["kept"] else "no",
        )
        lines.append(f"| {' | '.join(cells)} |")
    if rows:
        time, size = (
            median(r[f"auto_{unit}"] / r[f"other_{unit}"] for r in rows) for unit in ("s", "kb")
        )
        kept = sum(r["kept"] for r in rows)
        light = sum(r["gain_db"] >= -LOST_DB for r in rows)
        near = sum(r["farther"] <= LOST_DISTANCE for r in rows)
        lines += [
            "",
            f"Medians: {time:.2f} of the time, {size:.2f} of the size, "
            f"{median(r['gain_db'] for r in rows):+.2f} dB, "
            f"{median(r['farther'] for r in rows):+.1%} distance. Kept: {kept} of {len(rows)} "
            f"({light} by relighting, {near} by distance).",
        ]
    return "\n".join(lines)


def foreseen(auto: dict[str, Any]) -> dict[str, tuple[float, float]]:
    """Of faces, texels per side and steps: what was foreseen (or allowed) and what was enough."""
    found = {}
    faces = told(auto, "uv_bake", r"(\d+) of at most (\d+) faces")
    if faces is not None:
        found["faces"] = (float(faces[1]), float(faces[0]))
    sizes = [
        told({"events": {"uv_bake": [event]}}, "uv_bake", r"\w+ size: (\d+) of (\d+) px")
        for event in auto["events"].get("uv_bake", ())
    ]
    drawn = [size for size in sizes if size is not None]
    if drawn:
        found["texels per side"] = (float(drawn[0][1]), float(max(size[0] for size in drawn)))
    steps = told(auto, "nerf", r"steps (\d+) of (\d+)")
    if steps is not None:
        found["steps of phase 1"] = (float(steps[1]), float(steps[0]))
    return found


def draw(rows: list[dict[str, Any]], autos: dict[str, dict[str, Any]], file: Path) -> None:
    """Ratios scene by scene, and predictions against what was enough."""
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(1, 4, figsize=(18, 4.5), layout="constrained")
    place = range(len(rows))
    axes[0].barh([p + 0.2 for p in place], [r["auto_s"] / r["other_s"] for r in rows], 0.4)
    axes[0].barh([p - 0.2 for p in place], [r["auto_kb"] / r["other_kb"] for r in rows], 0.4)
    axes[0].set(yticks=list(place), yticklabels=[r["scene"] for r in rows], xlabel="auto / other")
    axes[0].axvline(0.25, color="grey", linestyle=":")
    axes[0].legend(["a quarter", "CPU time", "file size"], fontsize=8)
    for r in rows:
        axes[1].plot(r["gain_db"], 100.0 * r["farther"], "o" if r["kept"] else "x", color="C0")
        axes[1].annotate(r["scene"], (r["gain_db"], 100.0 * r["farther"]), fontsize=6)
    axes[1].axvline(-LOST_DB, color="grey", linestyle=":")
    axes[1].axhline(100.0 * LOST_DISTANCE, color="grey", linestyle=":")
    axes[1].set(xlabel="relighting, change in dB", ylabel="surface distance, change in %")
    for axis, names in ((axes[2], ("faces",)), (axes[3], ("texels per side", "steps of phase 1"))):
        for name in names:
            points = [p for a in autos.values() if (p := foreseen(a).get(name)) is not None]
            axis.plot([p[0] for p in points], [p[1] for p in points], "o", label=name, alpha=0.6)
        limits = axis.get_xlim()
        axis.plot(limits, limits, color="grey", linestyle=":")
        axis.set(xlabel="foreseen", ylabel="enough", xscale="log", yscale="log")
        axis.legend(fontsize=8)
    figure.savefig(file, dpi=100)
    pyplot.close(figure)


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    data = os.environ.get("SVIM3D_DATA")
    parser.add_argument("--data", type=Path, default=None if data is None else Path(data))
    parser.add_argument("--invented", type=int, default=30, help="number of invented objects")
    parser.add_argument("--scenes", nargs="+", help="names instead of all scenes")
    others = [preset for preset in PRESETS if preset != "auto"]
    parser.add_argument("--against", choices=others, default="paper")
    parser.add_argument("--size", type=int, default=FULL_PX, help="side of the views, pixels")
    parser.add_argument("--scale", type=float, default=1.0, help="of all step counts")
    parser.add_argument("--set", action="append", default=[], dest="overrides")
    parser.add_argument("--timeout", type=float, default=CASE_TIMEOUT_S, help="of a case, s")
    parser.add_argument("--keep", action="store_true", help="keep results of other code as well")
    parser.add_argument(
        "--results", type=Path, default=ROOT / "benchmarks" / "results" / "capacity"
    )
    given = parser.parse_args(arguments)
    orbits = ORBITS if given.data is not None else ()
    invented = [f"random-{number}" for number in range(given.invented)]
    given.scenes = given.scenes or [*SIMPLE, *orbits, *invented]
    return given


def main() -> int:
    given = parse()
    given.results.mkdir(parents=True, exist_ok=True)
    file = given.results / f"{given.against}-{given.size}-{given.scale:g}.json"
    known: dict[str, Any] = json.loads(file.read_text()) if file.exists() else {}
    rows, autos = [], {}
    for scene in given.scenes:
        pair = []
        for preset in ("auto", given.against):
            result = run_case(scene, preset, given, known)
            known[f"{scene}/{preset}"] = result
            draft = file.with_suffix(".tmp")
            draft.write_text(json.dumps(known, indent=1))
            draft.replace(file)
            pair.append(result)
        if any(result["outcome"] != "asset" for result in pair):
            print(f"{scene}: {[result.get('error', 'asset') for result in pair]}", flush=True)
            continue
        autos[scene] = pair[0]
        rows.append(row(scene, *pair))
        print(table(rows[-1:], given.against).splitlines()[-3], flush=True)
    text = table(rows, given.against)
    file.with_suffix(".md").write_text(text + "\n")
    if rows:
        draw(rows, autos, file.with_suffix(".png"))
    print(text)
    return int(len(rows) != len(given.scenes))


if __name__ == "__main__":
    sys.exit(main())
