"""What `svim3d chart` makes of its command line; all cases but a slow one are stood in for."""

import csv
import json
import math
import re

import pytest

from flows import chart as command
from flows.cases import Outcome
from flows.cli import main
from flows.config import PipelineConfig, load_config
from svim3d.charts import draw_panels

OFFSETS = {"pot": 0.0, "cup": -3.0}  # dB that an orbit costs whatever is done


def law(config, orbit, seed):
    """Costs and figures by a known law: 3 dB for each doubling of phase 1's steps up to 800.

    Rays cost time and give nothing; textures cost bytes alone.
    """
    steps, rays = config.nerf.steps, config.nerf.rays_per_step
    phase_2 = 0 if "dmtet" in config.skip else config.dmtet.steps
    cpu_s = (steps * rays / 2**19 + phase_2 / 10.0) * (1.0 + 0.01 * seed)
    gain = 3.0 * math.log2(min(steps, 800) / 200.0) + OFFSETS[orbit]
    return {
        "outcome": Outcome.ASSET,
        "costs": {
            "cpu_s": cpu_s,
            "seconds": 2.0 * cpu_s,
            "peak_mib": 1000.0,
            "bytes": config.uv_bake.texture_size**2,
        },
        "figures": {
            "relight_delta_db": gain,
            "normal_deg": 5.0 - 0.1 * gain,
            "distance": 0.01 * 0.9**gain,
            "basecolor_db": 25.0 + gain,
            "volume_iou": 0.9,
        },
        "stage_cpu_s": {"nerf": cpu_s},
    }


@pytest.fixture
def ran(monkeypatch, tmp_path):
    """Cases that were run, each by the law; those of points named `broken` end without an asset."""
    cases = []

    def stand_in(waiting, start, jobs=1):
        for case in waiting:
            point, seed = start(case)
            if point.name == "warm-up":
                yield case, {"outcome": Outcome.CRASHED, "error": "no matter"}
                continue
            cases.append(case)
            result = law(point.config, case.orbit, seed)
            if "texture 2048" in point.name and case.orbit == "cup":
                result = {"outcome": Outcome.CRASHED, "error": "Traceback\nOSError: disk full"}
            yield case, result

    monkeypatch.setattr(command, "run_cases", stand_in)
    monkeypatch.setattr(command, "draw_panels", lambda panels, title, form: b"<svg></svg>")
    monkeypatch.setattr(command.Bench, "start", lambda self, point, case: (point, case.seed))
    for name in OFFSETS:
        (tmp_path / name).mkdir()
        index = {"camera": {"width": 256, "height": 256}, "name": name}
        (tmp_path / name / "orbit.json").write_text(json.dumps(index))
    return cases


def arguments(tmp_path, *more):
    orbits = [str(tmp_path / name) for name in OFFSETS]
    store = str(tmp_path / "store")
    return ["chart", *orbits, "-o", str(tmp_path / "out"), "--store", store, *more]


KNOBS = ("--presets", "preview", "--knobs", "phase1-steps,rays:1024+8192,texture:512")


def test_points_are_measured_drawn_and_named(tmp_path, capsys, ran, monkeypatch):
    monkeypatch.setattr(command, "draw_panels", draw_panels)
    assert main(arguments(tmp_path, *KNOBS, "--scales", "")) == 0
    # Two seeds of the base, four step counts, two numbers of rays, one texture; of two orbits.
    assert len(ran) == 2 * (2 + 4 + 2 + 1)
    out = tmp_path / "out"
    assert (out / "chart.png").read_bytes().startswith(b"\x89PNG")
    assert "</svg>" in (out / "chart.svg").read_text()
    rows = {row["point"]: row for row in csv.DictReader((out / "chart.csv").open())}
    # Eight times the rays cost four times the time and give nothing.
    assert rows["rays 8192"]["overall"] == "dominated"
    assert float(rows["rays 8192"]["cpu_s_change"]) == pytest.approx(3.0)
    assert float(rows["phase1-steps 400"]["relight_delta_db_change"]) == pytest.approx(3.0)
    assert float(rows["preview"]["relight_delta_db"]) == pytest.approx(-1.5)  # the median
    # 1,200 steps give what 800 do.
    assert rows["phase1-steps 1200"]["relight_delta_db_by"] == "phase1-steps 800"
    page = (out / "chart.md").read_text()
    assert "dominated in all figures at once: `rays 8192`, by `rays 1024`" in page
    assert "+3.00 [+3.00, +3.00]" in page
    # Two seeds, 1 % of time apart: three standard errors of a mean of two differences.
    assert "What repeats differ by: CPU s 2.1%." in page
    assert "| preview | +0% [+0%, +0%] | +0.00 [+0.00, +0.00] |" in page
    with (out / "cases.csv").open() as stream:
        assert len(list(csv.DictReader(stream))) == len(ran)
    assert "chart.html: 8 points" in capsys.readouterr().out


def test_recommended_presets_are_measured_points_that_run_reads(tmp_path, capsys, ran):
    assert main(arguments(tmp_path, *KNOBS, "--scales", "")) == 0
    out = tmp_path / "out"
    fast, balanced, best = (
        load_config(PipelineConfig, str(out / f"recommended-{role}.yaml"))
        for role in ("fast", "balanced", "best")
    )
    preview = load_config(PipelineConfig, "preview")
    assert best == load_config(PipelineConfig, "preview", ["nerf.steps=800"])
    assert (fast.nerf.steps, fast.nerf.rays_per_step) == (200, 1024)
    assert 200 < balanced.nerf.steps < 800 and balanced.skip == preview.skip
    assert main(["plan", "example", "--preset", str(out / "recommended-best.yaml")]) == 0
    assert "nerf" in capsys.readouterr().out


def test_a_killed_measurement_goes_on(tmp_path, capsys, ran):
    wanted = arguments(tmp_path, *KNOBS)
    assert main(wanted) == 0
    count = len(ran)
    ran.clear()
    assert main(wanted) == 0
    assert not ran
    file = tmp_path / "out" / "results.jsonl"
    file.write_text(file.read_text()[:-30])
    assert main(wanted) == 0
    assert len(ran) == 1
    assert f"{count} cases, {count - 1} known" in capsys.readouterr().out


def test_a_point_that_fails_is_listed_and_the_rest_goes_on(tmp_path, capsys, ran):
    wanted = arguments(tmp_path, "--presets", "", "--knobs", "texture", "--scales", "")
    assert main(wanted) == 1
    assert "failed: `texture 2048`: cup: crashed (OSError: disk full)" in capsys.readouterr().out
    rows = list(csv.DictReader((tmp_path / "out" / "chart.csv").open()))
    assert {row["point"] for row in rows} == {"preview", "texture 256", "texture 512"}
    # It is tried once more: the disk may have room by then.
    ran.clear()
    assert main(wanted) == 1
    assert [case.name for case in ran] == ["texture 2048, cup"]


def test_points_are_listed_without_running_any(tmp_path, capsys, ran):
    assert main(arguments(tmp_path, "--list", "--quick")) == 0
    listed = capsys.readouterr().out
    assert "phase2-steps 1500: steps of phase 2" in listed and "standard: a preset" in listed
    assert not ran and not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (["--knobs", "rayz"], "--knobs rayz: wanted some of views, size"),
        (["--knobs", "rays:7"], "rays has no value 7; it has 1024, 2048"),
        (["--base", "quick"], "preset 'quick' is unknown"),
        (["--jobs", "0"], "--jobs 0: wanted 1 or more"),
        (["--size", "64", "--photos"], "drop one of the two"),
        (["--size", "4"], "--size 4: wanted 16 pixels or more"),
        (["--set", "nerf.stops=3"], "no such setting"),
    ],
)
def test_wrong_wishes_are_refused(tmp_path, capsys, ran, given, said):
    assert main(arguments(tmp_path, *given)) == 2
    assert said in capsys.readouterr().err
    assert not ran


def test_what_is_no_orbit_is_refused(tmp_path, capsys):
    assert main(["chart", str(tmp_path), "-o", str(tmp_path / "out")]) == 2
    assert "has no orbit.json" in capsys.readouterr().err


def test_the_page_holds_all_points_and_loads_nothing(tmp_path, ran):
    assert main(arguments(tmp_path, *KNOBS, "--scales", "")) == 0
    page = (tmp_path / "out" / "chart.html").read_text()
    start = page.index('id="data">') + len('id="data">')
    data = json.loads(page[start : page.index("</script>", start)])
    assert len(data["points"]) == 8
    base = next(point for point in data["points"] if point["name"] == "preview")
    assert base["change"]["cpu_s"] == "+0% [+0%, +0%]"
    # Drawn are means over orbits: geometric of costs.
    assert base["mean"]["relight_delta_db"] == pytest.approx(-1.5)
    assert base["range"]["relight_delta_db"] == pytest.approx([-1.5, -1.5])
    assert "default-src 'none'" in page
    addresses = re.findall(r'(?:src|href)="(.*?)"', page)
    assert all(address.startswith(("data:", "#")) for address in addresses)
    assert "@import" not in page
    assert "url(" not in page


@pytest.mark.slow
def test_a_real_measurement_of_an_invented_object(tmp_path, capsys):
    short = ("nerf.steps=8", "env_preopt.steps=5", "uv_bake.fit_iterations=1", "env_preopt.size=16")
    wanted = ["chart", "-o", str(tmp_path / "out"), "--store", str(tmp_path / "store")]
    wanted += ["--invented", "1", "--size", "32", "--repeats", "1", "--presets", "preview"]
    wanted += ["--knobs", "texture:256,views:8", "--scales", ""]
    wanted += [f"--set={override}" for override in short]
    assert main(wanted) == 0, capsys.readouterr().out
    rows = {r["point"]: r for r in csv.DictReader((tmp_path / "out" / "chart.csv").open())}
    assert set(rows) == {"preview", "texture 256", "views 8"}
    assert float(rows["texture 256"]["bytes"]) < float(rows["preview"]["bytes"])
    assert all(float(row["cpu_s"]) > 0 and float(row["peak_mib"]) > 100 for row in rows.values())
