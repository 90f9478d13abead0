"""What `svim3d relight` makes of its command line."""

import pytest

from flows.relight import find_subject, parse_turns, parse_views
from stages.errors import InputError


@pytest.mark.parametrize(
    ("text", "turns"),
    [
        ("90", (90.0,)),
        ("-30.5", (-30.5,)),
        ("0:360:90", (0.0, 90.0, 180.0, 270.0)),
        ("0:1:0.25", (0.0, 0.25, 0.5, 0.75)),
        ("90:0:-45", (90.0, 45.0)),
    ],
)
def test_turns_leave_their_end_out_so_that_a_full_turn_loops(text, turns):
    assert parse_turns(text) == turns


def test_rounding_adds_no_turn():
    assert len(parse_turns("0:1:0.1")) == 10


@pytest.mark.parametrize("text", ["", "fast", "1:2", "0:10:1:2", "nan", "0:inf:1"])
def test_unreadable_turns_are_refused(text):
    with pytest.raises(InputError, match="wanted degrees like 90, or START:STOP:STEP"):
        parse_turns(text)


@pytest.mark.parametrize(
    ("text", "count"),
    [("0:360:0", 0), ("0:360:-1", 0), ("0:360:0.1", 3600), ("0:1e308:1e-10", 1000000)],
)
def test_no_turns_and_too_many_are_refused(text, count):
    with pytest.raises(InputError, match=f"there are {count}"):
        parse_turns(text)


def test_views_are_named_or_listed():
    assert parse_views("all") == "all"
    assert parse_views("0,5,20") == (0, 5, 20)
    with pytest.raises(InputError, match="wanted all, reference, or indices"):
        parse_views("first")


def test_a_folder_means_its_orbit_or_its_asset(tmp_path):
    (tmp_path / "orbit").mkdir()
    (tmp_path / "orbit" / "orbit.json").write_text("{}")
    assert find_subject(str(tmp_path / "orbit")) == tmp_path / "orbit"
    artifact = tmp_path / "run" / "generation" / "files"
    artifact.mkdir(parents=True)
    (artifact / "orbit.json").write_text("{}")
    assert find_subject(str(artifact.parent)) == artifact
    (tmp_path / "run" / "asset.glb").write_bytes(b"glTF")
    assert find_subject(str(tmp_path / "run")) == tmp_path / "run" / "asset.glb"
    assert find_subject(str(tmp_path / "some.exr")) == tmp_path / "some.exr"


def test_a_folder_of_anything_else_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"with orbit\.json.* or a run folder"):
        find_subject(str(tmp_path))
