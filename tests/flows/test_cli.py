"""The command line: answers at once, refuses in one line, exits with a code for scripts."""

import resource
import subprocess
import sys
from pathlib import Path

import pytest
import tiny_command
from tiny_runs import compute, plan_tiny

from flows import cli
from stages.store import Store

PROJECT = Path(__file__).resolve().parents[2]
HELP_LIMIT_S = 0.5


def test_help_imports_nothing_heavy_and_answers_at_once():
    script = """
import sys
from flows.cli import main
try:
    main(["--help"])
finally:
    heavy = {"torch", "prefect", "pydantic", "yaml", "rich", "numpy"} & set(sys.modules)
    assert not heavy, heavy
"""
    # Processor seconds: the wall clock would measure what else this machine does.
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run([sys.executable, "-c", script], cwd=PROJECT, check=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    assert cpu_s < HELP_LIMIT_S


@pytest.mark.parametrize(
    "command",
    [
        *(
            "run",
            "plan",
            "presets",
            "doctor",
            "status",
            "resume",
            "logs",
            "store",
            "serve",
            "batch",
        ),
        "automations",
    ],
)
def test_every_command_explains_itself(command, capsys):
    with pytest.raises(SystemExit) as stopped:
        cli.main([command, "--help"])
    assert stopped.value.code == 0
    assert f"svim3d {command}" in capsys.readouterr().out


def test_version_is_printed(capsys):
    with pytest.raises(SystemExit):
        cli.main(["--version"])
    assert capsys.readouterr().out.startswith("svim3d")


def test_no_command_is_bad_usage(capsys):
    assert cli.main([]) == cli.BAD_INPUT
    assert "COMMAND" in capsys.readouterr().out


def test_presets_are_listed(capsys):
    assert cli.main(["presets"]) == cli.DONE
    printed = capsys.readouterr().out
    assert all(preset in printed for preset in ("preview", "standard", "paper", "auto"))


def test_doctor_describes_the_machine_and_finds_damage(tmp_path, source, capsys):
    store = Store(tmp_path / "store")
    artifacts = compute(plan_tiny(store, source), store)
    assert cli.main(["doctor", "--store", str(store.root)]) == cli.DONE
    printed = capsys.readouterr().out
    assert "cores" in printed and "3 artifacts" in printed and "all is well" in printed
    (artifacts["walk"].folder / "numbers.safetensors").unlink()
    assert cli.main(["doctor", "--store", str(store.root)]) == cli.FAILED
    assert "numbers.safetensors is gone" in capsys.readouterr().out.replace("\n", "")


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["run", "nowhere.glb"], "input nowhere.glb does not exist"),
        (["plan", "SOURCE", "--set", "walk.stepz=3"], "did you mean walk.steps"),
        (["plan", "SOURCE", "--set", "walk.steps=x"], "walk.steps: input should be a valid"),
        (["plan", "SOURCE", "--preset", "fast"], "choose one of preview, standard, paper"),
        (["run", "SOURCE", "--skip", "total"], "--skip total: later stages need it"),
        (["run", "SOURCE", "--only", "walk"], "use --until walk"),
        (["run", "SOURCE", "--timeout", "walc=3"], "--timeout walc=3: no such stage"),
        (["run", "SOURCE", "--timeout", "walk=0"], "--timeout walk=0: wanted seconds"),
        (["run", "SOURCE", "--timeout", "soon"], "--timeout soon: wanted seconds"),
    ],
)
def test_bad_usage_is_one_line_and_code_2(arguments, complaint, source, tmp_path, capsys):
    given = [str(source) if a == "SOURCE" else a for a in arguments]
    assert tiny_command.main([*given, "--store", str(tmp_path / "store")]) == cli.BAD_INPUT
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1 and lines[0].startswith("svim3d: ") and complaint in lines[0]


@pytest.mark.parametrize("arguments", [["run", "--device", "tpu"], ["bake"], ["run", "--sed", "x"]])
def test_what_the_parser_refuses_is_code_2(arguments, capsys):
    with pytest.raises(SystemExit) as stopped:
        cli.main(arguments)
    assert stopped.value.code == cli.BAD_INPUT


def test_debug_shows_the_traceback(tmp_path, capsys):
    options = ["--debug", "--store", str(tmp_path)]
    assert cli.main(["run", "nowhere.glb", *options]) == cli.BAD_INPUT
    assert "Traceback" in capsys.readouterr().err


def test_plan_lists_hits_misses_and_reasons(tmp_path, source, capsys):
    store = Store(tmp_path / "store")
    compute(plan_tiny(store, source), store)
    options = [str(source), "--store", str(store.root), "--set", "walk.steps=3"]
    assert tiny_command.main(["plan", *options]) == cli.DONE
    digits, walk, total, summary = capsys.readouterr().out.strip().splitlines()[1:]
    assert "hit" in digits and "nothing changed" in digits
    assert "miss" in walk and "walk.steps 40 -> 3" in walk
    assert "miss" in total and "another walk" in total
    assert summary == "2 of 3 stages would be computed"


def test_run_that_the_store_can_answer_loads_neither_torch_nor_prefect(tmp_path, source):
    store = Store(tmp_path / "store")
    compute(plan_tiny(store, source), store)
    out = tmp_path / "out"
    process = tiny_command.start(["run", source, "-o", out, "--store", store.root])
    printed, errors = process.communicate(timeout=60)
    assert process.returncode == 0, errors
    assert printed.splitlines()[-1] == "loaded: nothing"
    assert printed.count("cached") == 3
    assert (out / "total.safetensors").is_file()


def test_example_is_shipped():
    assert cli.main(["plan"]) == cli.DONE


def test_store_that_cannot_be_written_is_refused_before_the_engine_starts(source, tmp_path, capsys):
    (tmp_path / "file").write_text("in the way")
    given = ["run", str(source), "--store", str(tmp_path / "file" / "store")]
    assert tiny_command.main(given) == cli.BAD_INPUT
    assert "choose another --store" in capsys.readouterr().err
