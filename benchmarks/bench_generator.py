"""How good the generator is, beside three baselines: tables by channel and azimuth, and sheets.

    python benchmarks/bench_generator.py --model FOLDER --train FOLDER --heldout FOLDER
        [--data FOLDER] [--limit 64] [--samples 4] [--sheet FILE.png] [--results FILE.json]

`--train` holds rendered training examples: what baselines know. `--heldout` holds examples that
were never trained on. `--data` (default: the environment variable SVIM3D_DATA) holds
`orbits/<asset>`, path-traced views of real assets. A result is the mean over objects of the mean
over all views but the reference; intervals are 95 % bootstrap intervals over objects. A baseline
is beaten clearly where the interval of the paired difference lies above zero.
"""

import argparse
import json
import os
import sys
import time
from collections.abc import Callable, Iterable
from dataclasses import asdict
from pathlib import Path

import torch

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from benchmarks.generator_baselines import (  # noqa: E402
    Training,
    learn,
    mean_image,
    repeated,
    repeated_truth,
    warped,
)
from benchmarks.generator_draws import generate, mean_of, object_seed, round_trip  # noqa: E402
from benchmarks.generator_report import (  # noqa: E402
    OURS,
    SHORT,
    Scores,
    azimuth_table,
    gains_table,
    main_table,
    paired_gains,
    summarize,
    turning_table,
    verdict,
)
from benchmarks.generator_scores import FIGURES, score_views, turning  # noqa: E402
from benchmarks.generator_sheets import case_sheet, stack_sheets  # noqa: E402
from benchmarks.generator_views import (  # noqa: E402
    Case,
    Views,
    read_examples,
    read_orbit_case,
    read_photo_case,
)
from stages.errors import InputError  # noqa: E402
from svim3d.diffusion.model import MaterialDiffusion, Sampling  # noqa: E402
from svim3d.io.image import write_png  # noqa: E402
from svim3d.io.model_folder import read_model  # noqa: E402

ASSETS = ("boombox", "barrel", "cat", "oculus", "spheres")
BASELINES = ("reference repeated", "mean image", "reference on ellipsoid")
TRAIN_LIMIT = 512  # objects that the baselines learn from: their means change by little beyond
SHEET_OBJECTS = 6

Judged = tuple[dict[str, Scores], list[tuple[Case, Views]]]


def rows_of(
    model: MaterialDiffusion, case: Case, training: Training, sampling: Sampling, seeds: list[int]
) -> dict[str, Views]:
    """Every row's views of one object."""
    drawn = [generate(model, case, seed, sampling) for seed in seeds]
    several = {} if len(drawn) < 2 else {f"ours, mean of {len(drawn)}": mean_of(drawn)}
    made = (repeated(case, training), mean_image(case, training), warped(case, training))
    return {
        OURS: drawn[0],
        **several,
        **dict(zip(BASELINES, made, strict=True)),
        "oracle: true reference repeated": repeated_truth(case),
        "oracle: truth through autoencoder": round_trip(model, case.truth),
    }


def judge(
    cases: Iterable[Case],
    make_rows: Callable[[Case, int], dict[str, Views]],
    training: Training,
    keep: int | None = None,
) -> Judged:
    """Score all rows of all cases, one orbit in memory at a time; keep the first few of ours."""
    scores: dict[str, Scores] = {}
    kept = []
    for index, case in enumerate(cases):
        started = time.process_time()
        rows = make_rows(case, index)
        for row, views in rows.items():
            scores.setdefault(row, Scores()).add(
                score_views(views, case.truth, training.mean_value),
                case.azimuth_deg,
                turning(views, case.truth, case.azimuth_deg),
                materials=case.has_materials,
            )
        if keep is None or len(kept) < keep:
            kept.append((case, rows[OURS]))
        so_far = ", ".join(
            f"{row} {scores[row].per_object('rgb_psnr').mean():.2f}" for row in (OURS, *BASELINES)
        )
        seconds = time.process_time() - started
        print(
            f"{index + 1:4d} {case.name[:24]:24} {seconds:6.1f} CPU s; RGB dB: {so_far}", flush=True
        )
    return scores, kept


def report(name: str, scores: dict[str, Scores]) -> tuple[str, dict]:
    """All tables of one set as Markdown, and its results."""
    summary, gains = summarize(scores), paired_gains(scores, BASELINES)
    verdicts = verdict(gains)
    objects = len(scores[OURS].bins)
    text = [f"### {name}, {objects} objects", main_table(summary), gains_table(gains)]
    text += [turning_table(summary)]
    text += [azimuth_table(summary, figure) for figure in SHORT]
    text += ["\n".join(f"- {FIGURES[figure].title}: {told}" for figure, told in verdicts.items())]
    results = {"objects": objects, "rows": summary, "gains": gains, "verdict": verdicts}
    return "\n\n".join(text), results


def sets_of(arguments: argparse.Namespace, size: int) -> dict[str, Iterable[Case]]:
    """Cases by the name of their set; nothing is read yet."""
    sets: dict[str, Iterable[Case]] = {}
    if arguments.heldout is not None:
        sets["procedural, held out"] = read_examples(arguments.heldout, size, arguments.limit)
    if arguments.data is not None:
        folders = [Path(arguments.data) / "orbits" / asset for asset in ASSETS]
        sets["real assets, path-traced"] = (read_orbit_case(f, size) for f in folders)
    return sets


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--model", type=Path, required=True)
    parser.add_argument("--train", type=Path, required=True)
    parser.add_argument("--train-limit", type=int, default=TRAIN_LIMIT)
    parser.add_argument("--heldout", type=Path)
    parser.add_argument("--data", type=Path, default=os.environ.get("SVIM3D_DATA"))
    parser.add_argument("--photos", type=Path, help="folder; for sheets (default: --data's photos)")
    parser.add_argument("--network", type=Path, help="matting network (.onnx) for photos")
    parser.add_argument("--limit", type=int, help="objects of the held-out folder")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--samples", type=int, default=1, help="orbits per object; adds their mean")
    parser.add_argument("--steps", type=int)
    parser.add_argument("--guidance", type=float)
    parser.add_argument("--guidance-by", choices=("index", "azimuth"), default="index")
    parser.add_argument(
        "--sheet", type=Path, help="PNG; the name of each set is put before its suffix"
    )
    parser.add_argument("--sheet-objects", type=int, default=SHEET_OBJECTS)
    parser.add_argument("--compact", action="store_true", help="sheets with RGB of the truth only")
    parser.add_argument("--results", type=Path, default=ROOT / "benchmarks/results/generator.json")
    arguments = parser.parse_args()
    if arguments.heldout is None and arguments.data is None:
        parser.error("nothing to judge on: give --heldout, or --data (no SVIM3D_DATA is set)")
    if arguments.photos is None and arguments.data is not None:
        arguments.photos = Path(arguments.data) / "photos"
    return arguments


def main() -> None:
    arguments = parse()
    model = read_model(arguments.model, torch.device("cpu"))
    size = model.spec.image_size
    sampling = Sampling(
        steps=arguments.steps,
        guidance_max=arguments.guidance,
        guidance_by=arguments.guidance_by,
        decode_at_once=84,
    )
    training = learn(read_examples(arguments.train, size, arguments.train_limit), size)
    print(f"baselines learnt from {training.objects} objects: {choices(training)}", flush=True)
    results: dict = {"model": model.spec.name, "sampling": asdict(sampling)}
    results |= {"seed": arguments.seed, "baselines": choices(training), "sets": {}}
    tables = []

    def make_rows(case: Case, index: int) -> dict[str, Views]:
        seeds = [object_seed(arguments.seed + s, index) for s in range(arguments.samples)]
        return rows_of(model, case, training, sampling, seeds)

    for name, cases in sets_of(arguments, size).items():
        scores, kept = judge(cases, make_rows, training, keep=arguments.sheet_objects)
        text, results["sets"][name] = report(name, scores)
        tables.append(text)
        print(text, flush=True)
        arguments.results.parent.mkdir(parents=True, exist_ok=True)
        arguments.results.write_text(json.dumps(results, indent=1))
        arguments.results.with_suffix(".md").write_text("\n\n".join(tables) + "\n")
        if arguments.sheet is not None:
            short = name.split(",")[0].replace(" ", "-")
            file = arguments.sheet.with_stem(f"{arguments.sheet.stem}-{short}")
            write_sheet(file, kept, compact=arguments.compact)
    print(f"results: {arguments.results}")
    if arguments.sheet is not None and arguments.photos is not None:
        kept = draw_photos(model, arguments, sampling)
        write_sheet(arguments.sheet.with_stem(f"{arguments.sheet.stem}-photos"), kept)


def draw_photos(
    model: MaterialDiffusion, arguments: argparse.Namespace, sampling: Sampling
) -> list[tuple[Case, Views]]:
    """Photos that can be cut out, and what the generator makes of them."""
    kept = []
    for file in sorted(arguments.photos.iterdir()):
        try:
            case = read_photo_case(file, model.spec.image_size, model.spec.views, arguments.network)
        except InputError as error:
            print(f"{file.name}: left out: {error}", flush=True)
            continue
        kept.append((case, generate(model, case, object_seed(arguments.seed, len(kept)), sampling)))
        print(f"{file.name}: drawn", flush=True)
    return kept


def choices(training: Training) -> dict:
    """What the baselines took from training objects."""
    return {
        "objects": training.objects,
        "tone": asdict(training.tone),
        "ellipsoid's colours": asdict(training.warp),
        "ellipsoid's mask and normals": asdict(training.shape),
        "repeated normals": "mean image" if training.repeats_mean_normals else "inflated mask",
        "mean value": training.mean_value,
        "best constant": training.constant,
    }


def write_sheet(file: Path, kept: list[tuple[Case, Views]], *, compact: bool = False) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    sheets = [case_sheet(case, ours, compact=compact) for case, ours in kept]
    write_png(file, stack_sheets(sheets))
    print(f"sheet: {file}", flush=True)


if __name__ == "__main__":
    main()
