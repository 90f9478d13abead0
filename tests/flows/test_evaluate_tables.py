import csv
import math

import pytest
import torch

from flows.evaluate_files import CSV, FAILURES, LATEX, MARKDOWN, OBJECTS, write_tables
from flows.evaluate_orb import orb_table
from flows.evaluate_paper import OTHER, notes_for
from flows.evaluate_sets import samples_table, sets_table
from flows.evaluate_tables import tables_of
from svim3d.io.weights import save_tensors
from svim3d.metrics.features import frechet_distance

CAT, DOG, COW = ("cat", 0), ("dog", 0), ("cow", 0)


AGREEMENT = {
    "drawn": {"apart": 0.02, "rgb_apart": 0.04, "compared": 0.5},
    "true views": {"apart": 0.01, "compared": 0.6},
}


def view(part, subject, azimuth=0.0, light="A", **figures):
    return {
        "part": part,
        "subject": subject,
        "light": light,
        "azimuth_deg": azimuth,
        "figures": figures,
    }


def page(level, *, drawn=False):
    """Scores of an object whose every picture has `level` dB."""
    views = [
        view("reference", "asset", rgb_db=level, basecolor_db=level, normal_deg=10.0),
        view("given", "asset", 90.0, rgb_db=level - 1, basecolor_db=level),
        view("given", "asset", 350.0, rgb_db=level - 3, basecolor_db=level),
        view("novel", "asset", 30.0, rgb_db=level, rgb_ssim=0.5, basecolor_db=level),
        view("relit", "asset", 30.0, "B", rgb_db=level - 2, rgb_ssim=0.5),
        view("relit", "asset", 30.0, "C", rgb_db=level - 4, rgb_ssim=0.5),
        view("relit", "true views", 30.0, "B", rgb_db=40.0, rgb_ssim=0.9),
    ]
    if drawn:
        views.append(view("given", "drawn", 90.0, rgb_db=12.0))
        views.append(view("relit", "drawn", 30.0, "B", rgb_db=11.0))
    return {
        "views": views,
        "surface": {"chamfer": 0.01 * level, "f_0.1": 1.0},
        "agreement": AGREEMENT if drawn else {},
        "framing": 1.0,
        "cost": {"seconds": 2.0, "cpu_s": 3.0},
    }


RESULTS = {
    "standard": {CAT: page(20.0), DOG: page(24.0), COW: page(28.0)},
    "no-dmtet": {CAT: page(19.0), DOG: page(22.0)},
}


def table(name, results=RESULTS):
    return next(t for t in tables_of(results, {}) if t.name == name)


def line(name, row, subject, results=RESULTS):
    return next(x for x in table(name, results).lines if (x.row, x.subject) == (row, subject))


def test_means_are_over_views_then_over_objects():
    views = line("views", "standard", "asset")
    assert views.figures["rgb_db"] == {CAT: 18.0, DOG: 22.0, COW: 26.0}
    relit = line("relighting", "standard", "asset")
    assert relit.figures["relit_db"] == {CAT: 17.0, DOG: 21.0, COW: 25.0}
    assert relit.figures["novel_db"] == {CAT: 20.0, DOG: 24.0, COW: 28.0}


def test_azimuth_bins_are_centred_on_the_photo():
    assert line("azimuth", "standard", "asset, 0 deg").figures["rgb_db"][CAT] == 18.5
    assert line("azimuth", "standard", "asset, 90 deg").figures["rgb_db"][CAT] == 19.0
    assert not any(x.subject == "asset, 45 deg" for x in table("azimuth").lines)


def test_rows_are_compared_with_the_first_by_object():
    first = line("ablation", "standard", "asset")
    second = line("ablation", "no-dmtet", "asset")
    assert first.base is None
    assert second.base == first
    assert second.figures["cpu_s"] == {CAT: 3.0, DOG: 3.0}


def test_one_row_has_no_ablation_and_only_drawn_views_are_told_as_drawn():
    alone = {"standard": {CAT: page(20.0, drawn=True)}}
    names = [t.name for t in tables_of(alone, {})]
    assert "ablation" not in names
    assert "stanford-orb" not in names
    drawn = line("views", "standard", "drawn", alone)
    assert drawn.figures["rgb_db"] == {CAT: 12.0}
    assert drawn.figures["apart"] == {CAT: 0.02}
    true = line("views", "(any)", "true views", alone)
    assert (true.figures["apart"], true.figures["compared"]) == ({CAT: 0.01}, {CAT: 0.6})
    relit = line("views", "standard", "drawn, relit in 2.5D", alone)
    assert relit.figures["rgb_db"] == {CAT: 11.0}
    assert not any(x.subject == "drawn" for x in table("views").lines)


def test_true_views_are_told_once():
    true = [x for x in table("relighting").lines if x.subject == "true views"]
    assert [x.row for x in true] == ["(any)"]


def test_equal_pictures_are_left_out_of_means():
    one = page(20.0)
    one["views"].append(view("given", "asset", 100.0, rgb_db=math.inf))
    assert line("views", "a", "asset", {"a": {CAT: one}}).figures["rgb_db"] == {CAT: 18.0}


def capture(level, **more):
    """Scores of a capture: pictures of `level` and half of it, and what is told of the whole."""
    one = {"views": [], "surface": {}, "agreement": {}, "framing": 1.0, "capture": more}
    one["cost"] = {"seconds": 1.0, "cpu_s": 1.0}
    for db in (level, level / 2):
        figures = {
            "orb.official.psnr_hdr_db": db,
            "orb.official.ssim": 0.9,
            "orb.foreground.psnr_hdr_db": db - 9.0,
        }
        one["views"].append(view("relit", "asset", 0.0, "novel", **figures))
    albedo = {"orb.albedo.official.psnr_ldr_db": level + 10.0, "orb.geometry.normal": 0.1}
    one["views"].append(view("novel", "asset", **albedo))
    return one


def orb_lines(results, missing):
    found = orb_table(results, missing, ["A note."])
    return {line.subject: line.figures for line in found.lines}, found


def test_rows_of_stanford_orb_count_what_is_missing_as_white():
    results = {"a": {("mug", 0): capture(24.0, depth=0.3, shape=0.5)}}
    missing = {"a": {("cup", 0): capture(8.0, shape=9.0), ("pot", 0): None}}
    lines, found = orb_lines(results, missing)
    official = lines["relit, official"]
    assert official["psnr_hdr_db"] == {("mug", 0): 18.0, ("cup", 0): 6.0}
    assert list(official["failed"].values()) == [2.0]
    assert lines["relit, foreground"]["psnr_hdr_db"] == {("mug", 0): 9.0, ("cup", 0): -3.0}
    assert lines["relit, official, worst capture"]["psnr_hdr_db"] == {("cup", 0): 6.0}
    # Between two captures the tenth percentile lies a tenth of the way.
    (tail,) = lines["relit, official, tenth percentile"]["psnr_hdr_db"].values()
    assert tail == pytest.approx(7.2)
    assert lines["albedo, official"]["psnr_ldr_db"] == {("mug", 0): 34.0, ("cup", 0): 18.0}
    geometry = lines["geometry, official"]
    assert geometry["depth"] == {("mug", 0): 0.3}
    assert geometry["shape"] == {("mug", 0): 0.5, ("cup", 0): 9.0}
    # Less is better there: the worst capture is the one that has most.
    assert lines["geometry, official, worst capture"]["shape"] == {("cup", 0): 9.0}
    assert "novel views, official" not in lines
    note, told = found.notes
    assert note == "A note."
    assert told.startswith("a: 2 of 3 without an asset (cup, pot), scored as white pictures but ")
    assert "but for pot, whose truth cannot be read" in told
    assert "relit cup" in told


def test_nothing_failed_is_told_too():
    lines, found = orb_lines({"a": {("mug", 0): capture(24.0)}}, {"a": {}})
    assert list(lines["relit, official"]["failed"].values()) == [0.0]
    assert "0 of 1 without an asset" in found.notes[1]
    assert orb_table({"a": {CAT: page(20.0)}}, {"a": {}}, []) is None


def test_seeds_of_a_capture_make_one_capture():
    results = {"a": {("mug", 0): capture(20.0), ("mug", 1): capture(28.0)}}
    lines, _ = orb_lines(results, {"a": {("cup", 0): capture(16.0), ("cup", 1): capture(24.0)}})
    assert lines["relit, official, worst capture"]["psnr_hdr_db"] == {("cup", 0): 15.0}


def test_objects_count_alike_whatever_their_seeds(tmp_path):
    results = {"a": {("cat", 0): page(20.0), ("cat", 1): page(24.0), ("dog", 0): page(30.0)}}
    write_tables(tables_of(results, {}), results, [], [], tmp_path)
    rows = list(csv.DictReader((tmp_path / CSV).open()))
    (row,) = [
        r
        for r in rows
        if (r["table"], r["figure"]) == ("relighting", "novel_db") and r["subject"] == "asset"
    ]
    assert (float(row["mean"]), int(row["objects"])) == (26.0, 2)  # not 24.67
    assert 20.0 <= float(row["low"]) < 26.0 < float(row["high"]) <= 30.0
    objects = list(csv.DictReader((tmp_path / OBJECTS).open()))
    assert {r["seed"] for r in objects if r["object"] == "cat"} == {"0", "1"}


def test_samples_tell_mean_best_and_deviation():
    assert samples_table(RESULTS) is None
    results = {"a": {("cat", 0): page(20.0), ("cat", 1): page(24.0), ("dog", 0): page(30.0)}}
    found = {line.subject: line.figures for line in samples_table(results).lines}
    cat = ("cat", 0)  # the dog's single sample is no best of two
    assert found["asset, mean"]["novel_db"] == {cat: 22.0}
    assert found["asset, best of 2"]["novel_db"] == {cat: 24.0}
    assert found["asset, best of 2"]["chamfer"] == {cat: pytest.approx(0.2)}  # less is better
    assert found["asset, deviation"]["novel_db"] == {cat: pytest.approx(2.0 * math.sqrt(2.0))}


def kept(folder, rows):
    """Scores with features: one row a picture, of two networks."""
    folder.mkdir()
    save_tensors(
        folder / "features.safetensors",
        {
            f"asset/{network}/{side}": rows[network, side]
            for network in ("fid", "clip")
            for side in ("shown", "true")
        },
    )
    return page(20.0) | {"folder": str(folder)}


def test_sets_are_of_all_objects_that_every_row_has(tmp_path):
    generator = torch.Generator().manual_seed(0)
    drawn = [
        {
            (network, side): torch.randn(4, 6, generator=generator)
            for network in ("fid", "clip")
            for side in ("shown", "true")
        }
        for _ in range(3)
    ]
    cat, dog, cow = (kept(tmp_path / n, d) for n, d in zip(("a", "b", "c"), drawn, strict=True))
    results = {"one": {CAT: cat, DOG: dog, COW: cow}, "two": {CAT: dog, DOG: cat}}
    found = sets_table(results)
    assert found.figures == ("fid", "cmmd", "clip_similarity")  # nothing is named after another
    pooled = [torch.cat([d["fid", side] for d in drawn[:2]]) for side in ("shown", "true")]
    (value,) = found.lines[0].figures["fid"].values()
    assert value == pytest.approx(frechet_distance(*pooled), rel=1e-6)
    # The same pictures in another order are the same set.
    (again,) = found.lines[1].figures["fid"].values()
    assert again == pytest.approx(value, rel=1e-6)
    assert "2 objects that every row has" in found.notes[0]


def test_without_networks_there_are_no_sets(tmp_path):
    (tmp_path / "a").mkdir()
    assert sets_table({"one": {CAT: page(20.0) | {"folder": str(tmp_path / "a")}}}) is None


@pytest.fixture
def written(tmp_path):
    failures = [("no-dmtet", "cow", 0, "Traceback\nnerf: ran out of memory")]
    tables = tables_of(RESULTS, {"geometry": ["A note."]})
    write_tables(tables, RESULTS, failures, ["How it was measured: 100 %."], tmp_path)
    return tmp_path


def test_markdown_says_means_intervals_and_differences(written):
    text = (written / MARKDOWN).read_text()
    assert "| standard | asset | 24.00 [20.00, 28.00] | 21.00 [17.00, 25.00] |" in text
    # The second row is compared over the two objects that both have: 1 and 2 dB less.
    assert "| no-dmtet | asset | 20.50 (-1.50 [-2.00, -1.00])" in text
    assert "A note." in text
    assert "## Failures: 1" in text
    assert "- cow, no-dmtet, seed 0: nerf: ran out of memory" in text


def test_csv_holds_what_the_tables_do(written):
    rows = list(csv.DictReader((written / CSV).open()))
    chosen = [
        r
        for r in rows
        if (r["table"], r["row"], r["figure"]) == ("ablation", "no-dmtet", "relit_db")
    ]
    (row,) = chosen
    assert float(row["mean"]) == 17.5
    assert (float(row["difference"]), int(row["paired_objects"])) == (-1.5, 2)
    objects = list(csv.DictReader((written / OBJECTS).open()))
    relit = [r for r in objects if (r["object"], r["light"]) == ("cat", "C")]
    assert {(r["row"], float(r["value"])) for r in relit if r["figure"] == "rgb_db"} == {
        ("standard", 16.0),
        ("no-dmtet", 15.0),
    }
    (failure,) = csv.DictReader((written / FAILURES).open())
    assert (failure["object"], failure["row"]) == ("cow", "no-dmtet")
    assert not list(written.glob("*.tmp"))


def test_latex_is_escaped_and_complete(written):
    text = (written / LATEX).read_text()
    assert (
        text.count("\\begin{tabular}")
        == text.count("\\end{tabular}")
        == len(tables_of(RESULTS, {}))
    )
    assert "asset, 0 deg & " in text
    assert "% A note." in text
    body = [x for x in text.splitlines() if "&" in x]
    assert all(x.endswith("\\\\") for x in body)
    # Whatever starts a comment would hide the rest of its line.
    assert all(x.startswith("%") or "%" not in x.replace("\\%", "") for x in text.splitlines())


def test_one_object_has_no_interval(tmp_path):
    write_tables(tables_of({"a": {CAT: page(20.0)}}, {}), {}, [], [], tmp_path)
    assert "[" not in (tmp_path / MARKDOWN).read_text()


def test_figures_of_others_say_when_they_do_not_compare():
    assert OTHER in notes_for("poly-haven", "materials")[0]
    assert OTHER in notes_for("gso", "geometry")[0]
    assert notes_for("orbits", "materials") == []
    assert notes_for("blender-vault", "materials") == []
    assert "24.43" in notes_for("stanford-orb", "stanford-orb")[0]
