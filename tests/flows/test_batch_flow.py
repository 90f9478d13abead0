"""Batches under the engine: failures stay alone, dead workers are replaced, a rerun goes on."""

import json
import signal
import time

import pytest
import tiny_batch
from tiny_batch import rows, states
from tiny_pipeline import TINY, TinyConfig

from flows import cli
from flows.batch_job import JobError
from stages.store import Store

pytestmark = pytest.mark.flow


def write(folder, **contents: str) -> None:
    folder.mkdir(exist_ok=True)
    for name, text in contents.items():
        (folder / f"{name}.txt").write_text(text)


def test_batch_isolates_failures_replaces_workers_and_goes_on(
    engine, tmp_path, capsys, monkeypatch
):
    told = tmp_path / "told"
    monkeypatch.setenv(
        "SVIM3D_ON_FAILURE", f'echo "$SVIM3D_ASSET $SVIM3D_STATE $SVIM3D_STAGE" >> {told}'
    )
    write(tmp_path / "in", a="1 2", twin="1 2", broken="one", lost="3", doomed="4")
    lines = [
        {"input": "in/a.txt"},
        {"input": "in/twin.txt"},
        {"input": "in/a.txt", "name": "other", "walk.steps": 3, "seed": 1},
        {"input": "in/broken.txt"},
        {"input": "in/nowhere.txt"},
        {"input": "in/a.txt", "name": "bad", "walk.steps": "many"},
        {"input": "in/lost.txt", "walk.fault": "killed"},
        {"input": "in/doomed.txt", "walk.fault": "killed", "walk.faults": 9},
    ]
    manifest = tmp_path / "all.jsonl"
    manifest.write_text("\n".join(map(json.dumps, lines)))
    out, store = tmp_path / "isolated", tmp_path / "store"
    command = [manifest, "-o", out, "--store", store, "--jobs", 2]
    assert tiny_batch.main(command) == cli.FAILED
    good = {"a": "computed", "twin": "cached", "other": "computed", "lost": "computed"}
    bad = dict.fromkeys(("broken", "nowhere", "bad", "doomed"), "failed")
    assert states(out) == good | bad
    table = rows(out)
    assert list(table) == ["a", "twin", "other", "broken", "nowhere", "bad", "lost", "doomed"]
    assert table["broken"]["stage"] == "digits" and "write numbers" in table["broken"]["error"]
    assert "does not exist" in table["nowhere"]["error"] and table["nowhere"]["stage"] == ""
    assert "walk.steps: input should be a valid integer" in table["bad"]["error"]
    assert "by signal SIGKILL, 2 times" in table["doomed"]["error"]
    assert json.loads((out / "lost" / "run.json").read_text())["lost_workers"] == 1
    for name in good:
        assert table[name]["asset"] == str(out / name / "total.safetensors")
    same = [(out / name / "total.safetensors").read_bytes() for name in ("a", "twin", "other")]
    assert same[0] == same[1] != same[2]
    # a and twin are one recipe of three stages, other and lost have theirs, doomed got to one.
    assert sum(1 for _ in Store(store).recent(99)) == 3 + 3 + 3 + 1
    # The batch tells of those that were killed; of what never began there is no run.
    assert sorted(told.read_text().splitlines()) == ["broken failed digits", "doomed died walk"]
    log = (out / "broken" / "run.log").read_text()
    assert "write numbers" in log and not (out / "broken" / "log.txt").exists()
    assert "4 failed" in capsys.readouterr().out.split("results.csv: ")[1]

    # What is left is what failed; mended inputs are computed, and others not touched.
    written = (out / "a" / "run.json").stat().st_mtime_ns
    write(tmp_path / "in", broken="5")
    manifest.write_text("\n".join(json.dumps(line) for line in lines[:4]))
    assert tiny_batch.main(command) == cli.DONE
    assert states(out) == {"a": "cached", "twin": "cached", "other": "cached", "broken": "computed"}
    assert (out / "a" / "run.json").stat().st_mtime_ns == written
    _require_subflows(out.name)


def _require_subflows(batch: str) -> None:
    """Each input is a flow run of its own, under that of the batch.

    Asked for by name: the server, which other tests use as well, lists 200 runs at most.
    """
    from prefect.client.orchestration import get_client
    from prefect.client.schemas import filters

    named = filters.FlowRunFilter(name=filters.FlowRunFilterName(any_=[batch]))
    with get_client(sync_client=True) as client:
        deadline = time.monotonic() + 10
        while True:
            parents = client.read_flow_runs(flow_run_filter=named)
            if sorted(run.state_name for run in parents) == ["Completed", "Failed"]:
                break
            assert time.monotonic() < deadline, [(run.name, run.state_name) for run in parents]
            time.sleep(0.2)
        within = filters.FlowRunFilterParentFlowRunId(any_=[run.id for run in parents])
        below = client.read_flow_runs(
            flow_run_filter=filters.FlowRunFilter(parent_flow_run_id=within)
        )
    assert {run.name for run in below} >= {
        "a · standard · seed 0",
        "a · standard · seed 1",
        "broken · standard · seed 0",
        "lost · standard · seed 0",
    }


def test_fault_of_the_batch_itself_is_raised(engine, tmp_path):
    from flows.batch_flow import Batch, make_runner, run_batch
    from flows.batch_job import BatchJob

    def tell(job, outcome):
        assert isinstance(outcome, JobError) and "does not exist" in outcome.message
        raise OSError("the table cannot be written")

    job = BatchJob(
        name="gone",
        pipeline=TINY,
        schema=TinyConfig,
        source=tmp_path / "gone.txt",
        out=tmp_path / "out",
        preset="standard",
        overrides=(),
        skip=frozenset(),
        seed=0,
        device="cpu",
        store=tmp_path / "store",
    )
    with pytest.raises(OSError, match="the table cannot be written"):
        run_batch(Batch([job], tell, workers=None), make_runner("local", 1, None), "faulty")


def test_cancelled_batch_leaves_what_it_did_and_goes_on(engine, tmp_path):
    write(tmp_path / "in", a="1", b="2", c="3")
    out, store = tmp_path / "out", tmp_path / "store"
    slow = ["--set", "walk.steps=100", "--set", "walk.pause_s=0.1"]
    command = [tmp_path / "in", "-o", out, "--store", store, "--jobs", 2, *slow]
    process = tiny_batch.start(command)
    deadline = time.monotonic() + 120
    while len(list(store.glob("work/*/checkpoint.safetensors"))) < 2:
        assert process.poll() is None and time.monotonic() < deadline, process.communicate()
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == cli.CANCELLED, errors
    assert "goes on where this one stopped" in errors and "Traceback" not in errors
    assert states(out) == dict.fromkeys("abc", "cancelled")
    assert len(list(store.glob("work/*/checkpoint.safetensors"))) == 2
