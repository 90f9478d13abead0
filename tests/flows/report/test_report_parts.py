"""Curves, charts and notes of reports."""

import ast
import math
from pathlib import Path

import pytest

from flows.pipeline import IMAGE_TO_ASSET
from flows.report.charts import (
    MOST_POINTS,
    Line,
    line_chart,
    nice_step,
    smoothed,
    sparkline,
    thinned,
)
from flows.report.evidence import read_curves
from flows.report.notes import ADVICE, FAULTS, OTHER_FAULT, WITHOUT, Grade, grouped, remedy
from stages import errors

PROJECT = Path(__file__).resolve().parents[3]
TELLERS = {"event", "notify", "_notify", "tell", "_tell"}
NO_KINDS = {"could not"}


def told_kinds():
    """Every kind that some stage or reader tells of, read off the code."""
    for folder in ("stages", "svim3d"):
        for file in (PROJECT / folder).rglob("*.py"):
            for node in ast.walk(ast.parse(file.read_text())):
                if isinstance(node, ast.Call):
                    name = getattr(node.func, "attr", getattr(node.func, "id", ""))
                    first = node.args[0] if node.args else None
                    is_text = isinstance(first, ast.Constant) and isinstance(first.value, str)
                    if name in TELLERS and is_text and len(node.args) > 1:
                        yield first.value, file.name
    # Findings on views are yielded as pairs.
    tree = ast.parse((PROJECT / "svim3d" / "render" / "view_findings.py").read_text())
    for node in ast.walk(tree):
        if isinstance(node, ast.Yield) and isinstance(node.value, ast.Tuple):
            kind = node.value.elts[0]
            if isinstance(kind, ast.Constant):
                yield kind.value, "view_findings.py"


def test_every_kind_of_event_comes_with_advice():
    found = dict(told_kinds())
    assert {"views_disagree", "few_views", "clamped", "capacity", "resumed"} <= set(found)
    assert not {kind: file for kind, file in found.items() if kind not in ADVICE}


def test_every_stage_that_can_be_missing_says_what_that_means():
    rare = {node.name for node in IMAGE_TO_ASSET.nodes if node.is_skippable or node.only_for}
    assert rare == set(WITHOUT)


def test_every_fault_of_ours_has_a_remedy():
    ours = {name for name in vars(errors) if name.endswith("Error") and name != "InputError"}
    assert ours | {"InputError"} <= set(FAULTS)
    assert remedy("FullError: no space") == FAULTS["FullError"]
    assert remedy("KeyError: 'x'") == OTHER_FAULT


def test_notes_are_grouped_by_weight_and_kind():
    events = [
        ("nerf", "lod", "one"),
        ("nerf", "view_outvoted", "view 3"),
        ("dmtet", "view_outvoted", "view 3"),
        ("dmtet", "view_outvoted", "view 3"),
        ("x", "never heard of", "what"),
    ]
    notes = grouped(events)
    assert list(notes) == [Grade.ACT, Grade.MENDED, Grade.CHOSEN]
    assert notes[Grade.ACT][0].messages == [("nerf", "view 3"), ("dmtet", "view 3")]
    assert notes[Grade.MENDED][0].kind == "never heard of"


def test_curves_are_read_and_what_was_cut_is_left_out(tmp_path):
    file = tmp_path / "scalars.csv"
    file.write_text("1,a,0.5\n1,b,7\n2,a,nan\n3,a,2\nx,a,1\n4,a\n5,a,4")
    curves = read_curves(file)
    assert list(curves) == ["a"]  # of b there is one point alone
    assert [step for step, _ in curves["a"]] == [1, 2, 3, 5]
    assert math.isnan(curves["a"][1][1])
    assert read_curves(tmp_path / "none.csv") == {}


def test_smoothing_keeps_lines_and_the_mean_of_noise():
    line = [(x, 3.0 * x - 1.0) for x in range(200)]
    assert all(math.isclose(y, 3.0 * x - 1.0) for x, y in smoothed(line))
    waves = [(x, float((-1) ** x)) for x in range(200)]
    assert max(abs(y) for _, y in smoothed(waves)[8:-8]) < 0.1
    assert smoothed(waves)[0] == waves[0] and smoothed(waves)[-1] == waves[-1]


def test_thinning_keeps_both_ends():
    curve = [(x, 0.0) for x in range(1000)]
    kept = thinned(curve)
    assert len(kept) == MOST_POINTS and kept[0] == curve[0] and kept[-1] == curve[-1]


def test_a_sparkline_spans_its_box_and_is_logarithmic_where_that_is_needed():
    svg = sparkline("loss & more", [(0, 1.0), (5, 2.0), (10, 3.0)])
    assert "loss &amp; more" in svg and "logarithmic" not in svg
    assert "6.0,66.0 120.0,36.0 234.0,6.0" in svg
    halves = sparkline("loss", [(k, 2.0**-k) for k in range(11)])
    assert "logarithmic" in halves
    assert "6.0,6.0 28.8,12.0 51.6,18.0" in halves  # halving is a straight line
    assert sparkline("loss", [(0, math.nan), (1, 2.0)]) == ""


def test_a_chart_has_a_line_for_each_way():
    lines = [Line("ours", [(0, 30.0), (3, 20.0)], "ours"), Line("plain", [(0, 29.0)], "plain")]
    svg = line_chart("Score", lines, unit="dB", ticks=[0, 1, 3])
    assert svg.count("<polyline") == 2 and svg.count("<circle") == 3
    assert 'aria-label="Score"' in svg and "Score, dB" in svg
    assert ">1<" in svg and ">20<" in svg


@pytest.mark.parametrize(("least", "step"), [(0.7, 1.0), (1.2, 2.0), (3.0, 5.0), (6.0, 10.0)])
def test_ticks_are_round(least, step):
    assert nice_step(least) == step and math.isclose(nice_step(least * 1e-3), step * 1e-3)
