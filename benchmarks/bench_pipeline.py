"""The pipeline's cost and quality: seconds, memory and figures per preset and asset, and a chart.

    python benchmarks/bench_pipeline.py --data FOLDER [--assets barrel cat] [--presets preview]

`--data` (default: the environment variable SVIM3D_DATA) holds `orbits/<asset>` folders of
path-traced views with test views, lights and true meshes. Each case runs in a process of its own.
Results lie in `benchmarks/results`; a case whose code, settings and input are unchanged is not run
again, so an interrupted benchmark goes on. `--steps` adds points between the presets: the standard
preset with that many steps of phase 1 and phase 2's in proportion.
"""

import argparse
import csv
import json
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from pipeline_case import case_key, plan_case  # noqa: E402

from flows.config import PipelineConfig, load_config  # noqa: E402
from stages.store import Store  # noqa: E402

ASSETS = ("boombox", "barrel", "cat", "oculus", "spheres")
PRESETS = ("preview", "standard", "paper")
STEPS = (200, 400, 1600)
STEPPED = "standard"  # the preset whose step counts are varied


@dataclass(frozen=True)
class Figure:
    """A column of the table and a panel of the chart."""

    name: str
    title: str
    digits: int
    is_better_high: bool = False


FIGURES = (
    Figure("distance", "surface distance", 4),
    Figure("to_asset", "truth to asset", 4),
    Figure("to_truth", "asset to truth", 4),
    Figure("volume_iou", "volume IoU", 3, True),
    Figure("normal_deg", "normal error, deg", 1),
    Figure("basecolor_db", "basecolor, dB", 1, True),
    Figure("relight_delta_db", "relight - ideal, dB", 2, True),
    Figure("light_error", "light error", 2),
)
CHARTED = ("distance", "volume_iou", "normal_deg", "basecolor_db", "relight_delta_db", "peak_mib")


def target(preset: str, asset: str, figure: str) -> float | None:
    """The value that must be met, None where there is no target."""
    if preset == "preview":
        return {"distance": 0.010, "basecolor_db": 22.0, "total_s": 60.0, "peak_mib": 3072.0}.get(
            figure
        )
    if preset != "standard":
        return None
    if figure == "distance":
        return 0.005 if asset in ("boombox", "barrel", "cat") else 0.008
    if figure == "volume_iou":
        return 0.93 if asset in ("boombox", "barrel") else None
    return {
        "normal_deg": 8.0,
        "basecolor_db": 26.0,
        "relight_delta_db": -1.5,
        "light_error": 0.25 if asset == "spheres" else None,
        "total_s": 240.0,
        "peak_mib": 4096.0,
    }.get(figure)


def step_overrides(steps: int) -> list[str]:
    """The standard preset with `steps` of phase 1 and phase 2's in proportion."""
    config = load_config(PipelineConfig, STEPPED)
    refined = max(1, round(steps * config.dmtet.steps / config.nerf.steps))
    return [f"nerf.steps={steps}", f"dmtet.steps={refined}"]


def run(asset: str, point: str, given: argparse.Namespace) -> dict[str, Any] | None:
    """The result of one case, from its file if that is up to date."""
    orbit = given.data / "orbits" / asset
    is_preset = point in PRESETS
    preset = point if is_preset else STEPPED
    overrides = [*given.overrides, *([] if is_preset else step_overrides(int(point)))]
    store = Store(given.store)
    plan = plan_case(orbit, preset, overrides, given.skip, store=store, seed=given.seed)
    file = given.results / f"{asset}-{point}.json"
    if file.exists():
        result = json.loads(file.read_text())
        if given.keep or result["key"] == case_key(plan):
            return result
    print(f"{asset}, {point}: {', '.join(s.node.name for s in plan.to_compute)}", flush=True)
    command = [sys.executable, str(Path(__file__).with_name("pipeline_case.py")), str(orbit)]
    command += ["--preset", preset, "--store", str(given.store), "--out", str(file)]
    command += ["--seed", str(given.seed), *(f"--set={override}" for override in overrides)]
    command += [f"--skip={name}" for name in given.skip]
    path = f"{ROOT}{os.pathsep}{os.environ.get('PYTHONPATH', '')}"
    # Idle pools that spin take the cores from those that work.
    environment = {"GOMP_SPINCOUNT": "0"} | os.environ | {"PYTHONPATH": path}
    if subprocess.run(command, env=environment, check=False).returncode:
        print(f"{asset}, {point}: FAILED", flush=True)
        return None
    return json.loads(file.read_text())


def row_of(asset: str, point: str, result: dict[str, Any]) -> dict[str, Any]:
    """All numbers of a case in one flat row."""
    return {
        "asset": asset,
        "point": point,
        "total_s": round(sum(result["seconds"].values()), 1),
        "total_cpu_s": round(sum(result["cpu_seconds"].values()), 1),
        "peak_mib": result["peak_mib"],
        **{f"{name}_s": seconds for name, seconds in result["seconds"].items()},
        **result["figures"],
    }


def table(rows: list[dict[str, Any]]) -> str:
    """Markdown; an exclamation mark is a missed target."""
    cost = (Figure("total_s", "s", 0), Figure("total_cpu_s", "CPU s", 0))
    columns = (*cost, Figure("peak_mib", "MiB", 0), *FIGURES)
    lines = [
        "| preset | asset | " + " | ".join(column.title for column in columns) + " |",
        "|" + "---|" * (len(columns) + 2),
    ]
    for row in rows:
        cells = []
        for column in columns:
            value = row.get(column.name)
            if value is None:
                cells.append("-")
                continue
            wanted = target(row["point"], row["asset"], column.name)
            missed = wanted is not None and (
                value < wanted if column.is_better_high else value > wanted
            )
            cells.append(f"{value:.{column.digits}f}{' !' if missed else ''}")
        lines.append(f"| {row['point']} | {row['asset']} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def draw(rows: list[dict[str, Any]], file: Path) -> None:
    """CPU seconds against each figure, one line per asset: load on the machine does not show."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot
    from matplotlib.ticker import NullFormatter, ScalarFormatter

    titles = {figure.name: figure.title for figure in FIGURES} | {"peak_mib": "peak memory, MiB"}
    figure, panels = pyplot.subplots(2, 3, figsize=(15, 8), layout="constrained")
    for panel, name in zip(panels.flat, CHARTED, strict=True):
        for asset in dict.fromkeys(row["asset"] for row in rows):
            points = sorted(
                (row["total_cpu_s"], row[name], row["point"])
                for row in rows
                if row["asset"] == asset and row.get(name) is not None
            )
            panel.plot([p[0] for p in points], [p[1] for p in points], "o-", label=asset, ms=4)
            for seconds, value, point in points:
                panel.annotate(point, (seconds, value), fontsize=6, alpha=0.7)
        panel.set(xscale="log", xlabel="CPU seconds of all stages", title=titles[name])
        panel.set_xticks([10, 20, 50, 100, 200, 500])
        panel.xaxis.set_major_formatter(ScalarFormatter())
        panel.xaxis.set_minor_formatter(NullFormatter())
        panel.grid(alpha=0.3)
    panels.flat[0].legend(fontsize=8)
    figure.savefig(file, dpi=120)
    pyplot.close(figure)


def save(rows: list[dict[str, Any]], results: Path) -> None:
    """The table as Markdown and CSV, and the chart."""
    (results / "pipeline.md").write_text(table(rows) + "\n")
    with (results / "pipeline.csv").open("w", newline="") as stream:
        names = list(dict.fromkeys(name for row in rows for name in row))
        writer = csv.DictWriter(stream, names)
        writer.writeheader()
        writer.writerows(rows)
    draw(rows, results / "pipeline.png")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    data = os.environ.get("SVIM3D_DATA")
    parser.add_argument("--data", type=Path, default=data, required=data is None)
    parser.add_argument("--assets", nargs="+", default=ASSETS)
    parser.add_argument("--presets", nargs="*", default=PRESETS, choices=PRESETS)
    parser.add_argument("--steps", nargs="*", type=int, default=STEPS, help="phase 1 step counts")
    parser.add_argument("--set", action="append", default=[], dest="overrides")
    parser.add_argument("--skip", action="append", default=[], help="a stage to leave out")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--results", type=Path, default=ROOT / "benchmarks" / "results")
    parser.add_argument("--store", type=Path, help="of artifacts; default: store in the results")
    parser.add_argument("--keep", action="store_true", help="keep results of other code as well")
    given = parser.parse_args()
    given.data = Path(given.data)
    given.store = given.store or given.results / "store"
    given.results.mkdir(parents=True, exist_ok=True)
    rows = []
    # Point by point over all assets: the first rows already compare assets.
    for point in [*given.presets, *map(str, given.steps)]:
        for asset in given.assets:
            result = run(asset, point, given)
            if result is not None:
                rows.append(row_of(asset, point, result))
                save(rows, given.results)
    print(table(rows))


if __name__ == "__main__":
    main()
