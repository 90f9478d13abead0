import csv
import math

import pytest

from flows.cases import Outcome
from flows.stability_cases import BASELINE, OURS, Case
from flows.stability_report import write_page
from flows.stability_table import Verdict, breakdowns, confusion, judge_all, rows_of, write_csv

KINDS = {"warps": ("views_bent",)}
HARMLESS = {"warps": 0.0}


def case(severity, seed=0, way=OURS, hazard="warps"):
    return Case(hazard, "", severity, seed, way)


def asset(score_db, *events, **figures):
    sound = {"score_db": score_db, "finite": True, "watertight": True}
    return {
        "outcome": Outcome.ASSET,
        "figures": sound | {"should_be_watertight": True} | figures,
        "events": [list(event) for event in events],
    }


TOLD = ("nerf", "views_bent", "moved by 2 %")


def judged(result):
    results = {case(0.0): asset(30.0), case(1.0): result}
    return judge_all(results, KINDS, HARMLESS)[1]


@pytest.mark.parametrize(
    ("result", "verdict", "has_failed"),
    [
        (asset(29.0), Verdict.ASSET, False),
        (asset(29.0, TOLD), Verdict.NOTED, False),
        (asset(26.9, TOLD), Verdict.NOTED, True),
        (asset(26.9), Verdict.SILENT, True),
        (asset(26.9, ("uv_bake", "material", "a palette")), Verdict.SILENT, True),
        (asset(29.0, watertight=False), Verdict.ASSET, True),
        (asset(29.0, watertight=False, should_be_watertight=False), Verdict.ASSET, False),
        (asset(29.0, euler=2, true_euler=0), Verdict.ASSET, True),
        (asset(29.0, euler=0, true_euler=0), Verdict.ASSET, False),
        (asset(29.0, euler=2, true_euler=None), Verdict.ASSET, False),
        (asset(29.0, cavities=1), Verdict.ASSET, True),
        (asset(29.0, TOLD, finite=False), Verdict.NOT_FINITE, True),
        (asset(29.0, equal_bytes=False), Verdict.SILENT, True),
        ({"outcome": "refused", "error": "wanted views"}, Verdict.REFUSED, True),
        ({"outcome": "crashed", "error": "Traceback"}, Verdict.CRASHED, True),
        ({"outcome": "too long", "error": "300 s"}, Verdict.TOO_LONG, True),
    ],
)
def test_verdicts(result, verdict, has_failed):
    found = judged(result)
    assert (found.verdict, found.has_failed) == (verdict, has_failed)


def test_a_case_is_held_against_its_own_seed_and_our_way():
    results = {
        case(0.0, 0): asset(40.0),
        case(0.0, 1): asset(20.0),
        case(0.0, 0, BASELINE): asset(10.0),
        case(1.0, 0, BASELINE): asset(30.0),
        case(1.0, 1): asset(19.0),
    }
    lost = {one.case: one.lost_db for one in judge_all(results, KINDS, HARMLESS)}
    assert lost[case(1.0, 0, BASELINE)] == 10.0
    assert lost[case(1.0, 1)] == 1.0


def sweep():
    results = {
        case(severity, seed, way): asset(30.0 - loss * severity + 0.1 * seed, TOLD)
        for way, loss in ((OURS, 1.0), (BASELINE, 3.0))
        for seed in (0, 1)
        for severity in (0.0, 2.0, 4.0)
    }
    return judge_all(results, KINDS, HARMLESS)


def test_rows_gather_seeds_and_tell_where_each_way_breaks_down():
    rows = rows_of(sweep())
    assert [(row.way, row.severity, len(row.cases)) for row in rows][:3] == [
        (OURS, 0.0, 2),
        (OURS, 2.0, 2),
        (OURS, 4.0, 2),
    ]
    assert breakdowns(rows) == {("warps", "", OURS): 4.0, ("warps", "", BASELINE): 2.0}


def test_the_table_on_disk_reads_back(tmp_path):
    write_csv(rows_of(sweep()), tmp_path / "stability.csv")
    with (tmp_path / "stability.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == 6
    assert (rows[2]["rate"], rows[2]["p50_db"], rows[2]["breakdown"]) == ("1", "26.05", "4")
    assert rows[2]["noted"] == "2" and rows[2]["forbidden"] == "0"


def test_confusion_counts_what_each_came_out_as():
    metal = case(1.0, hazard="gloss-or-metal")
    figures = {"was_metal": True, "is_metal": False}
    found = judge_all(
        {metal: asset(20.0, **figures)}, {"gloss-or-metal": ()}, {"gloss-or-metal": 0.0}
    )
    assert math.isnan(found[0].lost_db)
    assert confusion(found) == {
        (True, False): 1,
        (True, True): 0,
        (False, True): 0,
        (False, False): 0,
    }


def test_the_report_stands_alone_and_escapes_what_it_quotes(tmp_path):
    results = {
        case(0.0): asset(30.0) | {"strip": "AAAA"},
        case(1.0): {"outcome": "crashed", "error": "Traceback\nValueError: <script>"},
    }
    found = judge_all(results, KINDS, HARMLESS)
    about = {"warps": ("views & warps", "pixels")}
    write_page(found, rows_of(found), about, ["how <it> was measured"], tmp_path / "x.html")
    page = (tmp_path / "x.html").read_text()
    assert "<script" not in page and "&lt;script&gt;" in page
    assert "views &amp; warps" in page and "how &lt;it&gt; was measured" in page
    assert "http" not in page.replace("http-equiv", "")
    assert page.count("<img ") == page.count('<img alt="') == 1
    assert 'class="bad">1</td>' in page
