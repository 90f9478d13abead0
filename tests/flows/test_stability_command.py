"""What `svim3d stability` makes of its command line; all cases but slow ones are stood in for."""

import json

import pytest

from flows import stability as command
from flows.cases import Outcome, Results
from flows.cli import main
from flows.stability_cases import BASELINE, OURS, Case, Settings, run_case

SOUND = {
    "outcome": Outcome.ASSET,
    "figures": {"score_db": 30.0, "finite": True, "watertight": True},
    "events": [],
    "cpu_s": 1.0,
}


@pytest.fixture
def ran(monkeypatch):
    """Cases that were run, each with a sound asset."""
    cases = []

    def stand_in(case, settings):
        cases.append(case)
        return dict(SOUND)

    monkeypatch.setattr(command, "run_case", stand_in)
    return cases


def arguments(tmp_path, *more):
    return ["stability", *more, "-o", str(tmp_path / "out"), "--store", str(tmp_path / "store")]


def test_hazards_are_listed_without_running_any(tmp_path, capsys, ran):
    assert main(arguments(tmp_path, "--list")) == 0
    listed = capsys.readouterr().out
    assert "misaligned: each view displaced" in listed and "repeatability:" in listed
    assert not ran and not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (["tsunami"], "hazard tsunami: wanted one of misaligned"),
        (["misaligned", "--seeds", "0"], "--seeds 0: wanted 1 or more"),
        (["misaligned", "--severities", "2"], "wanted shares from 0 to 1"),
        (["topology", "--variants", "sieve"], "topology: wanted variants among ring"),
        (["misaligned", "--set", "nerf.stops=3"], "no such setting"),
    ],
)
def test_wrong_wishes_are_refused(tmp_path, capsys, ran, given, said):
    assert main(arguments(tmp_path, *given)) == 2
    assert said in capsys.readouterr().err
    assert not ran


def test_severities_seeds_and_ways_are_swept_and_the_suite_goes_on(tmp_path, capsys, ran):
    wanted = arguments(
        tmp_path, "misaligned", "mirror", "--severities", "1", "--seeds", "2", "--baseline"
    )
    assert main(wanted) == 0
    assert len(ran) == 2 * (2 * 2 + 2)
    assert Case("misaligned", "", 8.0, 1, BASELINE) in ran
    assert {case.way for case in ran if case.hazard == "mirror"} == {OURS}
    assert "12 cases, 0 that must not be" in capsys.readouterr().out
    assert (tmp_path / "out" / "stability.csv").read_text().count("\n") == 1 + 6
    assert "<h2>mirror</h2>" in (tmp_path / "out" / "stability.html").read_text()
    ran.clear()
    assert main(wanted) == 0
    assert not ran
    # A line that was cut off costs its case alone; other settings cost all.
    file = tmp_path / "out" / "results.jsonl"
    file.write_text(file.read_text()[:-30])
    assert main(wanted) == 0
    assert len(ran) == 1
    assert main([*wanted, "--set", "nerf.steps=5"]) == 0
    assert len(ran) == 1 + 12
    ran.clear()
    assert main([*wanted, "--set", "nerf.steps=6", "--keep"]) == 0
    assert not ran


def test_what_must_not_be_is_told_by_the_exit_code(tmp_path, capsys, monkeypatch):
    crash = {"outcome": Outcome.CRASHED, "error": "ended with -11: ", "cpu_s": 0.1}
    monkeypatch.setattr(command, "run_case", lambda case, settings: crash)
    assert main(arguments(tmp_path, "mirror", "--severities", "0")) == 1
    assert "1 that must not be" in capsys.readouterr().out


def test_ways_differ_in_their_settings_alone(tmp_path):
    settings = Settings("tiny", ("nerf.steps=7",), 48, 8, tmp_path, 60.0)
    ours, plain = (settings.of(Case("mirror", "", 1.0, 0, way)) for way in (OURS, BASELINE))
    assert ours[0] == plain[0] == "standard"
    assert set(plain[1]) - set(ours[1]) >= {"nerf.warp_start=1", "dmtet.warp_start=1"}
    assert plain[1][-1] == "nerf.steps=7" and "nerf.image_size=48" in plain[1]
    larger = Settings("preview", (), 48, 8, tmp_path, 60.0)
    assert larger.of(Case("mirror", "", 1.0, 0, OURS)) == ("preview", [])


def test_results_outlive_a_suite_that_was_killed(tmp_path):
    case = Case("mirror", "", 1.0, 0, OURS)
    Results(tmp_path).put(case, "k", dict(SOUND))
    with (tmp_path / "results.jsonl").open("a") as stream:
        stream.write('{"key": "cut')
    known = Results(tmp_path)
    assert known.get(case, "k")["figures"]["score_db"] == 30.0
    assert known.get(case, "other") is None
    assert Results(tmp_path, any_code=True).get(case, "other") is not None
    known.put(case, "l", dict(SOUND))
    assert Results(tmp_path).get(case, "l") is not None


def test_a_process_that_dies_or_lingers_is_a_result(tmp_path, monkeypatch):
    case = Case("uv-torture", "noisy", 0.0, 0, OURS)
    settings = Settings("tiny", (), 48, 8, tmp_path, 60.0)
    monkeypatch.setattr("flows.stability_cases.CASE_MODULE", "flows.no_such_module")
    found = run_case(case, settings)
    assert found["outcome"] == Outcome.CRASHED and "no_such_module" in found["error"]
    # One that takes seconds to import what it needs.
    monkeypatch.setattr("flows.stability_cases.CASE_MODULE", "flows.stability_case")
    hasty = Settings("tiny", (), 48, 8, tmp_path, 0.01)
    assert run_case(case, hasty)["outcome"] == Outcome.TOO_LONG


@pytest.mark.slow
def test_a_real_case_ends_with_an_asset_and_its_figures(tmp_path):
    short = ("nerf.steps=8", "dmtet.steps=2", "env_preopt.steps=5", "uv_bake.fit_iterations=1")
    settings = Settings("tiny", short, 32, 6, tmp_path / "store", 300.0)
    found = run_case(Case("few-views", "", 1.0, 0, OURS), settings)
    assert found["outcome"] == Outcome.ASSET, found
    assert found["figures"]["finite"] and found["figures"]["watertight"]
    assert "few_views" in {kind for _, kind, _ in found["events"]}
    json.dumps(found, allow_nan=False)
    refused = run_case(Case("numeric", "camera nan", 2.0, 0, OURS), settings)
    assert refused["outcome"] == Outcome.REFUSED
    assert "rigid 4x4 camera-to-world" in refused["error"]
