"""The page of runs that were put into a store: what it says, and that it is sound HTML."""

import base64
import re
from html.parser import HTMLParser

import pytest
from made_run import ERROR, ODD, VIEWS, failed_run, finished_run
from textured_sphere import sphere_asset

from flows.cli import main
from flows.pipeline import REPORT
from flows.report.writing import report_quietly, write_report

VOID = {"meta", "link", "img", "input", "br", "hr"}


class Soundness(HTMLParser):
    """Collects what a page is made of, and what is wrong with it."""

    def __init__(self):
        super().__init__()
        self.faults, self.open, self.ids, self.labels, self.fields = [], [], [], set(), []
        self.anchors, self.pictures, self.text = [], [], []

    def handle_starttag(self, tag, attributes):
        given = dict(attributes)
        if (tag not in VOID and not self._in("svg")) or (
            self._in("svg") and tag in ("svg", "g", "title", "text")
        ):
            self.open.append(tag)
        if "id" in given:
            self.ids.append(given["id"])
        if tag == "img":
            self.pictures.append(given)
        if tag == "label":
            self.labels.add(given.get("for"))
        if tag == "input":
            self.fields.append((given, "label" in self.open))
        if given.get("href", "").startswith("#"):
            self.anchors.append(given["href"][1:])
        for name in ("src", "href", "action"):
            address = given.get(name, "#")
            if not address.startswith(("data:", "#", "asset.glb")):
                self.faults.append(f"{tag} asks for {address[:60]}")

    def handle_startendtag(self, tag, attributes):
        self.handle_starttag(tag, attributes)
        if self.open and self.open[-1] == tag:
            self.open.pop()

    def handle_endtag(self, tag):
        if not self.open or self.open.pop() != tag:
            self.faults.append(f"{tag} closes what it did not open")

    def handle_data(self, data):
        if not self._in("script") and not self._in("style"):
            self.text.append(data)

    def _in(self, tag):
        return tag in self.open


def checked(page):
    """A page's words; fails where its HTML is unsound or cannot be used by everybody."""
    sound = Soundness()
    sound.feed(page)
    assert not sound.faults and not sound.open
    assert len(sound.ids) == len(set(sound.ids))
    assert set(sound.anchors) <= set(sound.ids)
    assert all("alt" in picture for picture in sound.pictures)
    for given, is_wrapped in sound.fields:
        assert is_wrapped or given["id"] in sound.labels, given
    assert '<html lang="en">' in page and "default-src 'none'" in page
    return " ".join(" ".join(sound.text).split())


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    made, record = finished_run(tmp_path_factory.mktemp("done"))
    write_report(record, made.store, made.folder / REPORT)
    return made, record, (made.folder / REPORT).read_text()


def test_a_finished_run_is_told_of_in_full(done):
    _, record, page = done
    text = checked(page)
    assert "basecolor 19.5 dB" in text and "normals 4.0 degrees" in text
    assert 'class="bad">19.5 dB' in page and 'class="bad">4.0' not in page  # one bound is not kept
    assert ODD in text and "<b>view" not in page
    assert "it counts for less" not in text and "A view counts for less than the others" in text
    assert "dmtet the surface is phase 1's own grid" in text
    assert "nerf 40 steps" in text and page.count('class="spark"') == 1  # the flat term is left out
    assert "photometric" in text and "1 → 0.025" in text
    assert "nerf.steps 40 1200" in text
    assert "nerf.image_size 96" in text and "maps can be averaged over 2 px" in text
    assert "seed 7" in text and "commit 0123456789ab" in text and record.id in text
    assert f"{VIEWS} views around the object" in text
    assert "This run failed" not in text


def test_the_asset_in_the_page_is_the_whole_one(done):
    _made, _, page = done
    held = re.search(r'<script type="application/octet-stream" id="model">([^<]+)<', page)[1]
    assert base64.b64decode(held) == sphere_asset().files["asset.glb"]
    assert page.count('id="light-') == 4  # the asset came without a light of its own


def test_the_same_run_gives_the_same_page_but_for_the_time_of_writing(done, tmp_path):
    made, record, page = done
    write_report(record, made.store, tmp_path / "again.html")
    at = re.compile(r"Written [\d: +-]+ by")
    assert at.sub("", (tmp_path / "again.html").read_text()) == at.sub("", page)


def test_a_failed_run_says_where_and_why_and_shows_what_it_has(tmp_path):
    made, record = failed_run(tmp_path)
    write_report(record, made.store, made.folder / REPORT)
    page = (made.folder / REPORT).read_text()
    text = checked(page)
    assert "This run failed in stage nerf" in text and ERROR in text
    assert "Lower the learning rate" in text and f"svim3d resume {record.id}" in text
    assert "line one" in text  # of the log
    assert "step 3 skipped" in text and text.count(ERROR) == 2  # said once, and in the log
    assert "nerf 12 steps" in text  # as far as it got
    assert f"{VIEWS} views around the object" in text
    assert "<model-viewer" not in page and "How well the asset" not in text


def test_a_run_without_any_artifact_has_a_page_too(tmp_path):
    made, _record = failed_run(tmp_path)
    made.stages.clear()
    empty = made.record("failed", "prepare", "InputError: no <object> was found")
    write_report(empty, made.store, made.folder / REPORT)
    text = checked((made.folder / REPORT).read_text())
    assert "no <object> was found" in text and "what was wanted" in text


def test_large_assets_make_no_large_pages(tmp_path):
    made, record = finished_run(tmp_path, asset=sphere_asset(texture=0))
    file = made.folder / REPORT
    from stages.settings.gallery import GalleryConfig

    write_report(record, made.store, file, GalleryConfig(most_model_mib=0.1))
    page = file.read_text()
    text = checked(page)
    assert "<model-viewer" not in page and "too many for the page" in text
    assert 'href="asset.glb"' in page


def test_a_report_that_cannot_be_written_harms_nothing(tmp_path, monkeypatch, caplog):
    made, record = failed_run(tmp_path)

    def fail(*_):
        raise RuntimeError("no pen")

    monkeypatch.setattr("flows.report.writing.run_page", fail)
    report_quietly(record, made.store)
    assert "no report was written: no pen" in caplog.text
    assert not (made.folder / REPORT).exists()


def test_a_report_without_pictures_is_better_than_none(tmp_path, monkeypatch, caplog):
    made, record = finished_run(tmp_path)

    def fail(*_):
        raise RuntimeError("no paint")

    monkeypatch.setattr("flows.report.writing.obtain_pictures", fail)
    report_quietly(record, made.store)
    assert "has no pictures: no paint" in caplog.text
    assert "basecolor 19.5 dB" in checked((made.folder / REPORT).read_text())


def test_the_command_writes_it_again_and_status_names_it(done, tmp_path, capsys):
    made, record, _ = done
    file = tmp_path / "new" / "page.html"
    store = str(made.store.root)
    assert main(["report", record.id, "--store", store, "-o", str(file)]) == 0
    assert "page.html: 1." in capsys.readouterr().out  # the viewer is one MiB of it
    checked(file.read_text())
    assert main(["status", record.id, "--store", store]) == 0
    assert str(made.folder / REPORT) in capsys.readouterr().out
    assert main(["report", "nobody", "--store", store]) == 2
    assert main(["report", record.id, "--store", store, "--most-mib", "0"]) == 2
    assert "--most-mib 0.0: wanted 0.1 to 64" in capsys.readouterr().err
