"""Archives carry artifacts whole, and nothing of a foreign one is believed."""

import io
import random
import tarfile
from collections.abc import Callable
from pathlib import Path

import pytest
from small_artifacts import publish, recipe_of, tree

from stages import store_archive
from stages.errors import InputError, TransientError
from stages.locks import file_lock
from stages.store import Store
from stages.store_archive import export_artifacts, import_artifacts
from stages.store_cleaning import LEASE

PAGES = {"run.json": b'{"id": "x"}', "run.log": b"all went well\n"}
KEY = recipe_of(0).key

Members = list[tuple[tarfile.TarInfo, bytes]]


@pytest.fixture
def store(tmp_path) -> Store:
    store = Store(tmp_path / "store", say=lambda _: None)
    for number in range(3):
        publish(store, number)
    return store


@pytest.fixture
def other(tmp_path) -> Store:
    return Store(tmp_path / "other", say=lambda _: None)


@pytest.fixture
def archive(store, tmp_path) -> Path:
    file = tmp_path / "run.tar"
    assert export_artifacts(store, [recipe_of(n).key for n in range(3)], PAGES, file) == []
    return file


def take(store: Store, archive: Path):
    return import_artifacts(store, archive, check_page=lambda page: None)


def test_artifacts_arrive_as_they_were(store, other, archive):
    imported = take(other, archive)
    assert imported.pages == PAGES and imported.kept == ()
    assert sorted(imported.new) == other.keys() == store.keys()
    for key in other.keys():  # noqa: SIM118
        assert Store(other.root).check(key).state == "ok"
        files = [name for name, _ in tree(store.artifact(key)).items()]
        assert sorted(files) == sorted(tree(other.artifact(key)))
        for name in files:
            if (store.artifact(key) / name).is_file():
                ours, theirs = (s.artifact(key) / name for s in (store, other))
                assert ours.read_bytes() == theirs.read_bytes()
    assert list((other.root / "incoming").iterdir()) == []
    assert not (other.root / "work").exists()


def test_same_content_makes_the_same_bytes(store, archive, tmp_path):
    export_artifacts(store, [recipe_of(n).key for n in range(3)], PAGES, tmp_path / "again.tar")
    assert (tmp_path / "again.tar").read_bytes() == archive.read_bytes()


def test_what_a_store_has_stays_and_what_it_has_damaged_is_mended(store, other, archive):
    kept, damaged = (publish(other, number) for number in (0, 1))
    before = tree(other.artifact(kept))
    (other.artifact(damaged) / "files" / "b.txt").unlink()
    imported = take(Store(other.root, say=lambda _: None), archive)
    assert imported.kept == (kept,) and set(imported.new) == set(store.keys()) - {kept}
    assert tree(other.artifact(kept)) == before
    assert Store(other.root).check(damaged).state == "ok"


def test_missing_artifacts_are_told_and_damaged_ones_refused(store, tmp_path):
    file = tmp_path / "part.tar"
    assert export_artifacts(store, [KEY, recipe_of(9).key], PAGES, file) == [recipe_of(9).key]
    (store.artifact(KEY) / "files" / "b.txt").unlink()
    with pytest.raises(InputError, match=r"b.txt is gone.*verify --repair"):
        export_artifacts(store, [KEY], PAGES, tmp_path / "bad.tar")
    assert {path.name for path in tmp_path.iterdir()} == {"store", "part.tar"}


def members(archive: Path) -> Members:
    with tarfile.open(archive) as tar:
        return [(entry, tar.extractfile(entry).read()) for entry in tar]


def write(archive: Path, changed: Members) -> None:
    with tarfile.open(archive, "w") as tar:
        for entry, content in changed:
            tar.addfile(entry, io.BytesIO(content))


def added(name: str, content: bytes = b"evil", **fields) -> Callable[[Members], Members]:
    def change(before: Members) -> Members:
        entry = tarfile.TarInfo(name)
        entry.size = len(content)
        for field, value in fields.items():
            setattr(entry, field, value)
        return [*before, (entry, content)]

    return change


def replaced(ending: str, content: bytes) -> Callable[[Members], Members]:
    def change(before: Members) -> Members:
        after = []
        for entry, old in before:
            new = content if entry.name.endswith(ending) else old
            entry.size = len(new)
            after.append((entry, new))
        return after

    return change


def dropped(ending: str) -> Callable[[Members], Members]:
    return lambda before: [m for m in before if not m[0].name.endswith(ending)]


def renamed_key(before: Members) -> Members:
    for entry, _ in before:
        entry.name = entry.name.replace(KEY, "0" * 64)
    return before


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (added("/etc/passwd"), "is no name"),
        (added("../evil"), "is no name"),
        (added(f"obj/{KEY}/../../evil"), "is no name"),
        (added(f"obj/{KEY}/files/../../../evil"), "is no name"),
        (added(f"obj/{KEY}/files//evil"), "is no name"),
        (added(f"obj/{KEY}/files/.hidden"), "is no name"),
        (added(f"obj/{KEY}/files/a\\b"), "is no name"),
        (added(f"obj/{KEY}/files/{'x' * 300}"), "is no name"),
        (added(f"obj/{KEY}/other.bin"), "is no name"),
        (added("obj/short/files/evil"), "is no name"),
        (added("obj"), "is no name"),
        (added("readme.txt"), "is no name"),
        (added(f"obj/{KEY}/files/x", type=tarfile.SYMTYPE, linkname="/etc/passwd"), "no plain"),
        (added(f"obj/{KEY}/files/x", type=tarfile.LNKTYPE, linkname="run.json"), "no plain"),
        (added(f"obj/{KEY}/files/x", type=tarfile.CHRTYPE), "no plain"),
        (added(f"obj/{KEY}/files/x", type=tarfile.FIFOTYPE), "no plain"),
        (added(f"obj/{KEY}/files/x", b"", type=tarfile.DIRTYPE), "no plain"),
        (added("run.json"), "twice"),
        (added(f"obj/{KEY}/files/b.txt"), "twice"),
        (added(f"obj/{KEY}/files/b.txt/c"), "cannot be read"),
        (added(f"obj/{KEY}/files/extra"), "files/extra' is not both"),
        (added(f"obj/{'f' * 64}/files/x"), "has no manifest.json"),
        (dropped("b.txt"), "files/b.txt' is not both"),
        (replaced("b.txt", b"abd"), "files/b.txt has changed its content"),
        (replaced("b.txt", b"ab"), "files/b.txt has 2 bytes instead of 3"),
        (replaced("manifest.json", b"{}"), "manifest.json is unreadable"),
        (replaced("manifest.json", b"[" * 100_000), "cannot be read|unreadable|recursion"),
        (renamed_key, "that of another key|edited"),
    ],
)
def test_foreign_archive_is_refused_whole(other, archive, tmp_path, change, complaint):
    write(archive, change(members(archive)))
    before = {path.name for path in tmp_path.iterdir()}
    with pytest.raises(InputError, match=complaint):
        take(other, archive)
    assert other.keys() == []
    assert [p for p in other.root.rglob("*") if p.is_file() and p.name != LEASE] == []
    assert {path.name for path in tmp_path.iterdir()} - before <= {"other"}


@pytest.mark.parametrize("name", ["MAX_MIB", "MAX_FILES", "MAX_PAGE_MIB"])
def test_archives_beyond_all_bounds_are_refused(other, archive, monkeypatch, name):
    monkeypatch.setattr(store_archive, name, 0)
    with pytest.raises(InputError, match=r"holds more than|has more than"):
        take(other, archive)
    assert other.keys() == []


def test_size_is_counted_before_the_content_is_read(other, archive):
    """A header may promise any size; sparse files keep what they promise."""
    entry = tarfile.TarInfo(f"obj/{KEY}/files/huge")
    entry.size = 2**60
    with archive.open("r+b") as stream:
        stream.write(entry.tobuf(tarfile.GNU_FORMAT))
    with pytest.raises(InputError, match="holds more than"):
        take(other, archive)
    entry.size = -1
    with archive.open("r+b") as stream:
        stream.write(entry.tobuf(tarfile.GNU_FORMAT))
    with pytest.raises(InputError):
        take(other, archive)


def test_archive_that_does_not_fit_is_a_passing_fault(other, archive, monkeypatch):
    usage = store_archive.shutil.disk_usage(archive.parent)._replace(free=100)
    monkeypatch.setattr(store_archive.shutil, "disk_usage", lambda _: usage)
    with pytest.raises(TransientError, match="does not fit"):
        take(other, archive)


def test_archive_that_was_cut_anywhere_is_refused(other, archive):
    whole = archive.read_bytes()
    content = whole.rstrip(b"\0")
    for size in (0, 100, *range(512, len(content), 3 * 256)):
        archive.write_bytes(whole[:size])
        require_refused(other, archive)
    archive.write_bytes(whole)
    assert len(take(other, archive).new) == 3


def require_refused(other: Store, archive: Path) -> None:
    with pytest.raises(InputError, match=r"cannot be read as a tar|ends in the middle"):
        take(other, archive)
    assert other.keys() == []


def test_compressed_archive_and_no_archive_are_refused(other, archive, tmp_path):
    with tarfile.open(tmp_path / "run.tgz", "w:gz") as tar:
        tar.add(archive, "run.json")
    (tmp_path / "text").write_text("no tar at all")
    for file in (tmp_path / "run.tgz", tmp_path / "text", tmp_path / "nowhere", tmp_path):
        with pytest.raises(InputError, match="cannot be read as a tar"):
            take(other, file)


def test_page_that_makes_no_sense_is_refused(other, archive):
    def refuse(page: bytes) -> None:
        raise ValueError("no id")

    with pytest.raises(InputError, match=r"run.json is none: no id"):
        import_artifacts(other, archive, check_page=refuse)
    assert other.keys() == []


def test_nothing_is_copied_while_the_store_is_cleaned(store, other, archive, tmp_path):
    for one, copy in (
        (store, lambda: export_artifacts(store, [KEY], PAGES, tmp_path / "x.tar")),
        (other, lambda: take(other, archive)),
    ):
        with file_lock(one.root / LEASE), pytest.raises(TransientError, match="being cleaned"):
            copy()


def test_any_changed_byte_is_refused_or_makes_no_difference_to_artifacts(store, archive, tmp_path):
    whole = archive.read_bytes()
    dice = random.Random(5)
    outcomes = set()
    for turn in range(100):
        place = dice.randrange(len(whole.rstrip(b"\0")))
        changed = bytearray(whole)
        changed[place] ^= 1 << dice.randrange(8)
        archive.write_bytes(changed)
        other = Store(tmp_path / "others" / str(turn), say=lambda _: None)
        try:
            take(other, archive)
        except InputError:
            assert other.keys() == []
            outcomes.add("refused")
            continue
        assert other.keys() == store.keys()
        for key in store.keys():  # noqa: SIM118
            assert Store(other.root).check(key).state == "ok"
        outcomes.add("taken")
    assert outcomes == {"refused", "taken"}
    assert {path.name for path in tmp_path.iterdir()} == {"store", "others", "run.tar"}
