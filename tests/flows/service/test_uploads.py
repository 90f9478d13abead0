"""What is sent: sizes counted on arrival, bombs, archives that lie, names that lead elsewhere."""

import io
import json
import stat
import struct
import tracemalloc
import zipfile
import zlib
from pathlib import Path

import numpy as np
import pytest
from fake_service import png, send
from fake_views import POSE, SIZE, exr, index, packed
from PIL import Image

from flows.service import api
from flows.service.limits import ArchiveLimits
from flows.service.problems import Refusal
from flows.service.uploads import keep_views
from svim3d.io.orbit import read_orbit


def picture_claiming(width: int, height: int) -> bytes:
    """A PNG of a few bytes whose head claims any size."""
    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    chunks = ((b"IHDR", head), (b"IDAT", zlib.compress(b"")), (b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
        for kind, body in chunks
    )


@pytest.mark.parametrize(
    ("width", "height"), [(2**16, 2**16), (2**31 - 1, 2**31 - 1), (8193, 8192)]
)
def test_pixel_bombs_are_refused_by_their_head(client, width, height):
    sent = client.post("/jobs", files={"picture": ("x.png", picture_claiming(width, height))})
    assert sent.status_code in (413, 415), sent.text
    assert sent.json()["code"] in ("too_many_pixels", "no_picture")


def test_a_picture_of_nothing_is_refused(client):
    for content in (
        b"",
        b"GIF89a",
        b"\x89PNG\r\n\x1a\n",
        b"<svg/>",
        b"%!PS",
        picture_claiming(0, 5),
    ):
        sent = client.post("/jobs", files={"picture": ("x.png", content)})
        assert sent.status_code in (413, 415, 422), content


def test_the_ending_follows_the_content_not_the_name(client, home):
    buffer = io.BytesIO()
    Image.new("RGB", (4, 4)).save(buffer, "JPEG")
    sent = client.post("/jobs", files={"picture": ("/etc/cron.d/x.png", buffer.getvalue())})
    folder = home / "jobs" / sent.json()["id"]
    assert (folder / "photo.jpg").read_bytes() == buffer.getvalue()


def test_a_long_request_is_refused_before_it_is_read(serving):
    with serving(upload_bytes=5000) as client:
        sent = client.post("/jobs", files={"picture": ("x", b"x" * 6000)})
        assert sent.status_code == 413 and sent.json()["code"] == "upload_too_large"
        send(client)


def test_a_request_that_hides_its_length_is_counted(serving):
    read = []

    def body():
        yield b'--x\r\nContent-Disposition: form-data; name="picture"; filename="a"\r\n\r\n'
        for _ in range(1000):
            read.append(1)
            yield b"x" * 1000

    with serving(upload_bytes=5000) as client:
        sent = client.post(
            "/jobs", content=body(), headers={"Content-Type": "multipart/form-data; boundary=x"}
        )
        assert sent.status_code == 413 and sent.json()["code"] == "upload_too_large"
        send(client)


def keep(buffer: io.BytesIO, folder: Path, **limits) -> Path:
    return folder / keep_views(buffer, folder, ArchiveLimits(**limits))


def refusal(buffer: io.BytesIO, folder: Path, **limits) -> str:
    with pytest.raises(Refusal) as refused:
        keep(buffer, folder, **limits)
    assert refused.value.status_code in (413, 415)
    assert str(folder) not in str(refused.value.problem)
    return refused.value.problem.came


@pytest.mark.parametrize("base", ["", "shoe/"])
def test_views_are_kept_under_names_of_ours(tmp_path, base):
    view = exr(tmp_path)
    names = ["a/b.exr", "c d.exr", "c d.exr"]
    stray = {f"{base}notes.txt": b"x", "__MACOSX/._orbit": b"x", f"{base}a/": b""}
    entries = {f"{base}orbit.json": index(names, reference=1, secret="x")} | stray
    buffer = packed(entries | {f"{base}{name}": view for name in names})
    kept = keep(buffer, tmp_path)
    assert sorted(p.name for p in kept.rglob("*")) == [
        "000.exr",
        "001.exr",
        "002.exr",
        "orbit.json",
    ]
    assert "secret" not in (kept / "orbit.json").read_text()
    cameras, images, reference = read_orbit(kept)
    assert len(cameras) == 3 and reference == 1 and images["mask"].shape == (3, SIZE, SIZE, 1)


def test_the_layout_of_benchmark_sets_is_taken(tmp_path):
    listed = json.loads(index(["train/x.exr"]))
    page = {"camera": listed["camera"], "train": listed["frames"], "reference": {"train_index": 0}}
    page["test"] = [{"files": {"A": "/etc/passwd"}, "c2w": POSE}]
    kept = keep(
        packed({"orbit.json": json.dumps(page).encode(), "train/x.exr": exr(tmp_path)}), tmp_path
    )
    assert read_orbit(kept)[2] == 0
    assert "passwd" not in (kept / "orbit.json").read_text()


@pytest.mark.parametrize(
    "name",
    ["../x.exr", "/x.exr", "a/../../x.exr", "a\\x.exr", "C:x.exr", "a\nb.exr", "..", "x\x7f"],
)
def test_names_that_lead_elsewhere_are_refused(tmp_path, name):
    came = refusal(packed({name: b"x", "orbit.json": index(["x.exr"])}), tmp_path)
    assert "name" in came or "damaged" in came
    assert not [p for p in tmp_path.parent.iterdir() if p.name == "x.exr"]


@pytest.mark.parametrize("file", ["/etc/passwd", "../../job.json", "missing.exr", "", "."])
def test_an_index_reads_no_file_but_those_that_came(tmp_path, file):
    assert "lacks the file" in refusal(packed({"orbit.json": index([file])}), tmp_path)


def test_links_are_refused(tmp_path):
    link = zipfile.ZipInfo("x.exr")
    link.create_system = 3
    link.external_attr = (stat.S_IFLNK | 0o777) << 16
    came = refusal(packed({link: b"/etc/passwd", "orbit.json": index(["x.exr"])}), tmp_path)
    assert "link" in came


def test_bombs_are_refused_before_they_are_unpacked(tmp_path):
    view, page = exr(tmp_path), index(["x.exr"])
    zeros = packed({"orbit.json": page, "x.exr": b"\0" * 20_000_000})
    assert "packed" in refusal(zeros, tmp_path)
    honest = packed({"orbit.json": page, "x.exr": view})
    assert "more" in refusal(honest, tmp_path, unpacked_bytes=len(view))
    many = packed({f"{i}": b"" for i in range(30)} | {"orbit.json": page})
    assert "31 entries" in refusal(many, tmp_path, entries=30)
    wide = packed({"orbit.json": page, "x.exr": exr(tmp_path, 4, 4000)})
    assert "4000 x 4" in refusal(wide, tmp_path)
    assert not list(tmp_path.glob("views/orbit.json"))


def test_views_count_by_what_they_decode_to(tmp_path):
    buffer = packed({"orbit.json": index(["x.exr"] * 3), "x.exr": exr(tmp_path)})
    assert "more" in refusal(buffer, tmp_path, values=3 * SIZE * SIZE * 12 - 1)


def test_entries_that_share_their_bytes_are_refused(tmp_path):
    """Overlapping files: each has an honest ratio, together they unpack to far more than came."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        noise = np.random.default_rng(0).bytes(5000)
        archive.writestr("x.exr", noise)
        archive.writestr("orbit.json", index(["x.exr"]))
        first = archive.getinfo("x.exr")
        for i in range(20):
            twin = zipfile.ZipInfo(f"{i}.exr")
            for name in ("header_offset", "compress_size", "file_size", "CRC", "compress_type"):
                setattr(twin, name, getattr(first, name))
            archive.filelist.append(twin)
            archive.NameToInfo[twin.filename] = twin
        archive._didModify = True
    assert "overlap" in refusal(buffer, tmp_path)


def with_told_size(buffer: io.BytesIO, size: int) -> io.BytesIO:
    """The archive with another size told for its first entry, in the directory and before it."""
    content = bytearray(buffer.getvalue())
    entry = content.index(b"PK\x01\x02")
    content[entry + 24 : entry + 28] = content[22:26] = struct.pack("<L", size)
    return io.BytesIO(bytes(content))


def test_an_entry_that_lies_about_its_size_is_cut(tmp_path):
    """The size that a directory tells is all that is ever unpacked."""
    buffer = packed({"x.exr": b"\0" * 20_000_000, "orbit.json": index(["x.exr"])})
    assert "damaged" in refusal(with_told_size(buffer, 100), tmp_path)
    assert (tmp_path / "views" / "000.exr").stat().st_size <= 100


def test_an_index_that_lies_about_its_size_takes_no_memory(tmp_path):
    buffer = with_told_size(packed({"orbit.json": b" " * 20_000_000}), 100)
    tracemalloc.start()
    assert "damaged" in refusal(buffer, tmp_path)
    _, peak_bytes = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak_bytes < 2 * ArchiveLimits().index_bytes + 1_000_000


@pytest.mark.parametrize("how", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_other_ways_of_packing_are_refused(tmp_path, how):
    assert "deflate" in refusal(packed({"orbit.json": index(["x"])}, how), tmp_path)


@pytest.mark.parametrize(
    ("content", "came"),
    [
        (b"[]", "no object"),
        (b"{", "no JSON"),
        (b"\xff", "no JSON"),
        (b"[" * 100_000, "no JSON"),
        (b"{}", "does not list"),
        (b'{"frames": {}}', "does not list"),
        (b'{"frames": [3]}', "frame 0"),
        (b'{"frames": [{"file": "x.exr"}]}', "frame 0"),
        (b'{"frames": [{"file": 3, "c2w": []}]}', "frame 0"),
        (b'{"frames": [{"file": "x.exr", "c2w": [[1]]}]}', "frame 0"),
        (index(["x.exr"] * 201), "does not list"),
        (index(["y.exr"]), "no OpenEXR"),
    ],
)
def test_an_index_is_judged(tmp_path, content, came):
    entries = {"orbit.json": content, "x.exr": exr(tmp_path), "y.exr": b"\x76\x2f\x31\x01"}
    assert came in refusal(packed(entries), tmp_path)


def test_damage_anywhere_is_refused_in_words(tmp_path):
    """Every cut and many flipped bytes: kept whole, or refused; never another error."""
    whole = packed({"orbit.json": index(["x.exr"]), "x.exr": exr(tmp_path)}).getvalue()
    rng = np.random.default_rng(0)
    for number in range(300):
        content = bytearray(whole)
        if number % 3 == 0:
            content = content[: rng.integers(len(content))]
        else:
            content[rng.integers(len(content))] ^= 1 << rng.integers(8)
        folder = tmp_path / str(number)
        folder.mkdir()
        try:
            keep(io.BytesIO(bytes(content)), folder)
        except Refusal as refused:
            assert refused.status_code in (413, 415)


def test_zips_with_comments_or_of_another_kind_are_refused(tmp_path):
    assert "something else" in refusal(io.BytesIO(b"x" * 50), tmp_path)
    assert "something else" in refusal(io.BytesIO(b""), tmp_path)
    buffer = packed({"orbit.json": b"{}"})
    assert "comment" in refusal(io.BytesIO(buffer.getvalue() + b"junk"), tmp_path)
    two = packed({"a/orbit.json": b"{}", "b/orbit.json": b"{}"})
    assert "2 files" in refusal(two, tmp_path)


def test_views_are_sent_like_pictures(client, home, tmp_path):
    buffer = packed({"orbit.json": index(["x.exr"]), "x.exr": exr(tmp_path)})
    sent = client.post("/jobs", files={"views": ("../../v.zip", buffer.getvalue())})
    assert sent.status_code == 202 and sent.json()["input"] == "views"
    assert (home / "jobs" / sent.json()["id"] / "views" / "000.exr").is_file()
    refused = client.post("/jobs", files={"views": ("x", png())})
    assert refused.status_code == 415 and refused.json()["code"] == "no_orbit"
    assert "ArchiveLimits" in vars(api)
