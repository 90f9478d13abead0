import json

import pytest
import torch
from sphere_orbit import sphere_cameras, sphere_images

from svim3d.io.exr import read_exr, write_exr
from svim3d.io.orbit import CHANNELS, read_frame, read_orbit, write_orbit
from svim3d.io.orbit_repair import admit_views, repair_images


@pytest.fixture
def cameras():
    return sphere_cameras()


@pytest.fixture
def images(cameras):
    return sphere_images(cameras)


def test_round_trip_is_bit_exact(tmp_path, cameras, images):
    write_orbit(tmp_path, cameras, images, reference=2)
    read_cameras, read_images, reference = read_orbit(tmp_path)
    assert reference == 2
    assert torch.equal(read_cameras.c2w, cameras.c2w)
    assert read_cameras.fov_y_deg == cameras.fov_y_deg
    for name in CHANNELS:
        assert torch.equal(read_images[name], images[name]), name


def test_confidence_and_depth_are_there_where_all_views_have_them(tmp_path, cameras, images):
    images["confidence"] = torch.linspace(0, 1, 4).half().float()[:, None, None, None] * torch.ones(
        4, 16, 16, 1
    )
    images["depth"] = images["mask"] * 2.2
    write_orbit(tmp_path, cameras, images, reference=2)
    _, read, _ = read_orbit(tmp_path)
    assert torch.equal(read["confidence"], images["confidence"].half().float())
    assert torch.equal(read["depth"], images["depth"])
    planes = read_exr(tmp_path / "001.exr")
    assert "confidence.V" in planes
    del planes["confidence.V"]
    write_exr(tmp_path / "001.exr", planes)
    assert {"depth"} == set(read_orbit(tmp_path)[1]) - set(CHANNELS)


def test_doubtful_confidence_is_mended(images):
    told = []
    images["confidence"] = torch.full((4, 16, 16, 1), 0.5)
    images["confidence"][2, 3, 3] = -0.5
    images["confidence"][1, 3, 3] = 16.0
    mended = repair_images(images, list("abcd"), lambda *event: told.append(event))
    assert told == [("clamped", "c: 1 values of confidence out of range")]
    assert float(mended["confidence"].min()) == 0.0
    assert float(mended["confidence"].max()) == 16.0


def test_files_are_the_same_bytes_each_time(tmp_path, cameras, images):
    for name in ("a", "b"):
        write_orbit(tmp_path / name, cameras, images, reference=3)
    for file in (tmp_path / "a").iterdir():
        assert file.read_bytes() == (tmp_path / "b" / file.name).read_bytes()


def test_benchmark_layout_is_read_with_its_test_splits(tmp_path, cameras, images):
    write_orbit(tmp_path, cameras, images, reference=3)
    index = json.loads((tmp_path / "orbit.json").read_text())
    frames = index.pop("frames")
    index |= {
        "train": frames[:3],
        "test": [{"files": {"A": frames[3]["file"]}, "c2w": frames[3]["c2w"]}],
        "reference": {"file": "reference.png", "train_index": 1},
    }
    (tmp_path / "orbit.json").write_text(json.dumps(index))
    assert read_orbit(tmp_path)[2] == 1
    test_cameras, test_images, reference = read_orbit(tmp_path, "test_A")
    assert reference == 0
    assert torch.equal(test_cameras.c2w, cameras.c2w[3:])
    assert torch.equal(test_images["mask"], images["mask"][3:])
    with pytest.raises(ValueError, match="wanted a file and a c2w for frame 0 of 'test_B'"):
        read_orbit(tmp_path, "test_B")


def test_valid_images_pass_through_untouched(images):
    told = []
    mended = repair_images(images, list("abcd"), lambda *event: told.append(event))
    assert not told
    assert all(mended[name] is images[name] for name in ("radiance", "mask", "metallic"))


def test_non_finite_pixel_takes_its_nearest_neighbour(images):
    told = []
    images["roughness"][1, 8, 8] = float("nan")
    images["radiance"][1, 8, 8, 0] = float("inf")
    clean = images["basecolor"].clone()
    mended = repair_images(images, list("abcd"), lambda *event: told.append(event))
    assert told == [("non_finite_pixels", "b: 1 pixels filled from their nearest neighbour")]
    assert mended["roughness"][1, 8, 8] == 0.5
    neighbours = [clean[1, 8 + i, 8 + j] for i, j in ((0, 1), (1, 0), (0, -1), (-1, 0))]
    assert any(torch.equal(mended["basecolor"][1, 8, 8], other) for other in neighbours)


def test_a_dropped_reference_is_replaced_by_its_likest_view(cameras, images):
    images["mask"][3] = 0.0
    kept, admitted, reference = admit_views(cameras, images, 3, lambda *_: None)
    assert len(kept) == 3 and len(admitted["mask"]) == 3
    likeness = cameras.c2w[:3, :3, 2] @ cameras.c2w[3, :3, 2]
    assert reference == int(likeness.argmax())


@pytest.mark.parametrize("split", ["train", "test_A", "test_B"])
def test_path_traced_orbit_needs_no_repair(data, split):
    told = []
    folder = data / "orbits" / "barrel"
    cameras, images, reference = read_orbit(folder, split, notify=lambda *e: told.append(e))
    assert not told
    if split == "train":
        assert len(admit_views(cameras, images, reference, lambda *e: told.append(e))[0]) == 21
        assert not told


def benchmark(folder, **more):
    """Three views; only the last two are lit by B, and seen with another lens."""
    cameras = sphere_cameras(3, 12)
    write_orbit(folder, cameras, sphere_images(cameras), reference=2)
    index = json.loads((folder / "orbit.json").read_text())
    frames = index.pop("frames")
    for number, frame in enumerate(frames):
        file = frame.pop("file")
        frame["files"] = {"A": file} | ({"B": file} if number else {})
    camera = index["camera"] | {"fov_deg": 20.0}
    page = index | {"test": frames, "cameras": {"test_B": camera}} | more
    (folder / "orbit.json").write_text(json.dumps(page))
    return cameras


def test_test_views_may_be_lit_otherwise_and_seen_with_another_lens(tmp_path):
    cameras = benchmark(tmp_path)
    all_views, images, _ = read_orbit(tmp_path, "test_A")
    assert len(all_views) == 3 and all_views.fov_y_deg == 33.8
    some, lit, _ = read_orbit(tmp_path, "test_B")
    assert some.fov_y_deg == 20.0
    assert torch.equal(some.c2w, cameras.c2w[1:])
    assert torch.equal(lit["radiance"], images["radiance"][1:])
    with pytest.raises(ValueError, match="wanted a file"):
        read_orbit(tmp_path, "test_C")


def test_a_frame_by_itself_has_the_lens_of_its_split(tmp_path):
    benchmark(tmp_path)
    assumed = sphere_cameras(1, 12)
    lenses = [read_frame(tmp_path / f"{n:03d}.exr", assumed, wanted=["mask"])[0] for n in (0, 2)]
    # The last view is listed for A first.
    assert [camera.fov_y_deg for camera in lenses] == [33.8, 33.8]
    index = json.loads((tmp_path / "orbit.json").read_text())
    del index["test"][2]["files"]["A"]
    (tmp_path / "orbit.json").write_text(json.dumps(index))
    camera, _ = read_frame(tmp_path / "002.exr", assumed, wanted=["mask"])
    assert camera.fov_y_deg == 20.0
