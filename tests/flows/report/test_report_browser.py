"""The page of a run in a browser: the asset turns, the scrubber moves, nothing is asked for."""

import base64
import io
import json
import math
import time

import numpy as np
import pytest
from devtools import browser_page, find_browser
from made_run import VIEWS, failed_run, finished_run
from PIL import Image

from flows.pipeline import REPORT
from flows.report.writing import write_report

pytestmark = [
    pytest.mark.browser,
    pytest.mark.skipif(find_browser() is None, reason="no Chromium is installed"),
]
LOADED = "document.querySelector('model-viewer').loaded === true"
# Of the viewer's own: a name that three.js has changed.
HARMLESS = ("RGBELoader has been deprecated", "rAF timed out")
STILL = """(() => {
  const button = document.getElementById("turn");
  if (button.getAttribute("aria-pressed") === "true") button.click();
})()"""
CORNERS = """(async () => {
  const viewer = document.querySelector("model-viewer");
  await new Promise(done => setTimeout(done, 100));
  return viewer.toDataURL("image/png");
})()"""


@pytest.fixture(scope="module")
def page_file(tmp_path_factory):
    made, record = finished_run(tmp_path_factory.mktemp("browser"))
    file = made.folder / REPORT
    write_report(record, made.store, file)
    return file


@pytest.fixture(scope="module")
def page(page_file, tmp_path_factory):
    with browser_page(tmp_path_factory.mktemp("profile")) as page:
        page.open(page_file.as_uri())
        page.wait_for(LOADED, 90)
        page.evaluate(STILL)
        yield page


def move(page, field, value):
    """Set a slider as a hand would."""
    page.evaluate(
        f"(() => {{ const f = document.getElementById('{field}'); f.value = '{value}'; "
        "f.dispatchEvent(new Event('input', { bubbles: true })); })()"
    )


def seen(page):
    """What the viewer draws, RGBA in [0, 1]."""
    content = base64.b64decode(page.evaluate(CORNERS).partition(",")[2])
    return np.asarray(Image.open(io.BytesIO(content)).convert("RGBA"), np.float32) / 255.0


def eventually(page, is_right, timeout_s=60.0):
    """The picture as soon as it is as wanted; drawing takes what it takes on a busy machine."""
    end = time.monotonic() + timeout_s
    while not is_right(picture := seen(page)):
        assert time.monotonic() < end, "the picture did not come to be as wanted"
        time.sleep(0.2)
    return picture


def halves(picture):
    """Mean colours of the object's middle band, on its left and on its right."""
    height, width = picture.shape[:2]
    band = picture[int(0.45 * height) : int(0.55 * height)]
    reach = int(0.15 * height)
    middle = width // 2
    return (
        band[:, middle - reach : middle - reach // 3, :3].mean((0, 1)),
        band[:, middle + reach // 3 : middle + reach, :3].mean((0, 1)),
    )


def test_the_asset_is_drawn_and_its_sides_are_where_they_were(page):
    picture = eventually(page, lambda picture: picture[..., 3].max() == 1.0)
    left, right = halves(picture)
    radius = page.evaluate("document.querySelector('model-viewer').getCameraOrbit().radius")
    assert math.isclose(radius, 2.2, abs_tol=1e-3)  # the views' own
    assert left[0] > 2.0 * left[1]  # red plastic
    assert right[1] > 0.5 * right[0] > 0.1  # gold


def test_lights_and_exposure_change_the_picture(page):
    before = seen(page)
    bright = 1.2 * halves(before)[0].mean()
    move(page, "exposure", 2)
    eventually(page, lambda picture: halves(picture)[0].mean() > bright)
    move(page, "exposure", 0)
    eventually(page, lambda picture: np.abs(picture - before).mean() < 0.003)
    page.evaluate("document.querySelector('input[name=light][value=night]').click()")
    eventually(page, lambda picture: np.abs(picture - before).mean() > 0.01)
    page.evaluate("document.querySelector('input[name=light][value=studio]').click()")
    eventually(page, lambda picture: np.abs(picture - before).mean() < 0.003)


def test_materials_follow_their_sliders_and_come_back(page):
    before = seen(page)
    red, gold = halves(before)
    move(page, "metallic", -1)  # the gold is none any more
    plastic = eventually(page, lambda picture: np.abs(halves(picture)[1] - gold).max() > 0.03)
    # The plastic is what it was, to what a picture read back loses.
    assert np.abs(halves(plastic)[0] - red).max() < 0.02
    said = page.evaluate("document.querySelector('output[for=metallic]').textContent")
    assert said == "less, 100 %"
    move(page, "tint", "#00ff00")
    eventually(page, lambda picture: halves(picture)[1][1] > 1.5 * halves(picture)[1][0])
    page.evaluate("document.querySelector('button[type=reset]').click()")
    eventually(page, lambda picture: np.abs(picture - before).mean() < 0.003)
    factors = (
        "(() => { const p = document.querySelector('model-viewer').model.materials[0]"
        ".pbrMetallicRoughness; return [p.roughnessFactor, p.metallicFactor]; })()"
    )
    assert page.evaluate(factors) == [1, 1]


def test_the_scrubber_goes_by_keyboard_and_says_where_it_is(page):
    page.evaluate("document.getElementById('view').focus()")
    page.press("ArrowRight")
    page.press("ArrowRight")
    assert page.evaluate("document.getElementById('view').value") == "2"
    said = page.evaluate("document.getElementById('view').getAttribute('aria-valuetext')")
    assert said.startswith("view 1, 90° around")
    picture = "document.querySelector('.tile[data-kind=views] img[data-channel=rgb]')"
    assert page.evaluate(f"{picture}.style.left") == "-200%"
    page.press("ArrowLeft")
    assert page.evaluate(f"{picture}.style.left") == "-100%"
    page.evaluate("document.querySelector('input[name=channel][value=normal]').click()")
    assert page.evaluate(f"{picture}.hidden") is True
    label = page.evaluate("document.querySelector('.tile').getAttribute('aria-label')")
    assert label.startswith("The view: normal, view 0")
    assert page.evaluate("document.getElementById('view').max") == str(VIEWS - 1)


def test_the_viewer_looks_from_where_a_view_was(page):
    page.evaluate("document.getElementById('look').click()")
    page.wait_for("document.querySelector('model-viewer').cameraOrbit.startsWith('45deg')")
    orbit = page.evaluate("document.querySelector('model-viewer').cameraOrbit")
    about = json.loads(page.evaluate("document.getElementById('about').textContent"))
    assert math.isclose(float(orbit.split()[1][:-3]), 90 - about["views"][1]["elevation_deg"])


def test_nothing_fails_and_nothing_is_asked_of_anybody(page, tmp_path):
    page.screenshot(tmp_path / "page.png")
    faults = [
        text
        for level, text in page.log
        if level in ("error", "warning") and not any(known in text for known in HARMLESS)
    ]
    assert not faults
    # The browser's own pages are opened before ours.
    own = ("file:", "data:", "blob:", "chrome:", "about:")
    assert not [url for url in page.requests if not url.startswith(own)]
    assert Image.open(tmp_path / "page.png").size[0] == 1200


def test_without_scripts_all_pictures_are_there(page_file, tmp_path):
    with browser_page(tmp_path, script=False) as page:
        page.send("Page.enable")
        page.send("Page.navigate", url=page_file.as_uri())
        page.wait_for("document.readyState === 'complete'")
        unseen = (
            "[...document.images].map(i => [i.alt, i.complete && i.naturalWidth > 0 && "
            "i.offsetWidth > 0]).filter(([alt, isSeen]) => alt && !isSeen)"
        )
        assert page.evaluate(unseen) == []
        assert page.evaluate("document.querySelectorAll('.tile img').length") == 12
        assert (
            page.evaluate("getComputedStyle(document.querySelector('.controls')).display") == "none"
        )


def test_a_narrow_page_is_not_wider_than_its_window(page_file, tmp_path):
    with browser_page(tmp_path, width=360, height=800, dark=True) as page:
        page.open(page_file.as_uri())
        assert page.evaluate("document.documentElement.scrollWidth") <= 360
        paper = page.evaluate("getComputedStyle(document.body).backgroundColor")
        assert paper == "rgb(20, 22, 26)"


def test_a_failed_run_has_a_working_page(tmp_path):
    made, record = failed_run(tmp_path)
    write_report(record, made.store, made.folder / REPORT)
    (tmp_path / "profile").mkdir()
    with browser_page(tmp_path / "profile") as page:
        page.open((made.folder / REPORT).as_uri())
        assert page.evaluate("document.querySelectorAll('.tile').length") == 1
        assert not [text for level, text in page.log if level == "error"]
