import json
import math
from pathlib import Path

import pytest
import torch
from sphere_orbit import sphere_cameras, sphere_images

from benchmarks import bench_inconsistent
from benchmarks.bench_inconsistent import ASSET, CRASHED, REFUSED, TOO_LONG, cases, parse
from benchmarks.inconsistent_orbit import corrupted_orbit
from benchmarks.inconsistent_report import Case, Results, draw, table
from benchmarks.inconsistent_rows import ROWS, SMALL, overrides_of
from benchmarks.pipeline_case import case_key, plan_case
from stages.errors import InputError
from stages.store import Store
from svim3d.io.orbit import CHANNELS, read_orbit, write_orbit
from svim3d.metrics.statistics import mean_and_interval, paired
from svim3d.synthesis.inconsistency import Strengths

SIZE = 32


@pytest.fixture
def data(tmp_path):
    """A folder like that of the real orbits, with one sphere."""
    cameras = sphere_cameras(5, SIZE)
    write_orbit(tmp_path / "orbits" / "sphere", cameras, sphere_images(cameras), reference=4)
    return tmp_path


def orbit_at(data, severity, size=SIZE, seed=0):
    return corrupted_orbit(
        data / "orbits" / "sphere",
        data / "made",
        size=size,
        strengths=Strengths.at(severity),
        seed=seed,
    )


def test_an_orbit_of_severity_zero_is_the_true_one_to_the_bit(data):
    _, true, reference = read_orbit(data / "orbits" / "sphere")
    _, made, same_reference = read_orbit(orbit_at(data, 0.0))
    assert reference == same_reference
    assert all(torch.equal(made[name], true[name]) for name in CHANNELS)


def test_corrupted_orbits_are_named_after_what_they_depend_on_and_made_once(data):
    folders = {
        orbit_at(data, severity, size, seed)
        for severity, size, seed in ((3.0, 32, 0), (4.0, 32, 0), (3.0, 16, 0), (3.0, 32, 1))
    }
    assert len(folders) == 4
    made_at = (orbit_at(data, 3.0) / "views.png").stat().st_mtime_ns
    assert (orbit_at(data, 3.0) / "views.png").stat().st_mtime_ns == made_at
    assert {f.name.partition("-")[0] for f in (data / "made").iterdir()} == {"sphere"}


def test_smaller_views_are_valid_and_told_of_no_repair(data):
    told = []
    cameras, images, _ = read_orbit(orbit_at(data, 3.0, 16), notify=lambda *said: told.append(said))
    assert told == []
    assert (cameras.height, cameras.width) == (16, 16)
    # Straight colour survives the smaller size: the sphere is painted in two tones.
    inside = images["mask"][4] > 0.999
    _, true, _ = read_orbit(data / "orbits" / "sphere")
    tones = true["basecolor"][4][..., 0].unique()
    found = images["basecolor"][4][..., :1][inside]
    assert float(found.min()) == pytest.approx(float(tones[1]), abs=1e-3)
    assert float(found.max()) == pytest.approx(float(tones[-1]), abs=1e-3)


def test_all_rows_can_be_asked_of_the_pipeline_and_a_wrong_one_is_refused(data):
    for row in ROWS.values():
        assert overrides_of(row, 64, [])[: len(SMALL)] == list(SMALL)
    with pytest.raises(InputError, match=r"nerf\.no_such"):
        overrides_of(("nerf.no_such=1",), 64, [])


def given(data, *arguments):
    common = ["--data", str(data), "--orbits", "sphere", "--results", str(data / "results")]
    return parse([*common, *arguments])


def test_rows_of_the_command_line_join_the_table(data, capsys):
    asked = given(data, "--row", "longer", "nerf.steps=300", "--rows", "ours", "longer")
    assert asked.table["longer"] == ("nerf.steps=300",)
    for wrong in (["--rows", "lain"], ["--row", "x", "nerf.stepz=3"]):
        with pytest.raises(SystemExit):
            given(data, *wrong)
    assert "did you mean nerf.steps" in capsys.readouterr().err


def test_severity_zero_is_run_with_one_seed(data):
    asked = given(data, "--severities", "0", "3", "--seeds", "4", "5", "--rows", "ours")
    assert [(c.severity, c.seed) for c in cases(asked)] == [(0.0, 4), (3.0, 4), (3.0, 5)]


def scripted(monkeypatch, results):
    """Stand in for the stages: a case's own process leaves the next result, or none."""
    ran = []

    def end(command, timeout_s):
        ran.append(command)
        result = results.pop(0)
        if isinstance(result, str):
            return {"outcome": result, "error": "so it was"}
        (out,) = [command[i + 1] for i, word in enumerate(command) if word == "--out"]
        Path(out).write_text(json.dumps(result | {"key": result_key(command)}))
        return {}

    monkeypatch.setattr(bench_inconsistent, "_ended", end)
    return ran


def result_key(command):
    """The key that the benchmark itself expects of a case."""
    settings = [word.removeprefix("--set=") for word in command if word.startswith("--set=")]
    orbit, store = command[2], command[command.index("--store") + 1]
    plan = plan_case(
        Path(orbit),
        "standard",
        settings,
        [],
        store=Store(Path(store)),
        seed=0,
    )
    return case_key(plan)


def test_finished_cases_are_not_run_again_and_failed_ones_are(data, monkeypatch):
    asked = given(data, "--severities", "3", "--seeds", "0", "--rows", "ours")
    (case,) = cases(asked)
    known = {}
    figures = {"outcome": ASSET, "figures": {"view_db": 20.0}}
    ran = scripted(monkeypatch, [CRASHED, TOO_LONG, figures])
    for outcome, runs in ((CRASHED, 1), (TOO_LONG, 2), (ASSET, 3), (ASSET, 3)):
        known[case.name] = bench_inconsistent.run_case(case, asked, known)
        assert known[case.name]["outcome"] == outcome
        assert len(ran) == runs
    # Other settings are another case, unless told to keep.
    other = given(
        data, "--severities", "3", "--seeds", "0", "--rows", "ours", "--set", "nerf.steps=9"
    )
    scripted(monkeypatch, [CRASHED])
    assert bench_inconsistent.run_case(case, other, known)["outcome"] == CRASHED
    other.keep = True
    assert bench_inconsistent.run_case(case, other, known)["outcome"] == ASSET


def some_results():
    results = Results()
    for orbit, level in (("a", 20.0), ("b", 30.0)):
        for seed in range(3):
            for row, gain in (("ours", 0.0), ("better", 2.0)):
                value = level + gain + 0.1 * seed
                figures = {"view_db": value, "normal_deg": 5.0 - gain}
                results.add(Case(orbit, 3.0, seed, row), {"outcome": ASSET, "figures": figures})
    results.add(Case("a", 5.0, 0, "ours"), {"outcome": REFUSED, "error": "InputError: no"})
    return results


def test_means_weigh_orbits_alike_and_intervals_hold_them():
    uneven = {("a", 0): 10.0, ("a", 1): 12.0, ("a", 2): 14.0, ("b", 0): 20.0}
    mean, interval = mean_and_interval(uneven)
    assert mean == pytest.approx(16.0)
    assert interval is not None
    assert interval[0] == pytest.approx(12.0, abs=1.0)
    assert interval[1] == pytest.approx(20.0, abs=0.01)
    assert mean_and_interval({("a", 0): 3.0}) == (3.0, None)


def test_interval_of_many_orbits_is_that_of_their_mean():
    generator = torch.Generator().manual_seed(0)
    values = torch.randn(40, generator=generator)
    mean, interval = mean_and_interval({(str(i), 0): float(v) for i, v in enumerate(values)})
    assert mean == pytest.approx(float(values.mean()), abs=1e-6)
    half = 1.96 * float(values.std()) / math.sqrt(40)
    assert interval[0] == pytest.approx(mean - half, abs=0.15 * half)
    assert interval[1] == pytest.approx(mean + half, abs=0.15 * half)


def test_differences_are_paired_so_that_orbits_do_not_blur_them():
    results = some_results()
    gain = paired(results.values("better", 3.0, "view_db"), results.values("ours", 3.0, "view_db"))
    assert len(gain) == 6
    mean, interval = mean_and_interval(gain)
    assert mean == pytest.approx(2.0)
    assert interval == pytest.approx((2.0, 2.0))


def test_table_and_chart_show_rows_severities_and_what_was_lost(tmp_path):
    results = some_results()
    lines = table(results, "ours").splitlines()
    assert len(lines) == 5
    assert lines[2].startswith("| 3 | ours | 6 of 6 | 25.1 [")
    assert lines[3].startswith("| 3 | better | 6 of 6 | 27.1 (+2.00 [2.00, 2.00])")
    assert lines[4].startswith("| 5 | ours | 0 of 1 | - | - ")
    draw(results, tmp_path / "chart.png")
    assert (tmp_path / "chart.png").read_bytes().startswith(b"\x89PNG")
