"""What `svim3d data` makes of its command line."""

import json

from flows.cli import main


def test_data_is_rendered_from_the_command_line(tmp_path, capsys):
    out, store = tmp_path / "data", tmp_path / "store"
    arguments = ["data", "render", str(out), "--objects", "1", "--size", "16", "--views", "3"]
    arguments += ["--lights", "1", "--store", str(store)]
    assert main(arguments) == 0
    assert "1 made" in capsys.readouterr().out
    assert json.loads((out / "dataset.json").read_text())["objects"] == 1
    assert main(arguments) == 0
    assert "1 kept" in capsys.readouterr().out


def test_sizes_out_of_bounds_are_refused(tmp_path, capsys):
    assert main(["data", "render", str(tmp_path), "--objects", "0"]) == 2
    assert "--objects: wanted 1 to" in capsys.readouterr().err


def test_cycles_wants_an_interpreter(tmp_path, capsys):
    arguments = ["data", "render", str(tmp_path / "data"), "--objects", "1", "--backend", "cycles"]
    assert main(arguments) == 2
    assert "--cycles-python" in capsys.readouterr().err
    assert main([*arguments, "--cycles-samples", "0"]) == 2
    assert "--cycles-samples: wanted 1 to" in capsys.readouterr().err
