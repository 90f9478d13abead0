"""Cleaning takes what is old and not needed, in one step each, and nothing else."""

import os
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import pytest
from small_artifacts import DAY_S, make_old, publish, recipe_of, tree

from stages.errors import TransientError
from stages.locks import file_lock, is_locked
from stages.store import Store
from stages.store_cleaning import LEASE, TRASH, collect_garbage

PROJECT = Path(__file__).resolve().parents[2]
MONTH_S = 30 * DAY_S


@pytest.fixture
def store(tmp_path) -> Store:
    return Store(tmp_path / "store", say=lambda _: None)


def clean(store: Store, *needed: str, **options) -> list[tuple[str, str]]:
    """Kind and name of what went."""
    options = {"older_than_s": MONTH_S} | options
    removed = collect_garbage(store, lambda: frozenset(needed), **options)
    return [(removal.kind, removal.path.name) for removal in removed]


def test_only_what_is_both_old_and_not_needed_goes(store):
    old, needed, young = (publish(store, number) for number in range(3))
    for key in (old, needed):
        make_old(store.artifact(key), days=31)
    make_old(store.artifact(young), days=29)
    assert clean(store, needed) == [("artifact", old)]
    assert store.keys() == sorted([needed, young])
    assert not (store.root / TRASH).exists()
    assert clean(store, needed) == []


def test_artifact_that_some_process_holds_stays(store):
    key = publish(store, 0)
    make_old(store.artifact(key), days=99)
    with file_lock(store.root / "lock" / key) as is_held:
        assert is_held and is_locked(store.root / "lock" / key)
        assert clean(store) == clean(store, dry_run=True) == []
    assert clean(store) == [("artifact", key)]


def test_half_done_work_that_some_process_holds_stays(store):
    key = recipe_of(0).key
    store.work(key).mkdir(parents=True)
    make_old(store.work(key), days=99)
    with file_lock(store.root / "lock" / key):
        assert clean(store) == clean(store, dry_run=True) == []
    assert clean(store) == [("unfinished stage", key)]


def test_half_done_work_goes_when_it_is_old_and_no_run_wants_it(store):
    fresh, wanted, given_up, published = (recipe_of(number).key for number in range(4))
    publish(store, 3)
    for key in (fresh, wanted, given_up, published):
        store.work(key).mkdir(parents=True)
        (store.work(key) / "checkpoint").write_bytes(b"step 7")
        make_old(store.work(key), days=0 if key == fresh else 40)
    gone = clean(store, wanted, published)
    assert sorted(gone) == sorted([("unfinished stage", given_up), ("unfinished stage", published)])
    assert store.work(fresh).exists() and store.work(wanted).exists()
    assert store.check(published).state == "ok"


def test_work_with_a_new_file_deep_below_is_not_old(store):
    work = store.work(recipe_of(0).key)
    (work / "deep").mkdir(parents=True)
    make_old(work, days=40)
    (work / "deep" / "checkpoint").touch()
    make_old(work / "deep" / "checkpoint", days=1)
    then = time.time() - 40 * DAY_S
    for folder in (work / "deep", work):
        os.utime(folder, (then, then))
    assert clean(store) == []


def test_quarantine_counts_from_the_day_it_was_set_aside(store):
    for days in (1, 40):
        key = publish(store, days)
        (store.artifact(key) / "files" / "b.txt").unlink()
        make_old(store.artifact(key), days=99)
        Store(store.root, say=lambda _: None).quarantine(key)
        (entry,) = (store.root / "bad").glob(f"{key}.*")
        moment = time.time_ns() - int(days * DAY_S * 1e9)
        entry.rename(entry.with_name(f"{key}.{moment}"))
    ((kind, name),) = clean(store)
    assert kind == "quarantined artifact" and name.startswith(recipe_of(40).key)


def test_temporaries_of_killed_writers_go_after_a_day(store):
    publish(store, 0)
    names = ("shared/prefilter/op.1.tmp", "runs/.page.77", "incoming/x1/half")
    for name in names:
        file = store.root / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(b"half")
    operator = store.root / "shared/prefilter/op.safetensors"
    operator.write_bytes(b"whole")
    assert clean(store) == []
    for name in ("shared", "runs", "incoming"):
        make_old(store.root / name, days=1.1)
    assert [kind for kind, _ in clean(store)] == ["leftover"] * 3
    assert operator.exists()
    assert not any((store.root / name).exists() for name in names)


def test_dry_run_tells_the_same_and_writes_nothing(store):
    for number in range(5):
        make_old(store.artifact(publish(store, number)), days=31)
    before = tree(store.root)
    told = collect_garbage(store, frozenset, older_than_s=MONTH_S, dry_run=True)
    assert tree(store.root) == before
    real = collect_garbage(store, frozenset, older_than_s=MONTH_S)
    assert told == real and len(real) == 5
    assert {r.path.name: r.size for r in real} == {
        recipe_of(n).key: 7 + 3 + before[f"obj/{recipe_of(n).key}/manifest.json"][0]
        for n in range(5)
    }


def test_store_that_is_not_there_is_clean(tmp_path):
    assert clean(Store(tmp_path / "nowhere")) == []
    assert not (tmp_path / "nowhere").exists()


def test_cleaning_waits_for_nobody(store):
    publish(store, 0)
    with file_lock(store.root / LEASE, shared=True), pytest.raises(TransientError, match="again"):
        clean(store)


def test_needs_are_asked_while_no_run_can_begin(store):
    key = publish(store, 0)
    make_old(store.artifact(key), days=31)

    def needed() -> frozenset[str]:
        assert is_locked(store.root / LEASE)
        return frozenset({key})

    assert collect_garbage(store, needed, older_than_s=MONTH_S) == []


KILLED = """
    import os, signal, sys
    from pathlib import Path
    from stages import store_cleaning as module
    from stages.store import Store

    store, moment = Store(Path(sys.argv[1])), sys.argv[2]

    def die(*_, **__):
        os.kill(os.getpid(), signal.SIGKILL)

    rename, calls = Path.rename, []

    def rename_twice(path, target):
        calls.append(path)
        if len(calls) == 3:
            die()
        return rename(path, target)

    def delete_a_file_of_each(trash, **_):
        for artifact in Path(trash).iterdir():
            (artifact / "files" / "b.txt").unlink()
        die()

    if moment == "between renames":
        Path.rename = rename_twice
    elif moment == "before deleting":
        module.shutil.rmtree = die
    else:
        module.shutil.rmtree = delete_a_file_of_each
    module.collect_garbage(store, frozenset, older_than_s=100.0)
"""


@pytest.mark.parametrize(
    ("moment", "left"), [("between renames", 4), ("before deleting", 1), ("while deleting", 1)]
)
def test_kill_leaves_a_sound_store_and_the_next_cleaning_ends_the_work(store, moment, left):
    keys = [publish(store, number) for number in range(6)]
    for key in keys[1:]:
        make_old(store.artifact(key), days=1)
    process = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(KILLED), str(store.root), moment], cwd=PROJECT
    )
    assert process.returncode == -9
    again = Store(store.root)
    assert len(again.keys()) == left
    assert all(again.check(key).state == "ok" for key in again.keys())  # noqa: SIM118
    assert list((store.root / TRASH).iterdir())
    collect_garbage(again, frozenset, older_than_s=100.0)
    assert again.keys() == [keys[0]] and not (store.root / TRASH).exists()
