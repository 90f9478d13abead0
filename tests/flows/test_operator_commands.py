"""What an operator types: status, resume, logs, and the store's own commands."""

import signal
import subprocess
import sys
import textwrap
import time
from dataclasses import replace
from pathlib import Path

import pytest
import tiny_command
from small_artifacts import make_old, publish, tree
from tiny_job import carry_out, gone_process, page

from flows import cli, job, runs
from flows.operator_options import duration_s
from flows.run_records import CANCELLED, DONE, FAILED, RUNNING, RunIndex, StageRecord
from flows.runs import in_short
from stages.store import Store

PROJECT = Path(__file__).resolve().parents[2]


@pytest.fixture
def index(store) -> RunIndex:
    store.root.mkdir()
    return RunIndex(store.root)


@pytest.fixture
def svim3d(store, capsys):
    """`svim3d("status")`: exit code, and what was printed."""

    def command(*arguments: object) -> tuple[int, str]:
        code = cli.main([*map(str, arguments), "--store", str(store.root)])
        printed = capsys.readouterr()
        return code, printed.out + printed.err

    return command


def test_status_tells_the_state_of_every_folders_newest_run(svim3d, index):
    for record in (
        page(1, state=RUNNING, ended=None, step=30, total=200, stage="nerf"),
        page(2, state=RUNNING, ended=None, process=gone_process()),
        page(3),
        page(4, folder="/out/cat3", state=FAILED, stages={"nerf": StageRecord("k", "failed")}),
    ):
        index.write(record)
    code, told = svim3d("status")
    head, *rows, summary = told.splitlines()
    assert code == cli.DONE
    assert head.split() == ["run", "asset", "preset", "state", "stage", "progress", "age", "took"]
    assert rows[0].split()[:6] == [page(4).id, "cat4", "standard", "failed", "nerf", "0/1"]
    assert rows[1].split()[:4] == [page(2).id, "cat2", "standard", "died"]
    assert rows[1].split()[-4:] == ["17", "min", "60", "s"]
    assert rows[2].split()[3:7] == ["running", "nerf", "1/1", "15%"]
    assert summary == "3 runs: 1 failed, 1 died, 1 running"


def test_status_cuts_long_lists_unless_all_are_wanted(svim3d, index):
    for number in range(runs.SHOWN_RUNS + 5):
        index.write(page(number))
    told = svim3d("status")[1].splitlines()
    assert len(told) == runs.SHOWN_RUNS + 2
    assert told[-1] == "45 runs: 45 done; the newest 40 are shown, --all shows all"
    assert len(svim3d("status", "--all")[1].splitlines()) == 47


def test_status_of_one_run_shows_its_stages_and_how_to_go_on(svim3d, index):
    stages = {"nerf": StageRecord("a" * 64, "computing"), "dmtet": StageRecord(None, "skipped")}
    died = page(1, state=RUNNING, ended=None, process=gone_process(), stages=stages)
    index.write(replace(died, error="ValueError: [bold] x"))
    told = svim3d("status", died.id)[1]
    for part in ("died", "ValueError: [bold] x", "/in/cat1.png", f"svim3d resume {died.id}"):
        assert part in told
    rows = [line.split() for line in told.splitlines()]
    assert ["nerf", "stopped", "aaaaaaaa"] in rows and ["dmtet", "skipped"] in rows


def test_status_tells_how_long_the_stage_at_work_will_take(svim3d, index):
    live = page(1, state=RUNNING, ended=None, step=30, total=200, due=time.time() + 8800.0)
    index.write(live)
    assert "1/1 15%, 2 h left" in svim3d("status")[1]
    assert "1/1 15%, 2 h left" in svim3d("status", live.id)[1]
    index.write(replace(live, process=gone_process()))
    assert "left" not in svim3d("status")[1]


def test_status_of_one_run_shows_the_events_of_each_stage(svim3d, index):
    events = ("attempt that failed, number 1: out of memory [x]", "2 views were dropped")
    index.write(page(1, stages={"nerf": StageRecord("a" * 64, "computed", 60.0, events)}))
    told = svim3d("status", page(1).id)[1]
    assert all(event in told for event in events)


def test_scripts_learn_from_the_exit_code_whether_anything_failed(svim3d, index):
    index.write(page(1))
    index.write(page(2, state=RUNNING, ended=None))
    assert svim3d("status", "--failed")[0] == cli.DONE
    assert svim3d("status", page(1).id, "--failed")[0] == cli.DONE
    died = page(3, state=RUNNING, ended=None, process=gone_process())
    index.write(died)
    code, told = svim3d("status", "--failed")
    assert code == cli.FAILED and told.splitlines()[-1] == "1 runs: 1 died"
    assert page(1).id not in told and svim3d("status", died.id, "--failed")[0] == cli.FAILED
    assert svim3d("status")[0] == cli.DONE
    index.write(replace(page(4), folder=died.folder))  # run again since, and done
    assert svim3d("status", "--failed")[0] == cli.DONE


def test_unknown_run_is_bad_usage_and_no_runs_are_none(svim3d, store):
    assert svim3d("status") == (cli.DONE, f"no runs in {store.root / 'runs'}\n")
    for command in ("status", "resume", "logs"):
        code, told = svim3d(command, "nobody")
        assert code == cli.BAD_INPUT and "there is no run nobody" in told
    with pytest.raises(SystemExit) as stopped:
        svim3d("resume")
    assert stopped.value.code == cli.BAD_INPUT


def test_looking_at_runs_loads_nothing_heavy_and_opens_no_artifact(store, index):
    publish(store, 0)
    index.write(page())
    for arguments in (["status"], ["status", page().id], ["store", "gc", "--dry-run"]):
        script = f"""
            import io, sys
            from flows.cli import main
            opened = []
            reader = io.open
            io.open = lambda file, *a, **k: (opened.append(str(file)), reader(file, *a, **k))[1]
            code = main({[*arguments, "--store", str(store.root)]!r})
            heavy = {{"torch", "prefect", "numpy", "pydantic", "yaml"}} & set(sys.modules)
            assert not heavy, heavy
            assert opened and not [name for name in opened if "/obj/" in name], opened
            sys.exit(code)
        """
        command = [sys.executable, "-c", textwrap.dedent(script)]
        done = subprocess.run(command, cwd=PROJECT, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr


def test_lengths_of_time_are_short():
    assert [in_short(s) for s in (-5, 0, 119, 121, 7199, 7300, 2 * 86_400, 9e6)] == [
        "0 s",
        "0 s",
        "119 s",
        "2 min",
        "120 min",
        "2 h",
        "2 d",
        "104 d",
    ]


# A stand-in for the command: notes its arguments and its folder, ends as its input says.
NOTE = """
import os, sys, time
from pathlib import Path
with open(sys.argv[1], "a") as stream:
    stream.write(" ".join([os.getcwd(), *sys.argv[2:]]) + "\\n")
if sys.argv[3] == "kill":
    os.kill(os.getpid(), 9)
if sys.argv[3] == "wait":
    import signal
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(130))
    Path(sys.argv[1]).with_name("waits").touch()
    time.sleep(600)
sys.exit(int(sys.argv[3]))
"""


@pytest.fixture
def notes(tmp_path, monkeypatch) -> Path:
    file = tmp_path / "notes"
    monkeypatch.setattr(runs, "COMMAND", (sys.executable, "-c", NOTE, str(file)))
    return file


@pytest.mark.parametrize(("end", "code"), [("0", 0), ("1", 1), ("2", 2), ("130", 130), ("kill", 1)])
def test_resumed_run_is_given_its_command_where_it_was_given(
    svim3d, index, notes, tmp_path, end, code
):
    index.write(page(1, state=CANCELLED, command=("run", end, "a b"), cwd=str(tmp_path)))
    assert svim3d("resume", page(1).id)[0] == code
    assert notes.read_text() == f"{tmp_path} run {end} a b\n"


def test_all_that_stopped_are_resumed_one_after_the_other(svim3d, index, notes):
    for record in (
        page(1, state=FAILED, command=("run", "0")),
        page(2, state=CANCELLED, command=("run", "2")),
        page(3, state=RUNNING, ended=None, process=gone_process(), command=("run", "0")),
        page(4, command=("run", "0", "done")),
        page(5, state=RUNNING, ended=None, command=("run", "0", "at work")),
        page(6, state=FAILED, command=()),
        page(7, state=FAILED, command=("run", "0"), cwd="/nowhere"),
        page(8, state=FAILED, command=("run", "0"), folder="/out/cat9"),
        page(9, command=("run", "0", "done since")),
    ):
        index.write(record)
    code, told = svim3d("resume", "--all-failed")
    assert code == cli.FAILED and told.splitlines()[-1] == "4 resumed, 2 failed"
    assert "started in /nowhere, which is gone" in told
    assert notes.read_text().splitlines() == ["/ run 0", "/ run 2", "/ run 0"]


def test_cancelled_resume_ends_them_all(svim3d, index, notes):
    for number in (1, 2):
        index.write(page(number, state=FAILED, command=("run", "130")))
    assert svim3d("resume", "--all-failed")[0] == cli.CANCELLED
    assert len(notes.read_text().splitlines()) == 1


def test_nothing_to_resume_is_success(svim3d, index):
    index.write(page())
    assert svim3d("resume", "--all-failed") == (cli.DONE, "0 resumed, 0 failed\n")


def test_run_at_work_and_run_of_others_are_not_resumed(svim3d, index, notes):
    index.write(page(1, state=RUNNING, ended=None))
    index.write(page(2, state=FAILED, command=()))
    for number, complaint in ((1, "still runs, as process"), (2, "left no command")):
        code, told = svim3d("resume", page(number).id)
        assert code == cli.BAD_INPUT and complaint in told
    assert not notes.exists()


def test_stop_by_the_system_reaches_the_resumed_run(store, index, notes, tmp_path):
    index.write(page(1, state=FAILED, command=("run", "wait")))
    script = f"""
        from flows import cli, runs
        runs.COMMAND = {runs.COMMAND!r}
        raise SystemExit(cli.main(["resume", {page(1).id!r}, "--store", {str(store.root)!r}]))
    """
    process = subprocess.Popen([sys.executable, "-c", textwrap.dedent(script)], cwd=PROJECT)
    deadline = time.monotonic() + 60
    while not (tmp_path / "waits").exists():
        assert process.poll() is None and time.monotonic() < deadline
        time.sleep(0.02)
    process.send_signal(signal.SIGTERM)
    assert process.wait(60) == cli.CANCELLED


def test_resumed_run_finds_what_the_first_one_left(store, source, tmp_path, svim3d, monkeypatch):
    """The real command on a run that had computed all and was stopped before its folder was."""
    carry_out(store, source, tmp_path / "first")

    def interrupt(*_, **__):
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(job, "write_run_folder", interrupt)
        stopped = carry_out(store, source, tmp_path / "out")
    assert stopped.state == CANCELLED and not (tmp_path / "out" / "run.json").exists()
    script = str(Path(tiny_command.__file__))
    monkeypatch.setattr(runs, "COMMAND", (sys.executable, script))
    assert svim3d("resume", tmp_path / "out")[0] == cli.DONE
    assert (tmp_path / "out" / "total.safetensors").is_file()
    assert RunIndex(store.root).find(str(tmp_path / "out")).state == DONE


def test_log_is_printed_and_followed_to_the_end(svim3d, index, tmp_path, store):
    index.write(page(1))
    assert "left no log" in svim3d("logs", page(1).id)[1]
    index.log(page(1).id).write_text("first [line]\nüber\n")
    for options in ([], ["--follow"]):
        assert svim3d("logs", "cat1", *options) == (cli.DONE, "first [line]\nüber\n")


def test_followed_log_grows_until_the_run_ends(svim3d, index, monkeypatch):
    index.write(page(1, state=RUNNING, ended=None))
    index.log(page(1).id).write_text("one\n")

    def end_it(seconds: float) -> None:
        with index.log(page(1).id).open("a") as stream:
            stream.write("two\n")
        index.write(page(1))

    monkeypatch.setattr(runs.time, "sleep", end_it)
    assert svim3d("logs", page(1).id, "--follow") == (cli.DONE, "one\ntwo\n")


def test_ls_lists_newest_first_and_sums_by_stage(svim3d, store):
    for number, stage in enumerate(["blur", "blur", "bake"]):
        key = publish(store, number, stage)
        make_old(store.artifact(key), days=10 - number)
    code, told = svim3d("store", "ls")
    rows = [line.split() for line in told.splitlines()]
    assert code == cli.DONE and rows[0] == ["key", "stage", "MiB", "age", "seconds", "result"]
    assert [row[-1] for row in rows[1:4]] == ["2", "1", "0"]
    assert rows[1][1:5] == ["bake", "0.0", "8", "d"]
    assert rows[-3:] == [["blur", "2", "0.0"], ["bake", "1", "0.0"], ["all", "3", "0.0"]]


def test_verify_finds_damage_and_repairs_on_request(svim3d, store):
    keys = [publish(store, number) for number in range(3)]
    assert svim3d("store", "verify")[0] == cli.DONE
    (store.artifact(keys[1]) / "files" / "b.txt").write_text("abd")
    before = tree(store.root)
    code, told = svim3d("store", "verify")
    assert code == cli.FAILED and f"artifact {keys[1][:8]} is damaged" in told
    assert "0.0 MiB are sound, 1 damaged; --repair" in told and tree(store.root) == before
    assert svim3d("store", "verify", "--repair")[0] == cli.FAILED
    assert len(list((store.root / "bad").iterdir())) == 1
    code, told = svim3d("store", "verify")
    assert code == cli.DONE and told.startswith("2 artifacts")


def of_key(number: int, key: str, **changes):
    return page(number, source="/in/cat.png", stages={"a": StageRecord(key, "x")}, **changes)


def test_gc_keeps_what_the_newest_runs_and_those_at_work_need(svim3d, store, index):
    keys = [publish(store, number) for number in range(5)]
    for key in keys:
        make_old(store.artifact(key), days=40)
    for number in range(3):
        index.write(of_key(number, keys[number]))
        index.log(page(number).id).write_text("said")
    index.write(of_key(9, keys[3], state=RUNNING, ended=None, started=1.0))
    old = of_key(8, keys[0], started=1e9, changed=1e9, ended=1e9)
    index.write(old)
    gone = {keys[0], keys[4]}

    code, told = svim3d("store", "gc", "--keep-last", 2, "--dry-run")
    assert code == cli.DONE
    assert {line.split()[-1] for line in told.splitlines()[:-1]} == gone
    size = sum(size for k in gone for n, (size, _) in files_of(store, k).items())
    assert told.splitlines()[-1] == (
        f"0.0 MiB would be removed ({size} bytes): 2 artifacts, 1 run page"
    )
    assert len(store.keys()) == 5 and index.page(old.id).exists()

    code, told = svim3d("store", "gc", "--keep-last", 2)
    assert code == cli.DONE and f"removed ({size} bytes): 2 artifacts" in told
    assert set(store.keys()) == set(keys) - gone
    # Pages of the last days stay, whatever became of their artifacts.
    assert not index.page(old.id).exists() and index.log(page(0).id).exists()
    assert svim3d("store", "gc")[1].startswith("0.0 MiB removed (")


def files_of(store: Store, key: str) -> dict[str, tuple[int, int]]:
    folder = store.artifact(key)
    return {n: v for n, v in tree(folder).items() if (folder / n).is_file()}


def test_gc_leaves_the_young(svim3d, store):
    key = publish(store, 0)
    make_old(store.artifact(key), days=29)
    assert svim3d("store", "gc")[1] == "0.0 MiB removed (0 bytes): nothing\n"
    assert svim3d("store", "gc", "--older-than", "4w")[1].endswith("1 artifact\n")


@pytest.mark.parametrize("text", ["", "d", "30", "3 d", "-3d", "1.5d", "30y", "d30"])
def test_ages_that_are_none_are_bad_usage(svim3d, text, capsys):
    with pytest.raises(SystemExit) as stopped:
        svim3d("store", "gc", f"--older-than={text}")
    assert stopped.value.code == cli.BAD_INPUT
    assert "wanted an age like 12h, 30d or 2w" in capsys.readouterr().err


def test_ages_are_seconds():
    assert [duration_s(t) for t in ("90s", "3m", "12h", "30d", "2w")] == [
        90.0,
        180.0,
        43_200.0,
        2_592_000.0,
        1_209_600.0,
    ]


def test_exported_run_arrives_with_its_page_and_log(store, source, tmp_path, svim3d, capsys):
    record = carry_out(store, source, tmp_path / "out")
    file = tmp_path / "run.tar"
    code, told = svim3d("store", "export", file, "out")
    assert code == cli.DONE and f"{file}: 3 artifacts" in told
    other = ["--store", str(tmp_path / "other")]
    assert cli.main(["store", "import", str(file), *other]) == cli.DONE
    assert f"3 artifacts of {record.id} are new, 0 were there" in capsys.readouterr().out
    there = RunIndex(tmp_path / "other")
    (arrived,) = there.records()
    assert arrived == replace(record, command=(), folder="")
    log = RunIndex(store.root).log(record.id).read_bytes()
    assert there.log(record.id).read_bytes() == log
    assert Store(tmp_path / "other").keys() == store.keys()
    # Once more changes nothing, and the run of others is not given again.
    before = tree(tmp_path / "other" / "obj")
    assert cli.main(["store", "import", str(file), *other]) == cli.DONE
    assert tree(tmp_path / "other" / "obj") == before
    assert cli.main(["resume", record.id, *other]) == cli.BAD_INPUT


def test_export_tells_what_an_unfinished_run_lacks(store, source, tmp_path, svim3d):
    carry_out(store, source, tmp_path / "out", "walk.fault=defect")
    code, told = svim3d("store", "export", tmp_path / "run.tar", "out")
    assert code == cli.DONE and "walk is not in the store" in told and "1 artifacts" in told


def test_import_of_nonsense_is_bad_input(svim3d, tmp_path, store):
    (tmp_path / "run.tar").write_text("nonsense")
    code, told = svim3d("store", "import", tmp_path / "run.tar")
    assert code == cli.BAD_INPUT and len(told.splitlines()) == 1 and store.keys() == []
