"""Which sampler settings the generator should have: quality and seconds by steps and guidance.

    python benchmarks/bench_generator_settings.py --model FOLDER --heldout FOLDER [--limit 16]
        [--steps 1 2 4 6 8 12 16 25 50] [--guidance 1 1.25 1.5 2 2.5] [--seeds 4] [--grid]

Steps are varied at the model's own guidance, and guidance at the model's own steps; `--grid` takes
all pairs. The baseline of each row is the model's own setting: its differences from it are paired
by object. Seconds are of processor time per orbit, decoding included. `--seeds` adds how far
orbits of other seeds lie apart, and what the mean of several is worth.
"""

import argparse
import json
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import torch
from matplotlib.ticker import LogLocator, NullFormatter

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from benchmarks.generator_draws import (  # noqa: E402
    generate,
    mean_of,
    object_seed,
    spread_of,
)
from benchmarks.generator_report import SHORT, interval  # noqa: E402
from benchmarks.generator_scores import FIGURES, score_views  # noqa: E402
from benchmarks.generator_views import Case, Views, read_examples  # noqa: E402
from svim3d.diffusion.model import MaterialDiffusion, Sampling  # noqa: E402
from svim3d.io.model_folder import read_model  # noqa: E402

STEPS = (1, 2, 4, 6, 8, 12, 16, 25, 50)
GUIDANCE = (1.0, 1.25, 1.5, 2.0, 2.5)
LIMIT = 16
# Of a pixel of the object that is left empty. Settings are compared with each other, so the middle
# of the range does as well as a training set's mean.
EMPTY = {"roughness": 0.5, "metallic": 0.5}
CHARTED = (("rgb_psnr", "basecolor_psnr"), ("normal_deg",), ("rgb_ssim", "mask_iou"))


@dataclass(frozen=True)
class Setting:
    """One row."""

    steps: int
    guidance: float

    def sampling(self) -> Sampling:
        """For the sampler, all pictures decoded at once."""
        return Sampling(steps=self.steps, guidance_max=self.guidance, decode_at_once=84)


@dataclass
class Row:
    """What a setting scored, one value for each object."""

    figures: dict[str, list[float]]
    seconds: list[float]


def settings_of(arguments: argparse.Namespace, own: Setting) -> list[Setting]:
    """All rows, each once, the model's own among them."""
    if arguments.grid:
        chosen = [Setting(s, g) for s in arguments.steps for g in arguments.guidance]
    else:
        chosen = [Setting(s, own.guidance) for s in arguments.steps]
        chosen += [Setting(own.steps, g) for g in arguments.guidance]
    return sorted({*chosen, own}, key=lambda setting: (setting.steps, setting.guidance))


def mean_scores(views: Views, case: Case) -> dict[str, float]:
    """Means over all views but the reference; figures of meaningless materials become NaN."""
    assert case.truth is not None
    scores = score_views(views, case.truth, EMPTY)
    return {
        name: float("nan")
        if FIGURES[name].is_material and not case.has_materials
        else float(value[:-1].nanmean())
        for name, value in scores.items()
    }


def try_settings(
    model: MaterialDiffusion, cases: list[Case], settings: list[Setting], seed: int
) -> dict[Setting, Row]:
    """Draw every object with every setting, the same noise for all settings."""
    rows = {}
    for setting in settings:
        row = rows[setting] = Row({}, [])
        for index, case in enumerate(cases):
            started = time.process_time()
            views = generate(model, case, object_seed(seed, index), setting.sampling())
            row.seconds.append(time.process_time() - started)
            for name, value in mean_scores(views, case).items():
                row.figures.setdefault(name, []).append(value)
        print(line_of(setting, row, None), flush=True)
    return rows


def line_of(setting: Setting, row: Row, own: Row | None) -> str:
    """One row of the table; an asterisk where it differs clearly from the model's own setting."""
    cells = [f"{setting.steps}", f"{setting.guidance:g}", f"{np.mean(row.seconds):.2f}"]
    for name in SHORT:
        values, digits = np.array(row.figures[name]), FIGURES[name].digits
        mark = ""
        if own is not None and own is not row:
            gain = interval(values - np.array(own.figures[name]))
            mark = "*" if gain["low"] > 0.0 or gain["high"] < 0.0 else ""
        cells.append(f"{np.nanmean(values):.{digits}f}{mark}")
    return f"| {' | '.join(cells)} |"


def table(rows: dict[Setting, Row], own: Setting) -> str:
    """All rows as Markdown."""
    titles = ["steps", "guidance", "CPU s", *[FIGURES[name].title for name in SHORT]]
    lines = [f"| {' | '.join(titles)} |", f"| {' | '.join(['---:'] * len(titles))} |"]
    return "\n".join([*lines, *[line_of(s, row, rows[own]) for s, row in rows.items()]])


def draw_chart(rows: dict[Setting, Row], own: Setting, file: Path) -> None:
    """Figures against seconds, a dot for each number of steps at the model's own guidance."""
    figure, axes = plt.subplots(1, len(CHARTED), figsize=(4.6 * len(CHARTED), 3.6))
    chosen = {s: row for s, row in rows.items() if s.guidance == own.guidance}
    seconds = [np.mean(row.seconds) for row in chosen.values()]
    for axis, names in zip(axes, CHARTED, strict=True):
        for name in names:
            values = [np.nanmean(row.figures[name]) for row in chosen.values()]
            axis.plot(seconds, values, "o-", label=FIGURES[name].title)
            for setting, x, y in zip(chosen, seconds, values, strict=True):
                axis.annotate(
                    f"{setting.steps}",
                    (x, y),
                    textcoords="offset points",
                    xytext=(4, 4),
                    fontsize=8,
                )
        axis.set_xscale("log")
        axis.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.xaxis.set_major_formatter("{x:g}")
        axis.xaxis.set_minor_formatter(NullFormatter())
        axis.margins(0.12)
        axis.set_xlabel("processor seconds per orbit (numbers: steps)")
        axis.grid(alpha=0.3)
        axis.legend(fontsize=8)
    figure.tight_layout()
    figure.savefig(file, dpi=110)


def compare_seeds(
    model: MaterialDiffusion, cases: list[Case], own: Setting, seed: int, count: int
) -> dict[str, dict[str, float]]:
    """Spread over seeds, and figures of one orbit and of means of 2, 4, ... orbits."""
    told: dict[str, list[dict[str, float]]] = {}
    for index, case in enumerate(cases):
        drawn = [
            generate(model, case, object_seed(seed + s, index), own.sampling())
            for s in range(count)
        ]
        told.setdefault("spread", []).append(spread_of(drawn))
        singles = [mean_scores(views, case) for views in drawn]
        average = {name: float(np.mean([s[name] for s in singles])) for name in singles[0]}
        told.setdefault("one orbit", []).append(average)
        best = int(np.argmax([s["basecolor_psnr"] for s in singles]))
        told.setdefault(f"best of {count} by truth", []).append(singles[best])
        several = 2
        while several <= count:
            mean = mean_scores(mean_of(drawn[:several]), case)
            told.setdefault(f"mean of {several}", []).append(mean)
            several *= 2
        print(f"seeds: {index + 1} of {len(cases)} objects", flush=True)
    return {
        row: {name: float(np.nanmean([o[name] for o in objects])) for name in objects[0]}
        for row, objects in told.items()
    }


def seeds_table(told: dict[str, dict[str, float]]) -> str:
    """Spread over seeds and what means are worth, as Markdown."""
    spread = ", ".join(f"{name} {value:.3f}" for name, value in told["spread"].items())
    lines = [f"| | {' | '.join(FIGURES[n].title for n in SHORT)} |"]
    lines.append(f"| --- | {' | '.join(['---:'] * len(SHORT))} |")
    for row, values in told.items():
        if row != "spread":
            cells = [f"{values[n]:.{FIGURES[n].digits}f}" for n in SHORT]
            lines.append(f"| {row} | {' | '.join(cells)} |")
    return "\n".join([*lines, "", f"Spread over seeds (RMS; normals in degrees): {spread}."])


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--model", type=Path, required=True)
    parser.add_argument("--heldout", type=Path, required=True)
    parser.add_argument("--limit", type=int, default=LIMIT, help="objects (%(default)s)")
    parser.add_argument("--steps", type=int, nargs="+", default=STEPS)
    parser.add_argument("--guidance", type=float, nargs="+", default=GUIDANCE)
    parser.add_argument("--grid", action="store_true", help="all pairs of steps and guidance")
    parser.add_argument("--seeds", type=int, default=0, help="orbits per object for their spread")
    parser.add_argument("--seed", type=int, default=0)
    folder = ROOT / "benchmarks/results"
    parser.add_argument("--results", type=Path, default=folder / "generator_settings.json")
    return parser.parse_args()


def main() -> None:
    arguments = parse()
    model = read_model(arguments.model, torch.device("cpu"))
    own = Setting(model.spec.steps, model.spec.guidance_max)
    cases = list(read_examples(arguments.heldout, model.spec.image_size, arguments.limit))
    print(f"{len(cases)} objects; the model's own setting: {own}", flush=True)
    rows = try_settings(model, cases, settings_of(arguments, own), arguments.seed)
    text = table(rows, own)
    results: dict = {
        "model": model.spec.name,
        "objects": len(cases),
        "own": vars(own),
        "rows": [vars(setting) | vars(row) for setting, row in rows.items()],
    }
    if arguments.seeds > 1:
        results["seeds"] = compare_seeds(model, cases, own, arguments.seed, arguments.seeds)
        text += "\n\n" + seeds_table(results["seeds"])
    print(text)
    arguments.results.parent.mkdir(parents=True, exist_ok=True)
    arguments.results.write_text(json.dumps(results, indent=1))
    arguments.results.with_suffix(".md").write_text(text + "\n")
    chart = arguments.results.with_suffix(".png")
    draw_chart(rows, own, chart)
    print(f"results: {arguments.results}, chart: {chart}")


if __name__ == "__main__":
    main()
