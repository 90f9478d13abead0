"""What inconsistent views cost an asset, and what each remedy against them gives back.

    python benchmarks/bench_inconsistent.py --data FOLDER [--orbits barrel cat] [--severities 0 3]

True orbits are corrupted by a seeded model (`svim3d.synthesis.inconsistency`; severities 0 to 5,
`--kinds` leaves all faults out but the named ones) and run through all stages with the settings of
each row of `inconsistent_rows.py`; `--row NAME SETTING...` adds one. Assets are measured against
the true test views, lights and mesh, which were never corrupted:

- novel views: PSNR after AgX at the six test cameras under the light that was found;
- relit: the same under the two true lights that were never seen;
- basecolor (sRGB) and normals at those cameras, distance of the surfaces (see
  `svim3d.render.asset_figures`).

Means are over orbits of means over seeds. Differences to `--baseline` are paired by orbit and seed,
with an interval of 95 % by bootstrap over orbits and their seeds. Every case must end with an asset
or with a clear error; the exit code is 1 if one crashed or took too long.

Results lie in `--results` as they come in. A case whose code, settings and input are unchanged is
not run again (`--keep`: nor one that was run by other code), so an interrupted benchmark goes on.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from benchmarks.inconsistent_orbit import corrupted_orbit  # noqa: E402
from benchmarks.inconsistent_report import ASSET, Case, Results, draw, table  # noqa: E402
from benchmarks.inconsistent_rows import PRESET, ROWS, overrides_of  # noqa: E402
from benchmarks.pipeline_case import case_key, plan_case  # noqa: E402
from stages.store import Store  # noqa: E402
from svim3d.synthesis.inconsistency import KINDS, Strengths  # noqa: E402

ORBITS = ("boombox", "barrel", "cat", "oculus", "spheres")
SEVERITIES = (0.0, 1.0, 2.0, 3.0, 4.0, 5.0)
SEEDS = (0, 1, 2)
REFUSED, CRASHED, TOO_LONG = "refused", "crashed", "too long"
FINAL = (ASSET, REFUSED)  # the outcomes that another try would not change
CASE_TIMEOUT_S = 1800.0  # of wall clock, on a loaded machine


def run_case(case: Case, given: argparse.Namespace, known: dict[str, Any]) -> dict[str, Any]:
    """The result of a case: the known one if it is up to date."""
    result = known.get(case.name)
    if result is not None and given.keep and result["outcome"] in FINAL:
        return result
    strengths = Strengths.at(case.severity).only(*given.kinds)
    truth = given.data / "orbits" / case.orbit
    orbit = corrupted_orbit(
        truth, given.results / "orbits", size=given.size, strengths=strengths, seed=case.seed
    )
    overrides = overrides_of(given.table[case.row], given.size, given.overrides)
    store = Store(given.results / "store")
    key = case_key(plan_case(orbit, PRESET, overrides, [], store=store, seed=case.seed))
    if result is not None and result["key"] == key and result["outcome"] in FINAL:
        return result
    with tempfile.TemporaryDirectory() as work:
        file = Path(work) / "result.json"
        command = [sys.executable, str(Path(__file__).with_name("inconsistent_case.py"))]
        command += [str(orbit), str(truth), "--preset", PRESET, "--store", str(store.root)]
        command += ["--seed", str(case.seed), "--out", str(file)]
        command += [f"--set={override}" for override in overrides]
        outcome = _ended(command, given.timeout)
        return json.loads(file.read_text()) if file.exists() else {"key": key, **outcome}


def _ended(command: list[str], timeout_s: float) -> dict[str, str]:
    """Run a command; how it ended if it leaves no result."""
    path = f"{ROOT}{os.pathsep}{os.environ.get('PYTHONPATH', '')}"
    # Idle pools that spin take the cores from those that work.
    environment = {"GOMP_SPINCOUNT": "0"} | os.environ | {"PYTHONPATH": path}
    try:
        code = subprocess.run(
            command, env=environment, stdout=subprocess.DEVNULL, timeout=timeout_s, check=False
        ).returncode
    except subprocess.TimeoutExpired:
        return {"outcome": TOO_LONG, "error": f"more than {timeout_s:g} s"}
    return {"outcome": CRASHED, "error": f"the process ended with {code}"}


def line(case: Case, result: dict[str, Any]) -> str:
    """A case in a line, while the benchmark runs."""
    if result["outcome"] != ASSET:
        return f"{case.name}: {result['outcome']}: {result['error']}"
    figures, cpu = result["figures"], sum(result["cpu_seconds"].values())
    return (
        f"{case.name}: view {figures['view_db']:.2f} dB, relit {figures['relight_db']:.2f} dB, "
        f"basecolor {figures['basecolor_db']:.2f} dB, normals {figures['normal_deg']:.1f} deg, "
        f"distance {figures['distance']:.4f}; {cpu:.0f} CPU s"
    )


def cases(given: argparse.Namespace) -> list[Case]:
    """All cases, seed by seed: the first seed already fills the whole table.

    Severity 0 has no faults to draw, so one seed is enough there.
    """
    return [
        Case(orbit, severity, seed, row)
        for seed in given.seeds
        for severity in given.severities
        for orbit in given.orbits
        for row in given.rows
        if severity or seed == given.seeds[0]
    ]


def save(known: dict[str, Any], file: Path) -> None:
    """Replace the results file in one step."""
    draft = file.with_suffix(".tmp")
    draft.write_text(json.dumps(known, indent=1))
    draft.replace(file)


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    """The command line, with the table of rows in `table`."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    data = os.environ.get("SVIM3D_DATA")
    parser.add_argument("--data", type=Path, default=data, required=data is None)
    parser.add_argument("--orbits", nargs="+", default=ORBITS)
    parser.add_argument("--severities", nargs="+", type=float, default=SEVERITIES)
    parser.add_argument("--seeds", nargs="+", type=int, default=SEEDS)
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=KINDS)
    parser.add_argument("--size", type=int, default=128, help="longest side of the views, pixels")
    parser.add_argument("--rows", nargs="+", help="names of rows; all if none is named")
    parser.add_argument("--row", nargs="+", action="append", default=[], help="NAME SETTING...")
    parser.add_argument("--set", action="append", default=[], dest="overrides")
    parser.add_argument(
        "--baseline", default="full, as in the paper", help="row that differences are taken to"
    )
    parser.add_argument("--timeout", type=float, default=CASE_TIMEOUT_S, help="of a case, s")
    parser.add_argument("--keep", action="store_true", help="keep results of other code as well")
    parser.add_argument(
        "--results", type=Path, default=ROOT / "benchmarks" / "results" / "inconsistent"
    )
    given = parser.parse_args(arguments)
    given.data = Path(given.data)
    given.table = ROWS | {name: tuple(settings) for name, *settings in given.row}
    given.rows = given.rows or list(given.table)
    unknown = set(given.rows) - set(given.table)
    if unknown:
        parser.error(f"wanted rows among {', '.join(given.table)}, got {', '.join(unknown)}")
    for row in given.rows:
        try:
            overrides_of(given.table[row], given.size, given.overrides)
        except ValueError as error:
            parser.error(f"row {row}: {error}")
    return given


def main() -> int:
    given = parse()
    given.results.mkdir(parents=True, exist_ok=True)
    chosen = "all" if set(given.kinds) == set(KINDS) else "-".join(given.kinds)
    file = given.results / f"{chosen}-{given.size}.json"
    known = json.loads(file.read_text()) if file.exists() else {}
    results = Results()
    for case in cases(given):
        result = run_case(case, given, known)
        known[case.name] = result
        save(known, file)
        results.add(case, result)
        print(line(case, result), flush=True)
    text = table(results, given.baseline)
    file.with_suffix(".md").write_text(text + "\n")
    draw(results, file.with_suffix(".png"))
    print(text)
    return int(any(outcome not in FINAL for outcome in results.outcomes.values()))


if __name__ == "__main__":
    sys.exit(main())
