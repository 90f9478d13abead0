"""Pages tell what there is to know of a stage and of a run, and take nothing for markup."""

from dataclasses import replace

from tiny_job import page
from tiny_runs import compute, plan_tiny

from flows.pages import product_stages, run_page, stage_page
from flows.pipeline import IMAGE_TO_ASSET


def test_stage_shows_how_it_went_its_picture_and_how_its_terms_moved(store, source):
    plan = plan_tiny(store, source, "walk.steps=7")
    walk = compute(plan, store)["walk"]
    text = stage_page(walk, {"views.png": b"jpeg"})
    assert text.startswith("computed in 0.") and f"key `{walk.key[:8]}`" in text
    assert "![views.png](data:image/jpeg;base64,anBlZw==)" in text
    rows = (walk.folder.parent / "scalars.csv").read_text().splitlines()
    first, last = rows[0].split(",")[2], rows[-1].split(",")[2]
    assert f"| mean | {first} | {last} | 6 |" in text
    assert stage_page(replace(walk, is_cached=True), {}).startswith("taken from the store")


def test_run_shows_all_stages_and_where_to_read_on(store, source):
    plan = plan_tiny(store, source, skip=frozenset({"walk"}))
    artifacts = compute(plan, store)
    text = run_page(plan, artifacts, {}, page(), "")
    rows = [line for line in text.splitlines() if line.startswith("|")]
    assert [row.split("|")[1].strip() for row in rows[2:]] == ["digits", "walk", "total"]
    assert "| skipped |" in rows[3] and len({row.count(" | ") for row in rows}) == 1
    assert page().id in text and page().folder in text
    message = artifacts["total"].manifest.record["events"][0]["message"]
    assert message.split()[0] in rows[4]


def test_failure_comes_first_and_nothing_is_taken_for_markup(store, source):
    plan = plan_tiny(store, source)
    text = run_page(plan, {}, {}, None, "ValueError: <img src=x> | a_b\nc")
    assert text.startswith("**ValueError: \\<img src=x\\> \\| a\\_b c**")
    assert text.count("| compute |") == 3


def test_best_picture_of_a_run_is_its_preview(store, source):
    plan = replace(plan_tiny(store, source), pipeline=IMAGE_TO_ASSET)
    # What export has of pictures are an OBJ's maps.
    assert list(product_stages(plan)) == ["preview", "generation", "export"]
