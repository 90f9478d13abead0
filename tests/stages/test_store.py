"""The store computes once, shows nothing half done, and mends what was damaged."""

import errno
import json
import os
import shutil
import subprocess
import sys
import textwrap
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from stages import store as store_module
from stages.errors import InputError, TransientError
from stages.keys import Recipe
from stages.store import Store

PROJECT = Path(__file__).resolve().parents[2]


def recipe(**config) -> Recipe:
    return Recipe("blur", config, 0, {}, {}, {})


class Stage:
    """A computation that counts its calls."""

    def __init__(self, content: bytes = b"pixels") -> None:
        self.calls = 0
        self.content = content

    def __call__(self, payload: Path, work: Path) -> dict:
        self.calls += 1
        (payload / "maps").mkdir()
        (payload / "maps" / "a.bin").write_bytes(self.content)
        (payload / "empty.bin").touch()
        (work / "scalars.csv").write_text("0,loss,1\n")
        return {"seconds": 1.5, "events": []}


@pytest.fixture
def store(tmp_path) -> Store:
    return Store(tmp_path / "store", say=lambda _: None)


def test_artifact_is_computed_once_and_described(store):
    stage = Stage()
    made, found = store.obtain(recipe(), stage), store.obtain(recipe(), stage)
    assert (made.is_cached, found.is_cached, stage.calls) == (False, True, 1)
    assert (found.folder / "maps" / "a.bin").read_bytes() == b"pixels"
    assert set(found.manifest.files) == {"files/maps/a.bin", "files/empty.bin", "scalars.csv"}
    page = json.loads((store.artifact(found.key) / "manifest.json").read_text())
    assert page["key"] == recipe().key and page["record"]["seconds"] == 1.5
    assert page["files"]["files/maps/a.bin"]["size"] == 6
    assert not store.work(found.key).exists()


def test_another_recipe_is_another_artifact(store):
    assert (
        store.obtain(recipe(radius=1), Stage()).key != store.obtain(recipe(radius=2), Stage()).key
    )


def test_failed_computation_leaves_no_artifact_and_keeps_its_checkpoints(store):
    def fail(payload, work):
        (payload / "half.bin").write_bytes(b"ha")
        (work / "checkpoint").write_bytes(b"step 7")
        raise RuntimeError("boom")

    with pytest.raises(RuntimeError, match="boom"):
        store.obtain(recipe(), fail)
    assert store.check(recipe().key).state == "missing"

    def resume(payload, work):
        assert (work / "checkpoint").read_bytes() == b"step 7"
        return Stage()(payload, work)

    stored = store.obtain(recipe(), resume)
    assert "files/half.bin" not in stored.manifest.files
    assert not store.work(stored.key).exists()


def test_forced_computation_takes_the_old_place(store):
    store.obtain(recipe(), Stage(b"old"))
    stored = store.obtain(recipe(), Stage(b"new"), force=True)
    assert (stored.folder / "maps" / "a.bin").read_bytes() == b"new"
    assert store.check(recipe().key).state == "ok"
    assert not store.work(stored.key).exists()


def flip_bit(artifact: Path) -> None:
    (artifact / "files/maps/a.bin").write_bytes(b"pixelS")


def truncate(artifact: Path) -> None:
    (artifact / "files/maps/a.bin").write_bytes(b"pix")


def delete(artifact: Path) -> None:
    (artifact / "files/empty.bin").unlink()


def edit_manifest(artifact: Path) -> None:
    page = json.loads((artifact / "manifest.json").read_text())
    page["record"]["seconds"] = 0.1
    (artifact / "manifest.json").write_text(json.dumps(page))


def drop_manifest(artifact: Path) -> None:
    (artifact / "manifest.json").unlink()


def swap_for_another(artifact: Path) -> None:
    other = Store(artifact.parents[1]).obtain(recipe(other=True), Stage())
    shutil.rmtree(artifact)
    shutil.copytree(other.folder.parent, artifact)


@pytest.mark.parametrize(
    ("damage", "complaint"),
    [
        (flip_bit, "a.bin has changed its content"),
        (truncate, "a.bin has 3 bytes instead of 6"),
        (delete, "empty.bin is gone"),
        (edit_manifest, "does not match its seal"),
        (drop_manifest, "unreadable"),
        (swap_for_another, "another key"),
    ],
)
def test_damaged_artifact_is_set_aside_and_computed_anew(
    tmp_path, damage: Callable[[Path], None], complaint: str
):
    key = Store(tmp_path).obtain(recipe(), Stage()).key
    damage(tmp_path / "obj" / key)
    said: list[str] = []
    store, stage = Store(tmp_path, say=said.append), Stage()
    health = store.check(key)
    assert health.state == "corrupted" and complaint in health.damage
    stored = store.obtain(recipe(), stage)
    assert not stored.is_cached and stage.calls == 1 and complaint in said[0]
    assert Store(tmp_path).check(key).state == "ok"
    assert len(list((tmp_path / "bad").iterdir())) == 1


def test_content_is_hashed_once_per_process_and_sizes_always(store):
    key = store.obtain(recipe(), Stage()).key
    flip_bit(store.artifact(key))
    assert store.check(key).state == "ok"
    truncate(store.artifact(key))
    assert store.check(key).state == "corrupted"


def test_recent_manifests_come_newest_first(store):
    for radius in range(3):
        stored = store.obtain(recipe(radius=radius), Stage())
        os.utime(store.artifact(stored.key), ns=(radius, radius))
    assert [m.recipe.config["radius"] for m in store.recent(2)] == [2, 1]


def test_full_disk_is_said_before_the_work(store, monkeypatch):
    usage = shutil.disk_usage(store.root.parent)._replace(free=10 * 2**20)
    monkeypatch.setattr(store_module.shutil, "disk_usage", lambda _: usage)
    stage = Stage()
    with pytest.raises(TransientError, match="only 10 MiB are free"):
        store.obtain(recipe(), stage)
    assert stage.calls == 0


@pytest.mark.parametrize(
    "fault",
    [
        OSError(errno.ENOSPC, "No space left on device"),
        OSError(errno.EDQUOT, "Disk quota exceeded"),
        RuntimeError("I/O error: No space left on device (os error 28)"),
    ],
)
def test_disk_that_fills_up_during_the_work_is_a_passing_fault(store, fault):
    def fill(payload, work):
        (work / "checkpoint").write_bytes(b"step 7")
        raise fault

    with pytest.raises(TransientError, match=r"no space left .* finished work is kept"):
        store.obtain(recipe(), fill)
    assert (store.work(recipe().key) / "checkpoint").exists()
    assert not store.obtain(recipe(), Stage()).is_cached


def test_read_only_store_gives_what_it_has_and_refuses_the_rest(store, monkeypatch):
    store.obtain(recipe(), Stage())

    def refuse(path, *_, **__):
        raise OSError(errno.EROFS, "Read-only file system", str(path))

    for name in ("mkdir", "rename", "replace"):
        monkeypatch.setattr(Path, name, refuse)
    monkeypatch.setattr(store_module.shutil, "rmtree", refuse)
    assert store.obtain(recipe(), Stage()).is_cached
    with pytest.raises(InputError, match=r"cannot be written .*choose another --store"):
        store.obtain(recipe(radius=9), Stage())


def test_forbidden_file_of_the_input_is_not_blamed_on_the_store(store, tmp_path):
    def read_input(payload, work):
        raise PermissionError(errno.EACCES, "Permission denied", str(tmp_path / "photo.png"))

    with pytest.raises(PermissionError):
        store.obtain(recipe(), read_input)


def test_store_that_goes_away_is_not_made_anew_and_loses_nothing(store, tmp_path):
    store.obtain(recipe(radius=1), Stage())
    away = tmp_path / "away"

    def vanish(payload, work):
        (work / "checkpoint").write_bytes(b"step 7")
        store.root.rename(away)
        (payload / "a.bin").write_bytes(b"pixels")
        return {}

    for compute in (vanish, Stage()):  # and the next try finds it still gone
        with pytest.raises(TransientError, match=r"has gone while it was in use; bring it back"):
            store.obtain(recipe(), compute)
        assert not store.root.exists()
    away.rename(store.root)
    assert (store.work(recipe().key) / "checkpoint").read_bytes() == b"step 7"
    assert not store.obtain(recipe(), Stage()).is_cached
    assert store.obtain(recipe(radius=1), Stage()).is_cached


# What other processes do: each line runs in a process of its own.

COUNTED = """
    import os, sys, time
    from pathlib import Path
    from stages.keys import Recipe
    from stages.store import Store

    root, log = Path(sys.argv[1]), Path(sys.argv[2])

    def compute(payload, work):
        with log.open("a") as stream:
            stream.write("computed\\n")
        time.sleep(float(sys.argv[3]))
        (payload / "a.bin").write_bytes(b"x" * 1000)
        return {}

    stored = Store(root, say=print).obtain(Recipe("blur", {}, 0, {}, {}, {}), compute)
    print("cached" if stored.is_cached else "made")
"""


def start(script: str, *arguments) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(script), *map(str, arguments)],
        cwd=PROJECT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def wait_for(condition: Callable[[], bool], timeout_s: float = 60.0) -> None:
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline, "timed out"
        time.sleep(0.01)


def test_two_processes_compute_once_and_the_waiter_names_the_holder(tmp_path):
    log = tmp_path / "log"
    first = start(COUNTED, tmp_path / "store", log, 2)
    wait_for(log.exists)
    second = start(COUNTED, tmp_path / "store", log, 2)
    outputs = [process.communicate(timeout=60)[0] for process in (first, second)]
    assert outputs[0] == "made\n"
    assert f"which process {first.pid} on" in outputs[1] and outputs[1].endswith("cached\n")
    assert log.read_text() == "computed\n"


def test_waiter_takes_over_from_a_killed_holder(tmp_path):
    log = tmp_path / "log"
    holder = start(COUNTED, tmp_path / "store", log, 600)
    wait_for(log.exists)
    waiter = start(COUNTED, tmp_path / "store", log, 0)
    time.sleep(0.5)
    holder.kill()
    holder.communicate()
    assert waiter.communicate(timeout=60)[0].endswith("made\n")
    assert log.read_text() == "computed\n" * 2


KILLED_IN_PUBLISH = """
    import os, signal, sys
    from pathlib import Path
    from stages import store as module
    from stages.keys import Recipe

    root, moment = Path(sys.argv[1]), sys.argv[2]

    def die(*_, **__):
        os.kill(os.getpid(), signal.SIGKILL)

    def compute(payload, work):
        (work / "checkpoint").write_bytes(b"step 7")
        (payload / "a.bin").write_bytes(b"x" * 1000)
        if moment == "before hashing":
            module.Manifest.of = die
        elif moment == "before the manifest":
            module.Manifest.write = die
        elif moment == "before syncing":
            module._sync = die
        elif moment == "before the rename":
            Path.rename = die
        else:
            module.shutil.rmtree = die
        return {}

    module.Store(root).obtain(Recipe("blur", {}, 0, {}, {}, {}), compute)
"""


@pytest.mark.parametrize(
    ("moment", "is_published"),
    [
        ("before hashing", False),
        ("before the manifest", False),
        ("before syncing", False),
        ("before the rename", False),
        ("after the rename", True),
    ],
)
def test_kill_while_publishing_shows_all_or_nothing(tmp_path, moment, is_published):
    process = start(KILLED_IN_PUBLISH, tmp_path, moment)
    process.communicate(timeout=60)
    assert process.returncode == -9
    store, stage = Store(tmp_path), Stage(b"x" * 1000)
    assert store.check(recipe().key).state == ("ok" if is_published else "missing")
    stored = store.obtain(recipe(), stage)
    assert stage.calls == (0 if is_published else 1)
    assert not store.work(stored.key).exists()
    assert Store(tmp_path).check(stored.key).state == "ok"


def test_wait_has_an_end(tmp_path, monkeypatch):
    log = tmp_path / "log"
    holder = start(COUNTED, tmp_path / "store", log, 600)
    try:
        wait_for(log.exists)
        monkeypatch.setattr(store_module, "LOCK_TIMEOUT_S", 0.3)
        with pytest.raises(TransientError, match=f"held by process {holder.pid}"):
            Store(tmp_path / "store").obtain(recipe(), Stage())
    finally:
        holder.kill()
        holder.communicate()
