"""A shared store is seen whole or not at all, and never computes what another has."""

import json
import uuid

import fsspec
import pytest
from small_texts import recipe

from stages.errors import InputError
from stages.shared_store import SharedStore, open_store
from stages.store import Store


@pytest.fixture(params=["memory", "file"])
def url(request, tmp_path) -> str:
    return f"memory://{uuid.uuid4().hex}" if request.param == "memory" else f"file://{tmp_path}/far"


class Site:
    """A machine with a local store of its own."""

    def __init__(self, root, url) -> None:
        self.said, self.computed = [], 0
        self.store = SharedStore(root, url, say=self.said.append)

    def get(self, text="abc", **wishes):
        def compute(payload, work):
            self.computed += 1
            (payload / "deep").mkdir()
            (payload / "deep" / "text.txt").write_text(text)
            (payload / "number.bin").write_bytes(b"\x01\x02")
            return {"seconds": 1.0}

        return self.store.obtain(recipe("part"), compute, **wishes)


@pytest.fixture
def sites(tmp_path, url) -> tuple[Site, Site]:
    return Site(tmp_path / "here", url), Site(tmp_path / "there", url)


KEY = recipe("part").key


def far(url) -> tuple[fsspec.AbstractFileSystem, str]:
    return fsspec.core.url_to_fs(url)


def only_file(url, name: str) -> str:
    files, base = far(url)
    return next(path for path in files.find(base) if path.endswith(name))


def content(stored) -> dict[str, bytes]:
    folder = stored.folder.parent
    return {p.name: p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def test_what_one_computed_the_other_takes(sites):
    here, there = sites
    first, second = here.get(), there.get()
    assert (here.computed, there.computed) == (1, 0)
    assert second.is_cached and content(first) == content(second)
    assert there.store.check(KEY).state == "ok" and not there.store.work(KEY).exists()
    assert there.get().is_cached and there.said == []


def test_cut_upload_is_not_there_and_is_made_up_for(sites, url, monkeypatch):
    here, there = sites

    def cut(*_, **__):
        raise ConnectionResetError("cut")

    with monkeypatch.context() as patch:
        patch.setattr(here.store._files, "pipe_file", cut)
        with pytest.raises(ConnectionResetError):
            here.get()
    assert there.get("another").is_cached is False  # nothing of the upload is seen
    files, base = far(url)
    files.rm_file(f"{base}/obj/{KEY}.json")
    assert here.get().is_cached and here.computed == 1  # the next try only uploads
    third = Site(here.store.root.parent / "third", url)
    assert third.get().is_cached and third.computed == 0


@pytest.mark.parametrize("harm", ["bit", "gone", "torn", "seal", "escape"])
def test_damage_is_never_taken_and_the_next_upload_mends_it(sites, url, harm, tmp_path):
    here, there = sites
    here.get()
    files, base = far(url)
    pointer = f"{base}/obj/{KEY}.json"
    if harm == "bit":
        files.pipe_file(only_file(url, "number.bin"), b"\x01\x03")
    elif harm == "gone":
        files.rm_file(only_file(url, "number.bin"))
    elif harm == "torn":
        files.pipe_file(pointer, files.cat_file(pointer)[:40])
    else:
        page = json.loads(files.cat_file(pointer))
        old, new = ("1.0", "2.0") if harm == "seal" else ("files/number.bin", "../../number.bin")
        page["manifest"] = page["manifest"].replace(old, new)
        files.pipe_file(pointer, json.dumps(page).encode())
    assert not there.get().is_cached and there.computed == 1
    assert len(there.said) == (0 if harm == "torn" else 1)
    third = Site(tmp_path / "third", url)
    assert third.get().is_cached and third.computed == 0


def test_forced_computation_replaces_what_others_get(sites):
    here, there = sites
    here.get("old")
    here.get("new", force=True)
    assert (there.get().folder / "deep" / "text.txt").read_text() == "new"


def test_damaged_local_artifact_is_fetched_anew(sites):
    here, _ = sites
    stored = here.get()
    (stored.folder / "number.bin").write_bytes(b"")
    assert here.get().is_cached and here.computed == 1
    assert (stored.folder / "number.bin").read_bytes() == b"\x01\x02"


def test_strange_addresses_are_refused_and_none_is_a_local_store(tmp_path):
    with pytest.raises(InputError, match="nonsense://x cannot be reached"):
        open_store(tmp_path, "nonsense://x", say=print)
    assert type(open_store(tmp_path, None, say=print)) is Store
