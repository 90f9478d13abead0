"""What a manifest, a folder, a pattern mean; names that never collide; a table that is whole."""

import json

import pytest
import tiny_batch

from flows import cli
from flows.batch_inputs import read_entries
from flows.batch_results import Results, Row, State
from stages.errors import InputError

TAKES = (".txt", ".png")


@pytest.fixture
def folder(tmp_path):
    for name in ("a.txt", "b.PNG", "notes.md", ".hidden.txt"):
        (tmp_path / "in" / name).parent.mkdir(exist_ok=True)
        (tmp_path / "in" / name).write_text(name)
    (tmp_path / "in" / "orbit.v2").mkdir()
    (tmp_path / "in" / "orbit.v2" / "orbit.json").write_text("{}")
    (tmp_path / "in" / "deeper").mkdir()
    (tmp_path / "in" / "deeper" / "a.txt").write_text("another")
    return tmp_path / "in"


def names(*given) -> list[str]:
    return [entry.name for entry in read_entries([str(g) for g in given], TAKES)]


def test_folder_gives_what_can_be_used(folder):
    assert names(folder) == ["a", "b", "orbit.v2"]
    assert names(folder / "orbit.v2") == ["orbit.v2"]


def test_pattern_is_followed_into_folders(folder):
    entries = read_entries([f"{folder}/**/*.txt"], TAKES)
    assert [entry.path for entry in entries] == [folder / "a.txt", folder / "deeper" / "a.txt"]


def test_names_are_told_apart_in_any_order_and_equal_entries_are_one(folder):
    (folder / "A.png").write_text("x")
    one, two = folder / "a.txt", folder / "deeper" / "a.txt"
    here, there = names(one, two, folder / "A.png", one), names(folder / "A.png", two, one)
    assert len(here) == len({name.casefold() for name in here}) == 3
    assert sorted(here) == sorted(there) and all(n.casefold().startswith("a-") for n in here)
    assert names(one) == ["a"]


def test_csv_and_jsonl_say_the_same(folder):
    (folder / "all.csv").write_text(
        "\ufeffinput,name,preset,seed,skip,nerf.steps\n"
        'a.txt,first,paper,7,"dmtet, preview",30\n'
        "deeper/a.txt,,,,,\n"
        ",,,,,\n"
    )
    rows = [
        {"input": "a.txt", "name": "first", "preset": "paper", "seed": 7}
        | {"skip": ["preview", "dmtet"], "nerf.steps": 30},
        {"input": "deeper/a.txt"},
    ]
    (folder / "all.jsonl").write_text("\n\n".join(map(json.dumps, rows)))
    from_csv = read_entries([str(folder / "all.csv")], TAKES)
    assert from_csv == read_entries([str(folder / "all.jsonl")], TAKES)
    first, second = from_csv
    assert (first.name, first.preset, first.seed) == ("first", "paper", 7)
    assert first.skip == {"dmtet", "preview"} and first.overrides == ("nerf.steps=30",)
    assert second.path == folder / "deeper" / "a.txt" and second.name == "a"
    assert second.preset is None and second.overrides == ()


@pytest.mark.parametrize(
    ("name", "text", "complaint"),
    [
        ("m.csv", "file\na.txt\n", "line 2: no input"),
        ("m.csv", "input\na.txt,b\n", "line 2: more values than columns"),
        ("m.csv", "input,nerf.stepz\na.txt,3\n", "nerf.stepz is neither a setting"),
        ("m.csv", "input,seed\na.txt,x\n", "the seed 'x' is no number"),
        ("m.csv", "input,name\na.txt,../up\n", "'../up' is no name for a folder"),
        ("m.csv", "input\n", "no inputs there"),
        ("m.jsonl", '{"input": "a.txt"}\n{"input"', "line 2: no JSON"),
        ("m.jsonl", '["a.txt"]', "line 1: wanted an object"),
        ("m.csv", "input,name\na.txt,x\nb.txt,X\n", None),
    ],
)
def test_manifests_that_mean_nothing_are_refused_by_line(tmp_path, name, text, complaint):
    (tmp_path / name).write_text(text)
    if complaint is None:
        found = names(tmp_path / name)
        assert len({n.casefold() for n in found}) == 2
        return
    with pytest.raises(InputError, match=complaint.replace(".", r"\.")):
        read_entries([str(tmp_path / name)], TAKES)


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["*.none"], "no inputs there"),
        (["IN", "--set", "walk.stepz=3"], "did you mean walk.steps"),
        (["IN", "--skip", "total"], "--skip total: later stages need it"),
        (["IN", "--jobs", "0"], "--jobs 0: wanted at least one"),
        (["IN", "--address", "x"], "--address names a cluster"),
        (["IN", "--timeout", "walc=1"], "no such stage"),
    ],
)
def test_bad_usage_is_told_before_anything_is_done(folder, tmp_path, capsys, arguments, complaint):
    given = [folder if argument == "IN" else argument for argument in arguments]
    options = ["-o", tmp_path / "out", "--store", tmp_path / "store"]
    assert tiny_batch.main([*given, *options]) == cli.BAD_INPUT
    assert complaint in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_table_is_whole_at_any_moment(tmp_path):
    results = Results(tmp_path / "new" / "out", [Row("a", "a, b.png"), Row("c", 'say "c".png')])
    assert tiny_batch.states(tmp_path / "new" / "out") == {"a": "waiting", "c": "waiting"}
    results.put(Row("a", "a, b.png", State.FAILED, 1.5, "nerf", "no\nlight"))
    results.cancel()
    results.write()
    assert list(tmp_path.glob("new/out/*")) == [results.file]
    row = tiny_batch.rows(results.file.parent)["a"]
    assert row["state"] == "failed" and row["input"] == "a, b.png" and row["error"] == "no\nlight"
    assert tiny_batch.states(results.file.parent)["c"] == "cancelled"
    assert results.count(State.FAILED) == 1 and len(results) == 2
