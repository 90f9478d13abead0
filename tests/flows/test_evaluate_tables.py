import csv
import math

import pytest

from flows.evaluate_files import CSV, FAILURES, LATEX, MARKDOWN, OBJECTS, write_tables
from flows.evaluate_paper import OTHER, notes_for
from flows.evaluate_tables import tables_of


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
        "framing": 1.0,
        "cost": {"seconds": 2.0, "cpu_s": 3.0},
    }


RESULTS = {
    "standard": {"cat": page(20.0), "dog": page(24.0), "cow": page(28.0)},
    "no-dmtet": {"cat": page(19.0), "dog": page(22.0)},
}


def table(name, results=RESULTS):
    return next(t for t in tables_of(results, {}) if t.name == name)


def line(name, row, subject, results=RESULTS):
    return next(x for x in table(name, results).lines if (x.row, x.subject) == (row, subject))


def test_means_are_over_views_then_over_objects():
    views = line("views", "standard", "asset")
    assert views.figures["rgb_db"] == {"cat": 18.0, "dog": 22.0, "cow": 26.0}
    relit = line("relighting", "standard", "asset")
    assert relit.figures["relit_db"] == {"cat": 17.0, "dog": 21.0, "cow": 25.0}
    assert relit.figures["novel_db"] == {"cat": 20.0, "dog": 24.0, "cow": 28.0}


def test_azimuth_bins_are_centred_on_the_photo():
    assert line("azimuth", "standard", "asset, 0 deg").figures["rgb_db"]["cat"] == 18.5
    assert line("azimuth", "standard", "asset, 90 deg").figures["rgb_db"]["cat"] == 19.0
    assert not any(x.subject == "asset, 45 deg" for x in table("azimuth").lines)


def test_rows_are_compared_with_the_first_by_object():
    first = line("ablation", "standard", "asset")
    second = line("ablation", "no-dmtet", "asset")
    assert first.base is None
    assert second.base == first
    assert second.figures["cpu_s"] == {"cat": 3.0, "dog": 3.0}


def test_one_row_has_no_ablation_and_only_drawn_views_are_told_as_drawn():
    alone = {"standard": {"cat": page(20.0, drawn=True)}}
    names = [t.name for t in tables_of(alone, {})]
    assert "ablation" not in names
    assert "stanford-orb" not in names
    assert line("views", "standard", "drawn", alone).figures["rgb_db"] == {"cat": 12.0}
    relit = line("views", "standard", "drawn, relit in 2.5D", alone)
    assert relit.figures["rgb_db"] == {"cat": 11.0}
    assert not any(x.subject == "drawn" for x in table("views").lines)


def test_true_views_are_told_once():
    true = [x for x in table("relighting").lines if x.subject == "true views"]
    assert [x.row for x in true] == ["(any)"]


def test_equal_pictures_are_left_out_of_means():
    one = page(20.0)
    one["views"].append(view("given", "asset", 100.0, rgb_db=math.inf))
    assert line("views", "a", "asset", {"a": {"cat": one}}).figures["rgb_db"] == {"cat": 18.0}


def test_rows_of_stanford_orb():
    one = page(20.0)
    figures = {"orb.official.psnr_hdr_db": 24.0, "orb.foreground.psnr_hdr_db": 15.0}
    one["views"].append(view("relit", "asset", 0.0, "novel", **figures))
    results = {"a": {"mug": one}}
    found = {x.subject: x.figures["psnr_hdr_db"] for x in table("stanford-orb", results).lines}
    assert found == {"relit, official": {"mug": 24.0}, "relit, foreground": {"mug": 15.0}}


@pytest.fixture
def written(tmp_path):
    failures = [("no-dmtet", "cow", "Traceback\nnerf: ran out of memory")]
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
    assert "- cow, no-dmtet: nerf: ran out of memory" in text


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
    body = [x for x in text.splitlines() if "&" in x]
    assert all(x.endswith("\\\\") for x in body)
    # Whatever starts a comment would hide the rest of its line.
    assert all(x.startswith("%") or "%" not in x.replace("\\%", "") for x in text.splitlines())


def test_one_object_has_no_interval(tmp_path):
    write_tables(tables_of({"a": {"cat": page(20.0)}}, {}), {}, [], [], tmp_path)
    assert "[" not in (tmp_path / MARKDOWN).read_text()


def test_figures_of_others_say_when_they_do_not_compare():
    assert OTHER in notes_for("poly-haven", "materials")[0]
    assert OTHER in notes_for("gso", "geometry")[0]
    assert notes_for("orbits", "materials") == []
    assert notes_for("blender-vault", "materials") == []
    assert "24.43" in notes_for("stanford-orb", "stanford-orb")[0]
