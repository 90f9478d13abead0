import csv
import json
from pathlib import Path

import pytest
from scored_sphere import write_truth
from suite_folders import write_orb, write_renders

from flows import evaluate as command
from flows.cli import _parser, main
from flows.evaluate_cases import Row, Subject, known_scores, plan_case, rows_of, run_case
from stages.errors import InputError
from stages.settings.table_scores import TableScoresConfig
from stages.store import Store

PHOTO = TableScoresConfig(from_photo=True)


@pytest.fixture(autouse=True)
def nothing_installed(monkeypatch):
    """Whatever networks lie on this machine, scores are told by none."""
    monkeypatch.setattr("flows.evaluate.EFFICIENTNET_LITE0", ("not-installed", "file"))


@pytest.fixture
def suite(tmp_path):
    for name, size in (("ball", 16), ("marble", 20)):  # equal objects would have equal keys
        write_truth(tmp_path / "suite" / name, size=size)
    return tmp_path / "suite"


def planned(folder, store, *, from_photo=True, row=None, seed=0):
    return plan_case(
        Subject(folder.name, folder),
        row or Row("preview", "preview"),
        store,
        from_photo=from_photo,
        config=TableScoresConfig(from_photo=from_photo),
        seed=seed,
    )


def scores(level):
    figures = {"rgb_db": level, "basecolor_db": level}
    keys = ("part", "subject", "light", "azimuth_deg", "figures")
    views = [dict(zip(keys, ("reference", "asset", "A", 0.0, figures), strict=True))]
    return {"views": views, "surface": {"chamfer": 0.01}, "agreement": {}, "framing": 1.0}


class _Scores:
    def __init__(self, page):
        self._page = page

    def __call__(self, payload, work):
        (payload / "scores.json").write_text(json.dumps(self._page))
        return {}


def put(case, store, level):
    store.obtain(case.recipe, _Scores(scores(level)))


def arguments(suite, tmp_path, *more):
    return (
        *("evaluate", "orbits", str(suite), "--preset", "preview", "-o", str(tmp_path / "out")),
        *("--store", str(tmp_path / "store"), *more),
    )


def test_scores_in_the_store_are_not_computed_again(suite, tmp_path, monkeypatch):
    store = Store(tmp_path / "store")
    for name, level in (("ball", 20.0), ("marble", 22.0)):
        put(planned(suite / name, store), store, level)
    monkeypatch.setattr(command, "run_case", lambda *_, **__: pytest.fail("computed again"))
    assert main(arguments(suite, tmp_path)) == 0
    text = (tmp_path / "out" / "tables.md").read_text()
    assert "21.00 [20.00, 22.00]" in text


def test_rows_are_repeated_with_seeds(suite, tmp_path, monkeypatch, capsys):
    store = Store(tmp_path / "store")
    for name, seed, level in (("ball", 5, 20.0), ("ball", 6, 22.0), ("marble", 5, 30.0)):
        put(planned(suite / name, store, seed=seed), store, level)
    monkeypatch.setattr(command, "run_case", lambda *_, seed, **__: f"nerf: seed {seed} is bad")
    assert main(arguments(suite, tmp_path, "--seed", "5", "--seeds", "2")) == 1
    assert "marble, preview, seed 6: failed: nerf: seed 6 is bad" in capsys.readouterr().out
    rows = list(csv.DictReader((tmp_path / "out" / "tables.csv").open()))
    (row,) = [r for r in rows if (r["table"], r["figure"]) == ("materials", "basecolor_db")]
    assert (float(row["mean"]), row["objects"]) == (25.5, "2")


def test_a_capture_that_failed_is_scored_as_white_and_counted(tmp_path, monkeypatch):
    write_orb(tmp_path / "orb")
    (tmp_path / "orb" / "blender_HDR" / "ball_scene002" / "train" / "0002.exr").unlink()
    monkeypatch.setattr(command, "run_case", lambda *_, **__: "nerf: the views are empty")
    out = tmp_path / "out"
    code = main(
        (
            *("evaluate", "stanford-orb", str(tmp_path / "orb"), "--preset", "preview"),
            *("-o", str(out), "--store", str(tmp_path / "store")),
        )
    )
    assert code == 1
    rows = [r for r in csv.DictReader((out / "tables.csv").open()) if r["table"] == "stanford-orb"]
    means = {(r["subject"], r["figure"]): float(r["mean"]) for r in rows if r["mean"]}
    assert means["relit, official", "failed"] == 2.0
    assert means["geometry, official", "normal"] == 1.0
    # A scale per channel makes white as bright as the object; without it, it is much too bright.
    assert means["relit, official", "psnr_ldr_db"] > means["relit, unscaled", "psnr_ldr_db"]
    assert ("geometry, official", "depth") not in means
    text = (out / "tables.md").read_text()
    assert "2 of 2 without an asset (ball_scene001, ball_scene002), scored as white" in text
    assert "but for ball_scene002, whose truth cannot be read" in text


def test_failures_are_told_and_the_rest_is_scored(suite, tmp_path, monkeypatch, capsys):
    store = Store(tmp_path / "store")
    put(planned(suite / "marble", store), store, 22.0)
    asked = []

    def fail(case, **_):
        asked.append(case.subject.name)
        return "nerf: the views are empty"

    monkeypatch.setattr(command, "run_case", fail)
    assert main(arguments(suite, tmp_path)) == 1
    assert asked == ["ball"]
    told = capsys.readouterr().out
    assert "ball, preview: failed: nerf: the views are empty" in told
    assert "1 scored, 1 failed" in told
    assert "ball,0,nerf: the views" in (tmp_path / "out" / "failures.csv").read_text()
    # What failed is tried again, what is known is not.
    monkeypatch.setattr(
        command, "run_case", lambda case, **_: put(case, Store(tmp_path / "store"), 10.0)
    )
    assert main(arguments(suite, tmp_path)) == 0
    assert "16.00" in (tmp_path / "out" / "tables.md").read_text()


def test_an_object_that_cannot_be_converted_is_a_failure(tmp_path, capsys):
    home = tmp_path / "suite" / "ball"
    write_renders(home)
    (home / "train" / "r_2.png").unlink()
    code = main(
        (
            *("evaluate", "poly-haven", str(tmp_path / "suite"), "--preset", "preview"),
            *("-o", str(tmp_path / "out"), "--store", str(tmp_path / "store")),
        )
    )
    assert code == 1
    assert "r_2" in (tmp_path / "out" / "failures.csv").read_text()


def test_the_generator_is_asked_for_the_truth_s_cameras(suite, tmp_path):
    store = Store(tmp_path / "store")
    case = planned(suite / "ball", store)
    angles = case.plan.config.generation.angles
    assert len(angles) == 4
    assert angles[-1] == (10.0, 0.0)
    assert case.novel.config.generation.angles == (*_test_angles(suite / "ball"), angles[-1])
    views = planned(suite / "ball", store, from_photo=False)
    assert views.novel is None
    assert views.plan.config.generation.path == "static"
    assert views.plan.source == suite / "ball"
    assert case.plan.source == suite / "ball" / "reference.png"


def _test_angles(folder):
    frames = json.loads((folder / "orbit.json").read_text())["test"]
    return tuple((f["elevation_deg"], f["azimuth_deg"] % 360.0) for f in frames)


def test_cameras_that_look_elsewhere_are_not_asked_for(suite, tmp_path):
    file = suite / "ball" / "orbit.json"
    index = json.loads(file.read_text())
    index["train"][0]["c2w"][0][3] += 0.3
    file.write_text(json.dumps(index))
    case = planned(suite / "ball", Store(tmp_path / "store"))
    assert case.plan.config.generation.path == "static"
    assert case.novel is None


def test_another_row_or_truth_is_another_case(suite, tmp_path):
    store = Store(tmp_path / "store")
    rows = rows_of("preview", [], [["short", "nerf.steps=7"], ["paper", "preset=paper"]])
    assert [row.name for row in rows] == ["preview", "short", "paper"]
    keys = {planned(suite / "ball", store, row=row).recipe.key for row in rows}
    keys.add(planned(suite / "ball", store, from_photo=False).recipe.key)
    assert len(keys) == 4
    (suite / "marble" / "mesh.ply").unlink()
    keys.add(planned(suite / "marble", store).recipe.key)
    assert len(keys) == 5


def test_rows_may_leave_stages_out(suite, tmp_path):
    (_, row) = rows_of("standard", ["nerf.steps=9"], [["no dmtet", "skip=dmtet"]])
    case = planned(suite / "ball", Store(tmp_path / "store"), row=row)
    states = {step.node.name: str(step.verdict) for step in case.plan.steps}
    assert states["dmtet"] == "skipped"
    assert case.plan.config.nerf.steps == 9


@pytest.mark.parametrize(
    ("more", "told"),
    [
        (("--objects", "cube"), "wanted some of ball, marble"),
        (("--row", "preview", "nerf.steps=3"), "there is a row of this name"),
        (("--row", "odd", "nerf.stepps=3"), "did you mean nerf.steps"),
        (("--row", "odd", "skip=nerf"), "later stages need it"),
        (("--size", "4"), "wanted 16 or more"),
        (("--seeds", "0"), "wanted one or more"),
        (("--fid", "nowhere.pth"), "there is no file nowhere.pth"),
        (("--clip", "nowhere"), "wanted a folder with a CLIPModel"),
    ],
)
def test_what_is_wrong_for_all_is_refused(more, told, suite, tmp_path, capsys):
    assert main(arguments(suite, tmp_path, *more)) == 2
    assert told in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_views_without_materials_are_refused(tmp_path, capsys):
    assert main(("evaluate", "gso", str(tmp_path), "--from", "views")) == 2
    assert "say --from photo" in capsys.readouterr().err


def test_objects_are_listed(suite, tmp_path, capsys):
    assert main(arguments(suite, tmp_path, "--list")) == 0
    assert capsys.readouterr().out.split() == ["ball", "marble"]


def test_an_orbit_without_a_photo_is_told(suite, tmp_path):
    (suite / "ball" / "reference.png").unlink()
    with pytest.raises(InputError, match="--from views"):
        planned(suite / "ball", Store(tmp_path / "store"))


@pytest.mark.slow
def test_a_case_runs_in_a_process_of_its_own(tmp_path):
    folder = write_truth(tmp_path / "ball", views=8, size=48)
    store = Store(tmp_path / "store")
    row = Row("tiny", "tiny", ("nerf.steps=30", "dmtet.steps=4"))
    case = planned(folder, store, from_photo=False, row=row)
    told = run_case(case, from_photo=False, seed=0, device="cpu", store=store, limit_s=500.0)
    assert told is None
    page = known_scores(case, store)
    assert page["surface"]["chamfer"] < 0.02
    assert page["cost"]["cpu_s"] > 1.0


def test_a_broken_case_says_why(suite, tmp_path):
    store = Store(tmp_path / "store")
    (suite / "ball" / "train" / "001.exr").write_bytes(b"no picture")
    case = planned(suite / "ball", store, from_photo=False)
    told = run_case(case, from_photo=False, seed=0, device="cpu", store=store, limit_s=100.0)
    assert told.startswith("generation: ")
    assert known_scores(case, store) is None


def test_commands_of_the_guide_are_understood():
    guide = (Path(__file__).parents[2] / "docs" / "evaluation.md").read_text()
    commands = [line for line in guide.splitlines() if line.startswith("svim3d evaluate ")]
    assert len(commands) >= 3
    for line in commands:
        options = _parser().parse_args(line.split()[1:])
        assert rows_of(options.preset, options.set, options.row)[0].name == options.preset
