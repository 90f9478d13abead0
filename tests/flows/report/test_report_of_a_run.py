"""Runs of a pipeline with a report: the page comes about by itself, and never in the way."""

from dataclasses import replace

import pytest
from tiny_pipeline import TINY
from tiny_runs import compute, plan_tiny

from flows.pipeline import IMAGE_TO_ASSET, REPORT, Product
from flows.recording import RunRecorder
from flows.run_records import FAILED


@pytest.fixture
def recorder(store, source, tmp_path):
    pipeline = replace(TINY, products=(*TINY.products, Product(REPORT, ())))
    plan = replace(plan_tiny(store, source), pipeline=pipeline)
    out = tmp_path / "out"
    return RunRecorder(store, plan, out, preset="standard", command=("run", "x")), plan, out


def test_the_pipeline_of_assets_has_a_report_and_others_have_none():
    assert IMAGE_TO_ASSET.has_report and not TINY.has_report


def test_a_finished_run_leaves_its_page(recorder, store):
    watched, plan, out = recorder
    with watched:
        for step, stored in zip(plan.steps, compute(plan, store).values(), strict=True):
            watched.finished(step, stored)
    page = (out / REPORT).read_text()
    assert ">done</span>" in page and "digits" in page and "walk" in page
    assert 'class="spark"' in page  # the walk's own scalars


def test_a_failed_run_leaves_a_page_that_says_why(recorder):
    watched, plan, out = recorder
    with pytest.raises(RuntimeError), watched:
        watched.started(plan.steps[1])
        raise RuntimeError("the <walk> ended in a wall")
    page = (out / REPORT).read_text()
    assert watched.record.state == FAILED
    assert "This run failed in stage walk" in page
    assert "RuntimeError: the &lt;walk&gt; ended in a wall" in page


def test_who_stops_a_run_waits_for_no_page(recorder):
    watched, _, out = recorder
    with pytest.raises(KeyboardInterrupt), watched:
        raise KeyboardInterrupt
    assert not (out / REPORT).exists()


def test_a_report_that_fails_leaves_the_run_as_it_was(recorder, monkeypatch):
    watched, _, out = recorder

    def fail(*_):
        raise OSError("no disk")

    monkeypatch.setattr("flows.report.writing.write_report", fail)
    with watched:
        pass
    assert watched.record.state == "done" and not (out / REPORT).exists()
    assert "no report was written: no disk" in (out / "run.log").read_text()
