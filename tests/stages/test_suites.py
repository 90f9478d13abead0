import math
import shutil

import numpy as np
import pytest
import torch
from scored_sphere import write_truth
from sphere_orbit import sphere_images
from suite_folders import (
    AZIMUTHS_DEG,
    CENTRE,
    PHOTO_AZIMUTH_DEG,
    sphere_depth,
    write_orb,
    write_renders,
)
from suite_folders import SIZE as SIZE_THERE

from stages.errors import InputError
from stages.suites import list_objects, truth_folder
from stages.truth import read_truth
from svim3d.io.image import read_png
from svim3d.shading.environment import direction_from_latlong

SIZE = 256  # larger than the pictures: they stay as they are


def brightest(light):
    """Direction of a map's brightest texel, in our world."""
    height, width, _ = light.shape
    place = int(light.sum(-1).argmax())
    row, column = divmod(place, width)
    return direction_from_latlong(torch.tensor([(column + 0.5) / width, (row + 0.5) / height]))


def converted(suite, folder, name, parent):
    made = truth_folder(suite, folder, name, parent, SIZE)
    return made, read_truth(made)


def check_frame(truth):
    """The object is our sphere again, the photo's camera last and at azimuth 0."""
    cameras, images, reference = truth.given
    assert reference == 3
    x, y, z = cameras.positions[3].tolist()
    assert math.degrees(math.atan2(x, z)) == pytest.approx(0.0, abs=1e-3)
    assert math.degrees(math.asin(y / 2.2)) == pytest.approx(10.0, abs=0.05)
    assert float(cameras.positions[3].norm()) == pytest.approx(2.2, rel=2e-3)
    # The other training views follow in their order, as far around as they stood.
    for view, azimuth in enumerate(AZIMUTHS_DEG["train"][1:]):
        x, _, z = cameras.positions[view].tolist()
        around = math.degrees(math.atan2(x, z)) % 360.0
        assert around == pytest.approx((azimuth - PHOTO_AZIMUTH_DEG) % 360.0, abs=1e-2)
    true = sphere_images(cameras)
    apart = (images["mask"] - true["mask"]).abs().mean()
    assert float(apart) < 0.02  # pixels of the rim
    return cameras, images, true


def test_renders_are_brought_into_our_frame(tmp_path):
    write_renders(tmp_path / "in" / "ball")
    folder, truth = converted("poly-haven", tmp_path / "in", "ball", tmp_path / "out")
    _, images, true = check_frame(truth)
    inside = (images["mask"] > 0.5) & (true["mask"] > 0.5)
    for name, tolerance in (("roughness", 1 / 255), ("normal_world", 0.02)):
        there = inside.expand_as(images[name])
        assert torch.allclose(images[name][there], true[name][there], atol=tolerance)
    # Basecolor and metallic differ by the side of a sphere that turned with its photo's camera.
    assert float(images["basecolor"].max()) == pytest.approx(0.75, abs=0.01)
    vertices, _ = truth.surface
    assert float(vertices.norm(dim=1).max()) == pytest.approx(0.5, abs=1e-4)
    assert truth.novel is not None and len(truth.novel[0]) == 2
    (lit,) = truth.relit["sun"]
    assert len(lit.cameras) == 2
    ratio = lit.images["radiance"].sum() / truth.novel[1]["radiance"].sum()
    assert float(ratio) == pytest.approx(2.0, rel=0.02)
    photo = read_png(folder / "reference.png")
    assert photo.shape == (24, 24, 4)


def test_a_light_of_blender_shines_from_where_it_stood(tmp_path):
    write_renders(tmp_path / "in" / "ball")
    _, truth = converted("blender-vault", tmp_path / "in", "ball", tmp_path / "out")
    # Blender's middle is its +x, which is our +x; then all turns with the photo's camera.
    turn = math.radians(90.0 - PHOTO_AZIMUTH_DEG)
    wanted = torch.tensor([math.sin(turn), 0.0, math.cos(turn)])
    (lit,) = truth.relit["sun"]
    assert float(brightest(lit.light) @ wanted) > math.cos(math.radians(12.0))  # a texel


def test_without_a_mesh_silhouettes_tell_the_size(tmp_path):
    write_renders(tmp_path / "in" / "ball", mesh=None)
    _, truth = converted("poly-haven", tmp_path / "in", "ball", tmp_path / "out")
    assert truth.surface is None
    cameras, _, _ = truth.given
    # A silhouette shows a ball as large as a disc nearer by: d tan(asin(r / d)) instead of r.
    larger = 2.2 * math.tan(math.asin(0.5 / 2.2)) / 0.5
    assert float(cameras.positions[3].norm()) == pytest.approx(2.2 / larger, rel=0.08)


def test_scans_have_geometry_and_pictures(tmp_path):
    write_renders(tmp_path / "in" / "ball", maps=False, mesh="meshes/model.obj")
    _, truth = converted("gso", tmp_path / "in", "ball", tmp_path / "out")
    _, images, _ = check_frame(truth)
    assert images.keys() == {"radiance", "mask"}
    assert truth.surface is not None
    assert truth.relit == {}


def test_a_capture_of_stanford_orb(tmp_path):
    write_orb(tmp_path / "in")
    folder, truth = converted("stanford-orb", tmp_path / "in", "ball_scene001", tmp_path / "out")
    _, images, _ = check_frame(truth)
    assert images.keys() == {"radiance", "mask"}
    # The background went with the mask.
    assert float((images["radiance"] * (images["mask"] == 0)).abs().max()) == 0.0
    groups = truth.relit["novel"]
    assert len(groups) == 2  # each view has its own light
    seen = torch.cat([group.images["radiance"] for group in groups])
    ratio = seen.sum() / truth.novel[1]["radiance"].sum()
    assert float(ratio) == pytest.approx(2.0, rel=0.02)
    for group in groups:
        forward = -group.cameras.c2w[0, :3, 2]
        assert float(brightest(group.light) @ forward) > math.cos(math.radians(12.0))
    # What was brightest in the photo's view is nearly white on the photo.
    photo = read_png(folder / "reference.png")
    assert 0.85 < float(photo[..., :3].max()) <= 1.0


def test_maps_of_a_capture_s_test_views_are_read(tmp_path):
    write_orb(tmp_path / "in")
    _, truth = converted("stanford-orb", tmp_path / "in", "ball_scene001", tmp_path / "out")
    cameras, images = truth.novel
    assert images.keys() == {"radiance", "mask", "basecolor", "normal_world", "depth"}
    true = sphere_images(cameras)
    inside = (images["mask"] > 0.5) & (true["mask"] > 0.5)
    # The normals' world turned with the photo's camera, which the sphere's own normals show.
    there = inside.expand_as(true["normal_world"])
    assert torch.allclose(images["normal_world"][there], true["normal_world"][there], atol=0.02)
    # Depth is along the view, in the capture's units before.
    wanted = torch.stack([sphere_depth(cameras, view) for view in range(2)])
    steep = true["normal_world"] @ cameras.c2w[0, :3, 2] < 0.3  # of a rim a pixel spans much
    chosen = (inside[:1] & ~steep[:1, ..., None])[0]
    assert torch.allclose(images["depth"][0][chosen], wanted[0][chosen], atol=0.01)
    assert float(images["basecolor"].max()) == pytest.approx(0.75, abs=0.01)
    assert truth.unit == pytest.approx(SIZE_THERE, rel=1e-3)
    # The capture's origin, in our world: as far from the object's centre as it was there.
    far = torch.tensor(truth.origin).norm()
    assert float(far) == pytest.approx(float(CENTRE.norm()) / SIZE_THERE, rel=1e-3)
    _, others, _ = truth.given
    assert others.keys() == {"radiance", "mask"}


def test_maps_may_be_missing(tmp_path):
    write_orb(tmp_path / "in")
    (tmp_path / "in/ground_truth/ball_scene001/z_depth/0001.npy").unlink()
    shutil.rmtree(tmp_path / "in/ground_truth/ball_scene001/pseudo_gt_albedo")
    _, truth = converted("stanford-orb", tmp_path / "in", "ball_scene001", tmp_path / "out")
    assert truth.novel[1].keys() == {"radiance", "mask", "normal_world"}


def test_normals_of_other_axes_are_refused(tmp_path):
    write_orb(tmp_path / "in")
    file = tmp_path / "in/ground_truth/ball_scene001/surface_normal/0000.npy"
    np.save(file, np.load(file) * np.array([1.0, -1.0, -1.0], np.float32))
    with pytest.raises(InputError, match=r"0000\.npy, but most of them look away"):
        converted("stanford-orb", tmp_path / "in", "ball_scene001", tmp_path / "out")
    file.write_bytes(b"no array")
    with pytest.raises(InputError, match="cannot be read as an array"):
        converted("stanford-orb", tmp_path / "in", "ball_scene001", tmp_path / "out")


def test_what_was_converted_is_found_again(tmp_path):
    write_renders(tmp_path / "in" / "ball")
    arguments = "poly-haven", tmp_path / "in", "ball", tmp_path / "out", SIZE
    first = truth_folder(*arguments)
    changed = (first / "orbit.json").stat().st_mtime_ns
    assert truth_folder(*arguments) == first
    assert (first / "orbit.json").stat().st_mtime_ns == changed
    assert truth_folder(*arguments[:-1], 12) != first
    assert not list((tmp_path / "out").glob(".tmp-*"))


def test_larger_pictures_are_averaged_down(tmp_path):
    write_renders(tmp_path / "in" / "ball")
    truth = read_truth(truth_folder("poly-haven", tmp_path / "in", "ball", tmp_path / "out", 12))
    cameras, images, _ = truth.given
    assert images["mask"].shape == (4, 12, 12, 1)
    # Nothing of the background gets into maps, and normals stay unit.
    seen = images["mask"][..., 0] > 0.1
    assert torch.allclose(images["roughness"][seen], torch.tensor(0.5), atol=0.01)
    length = images["normal_world"][seen].norm(dim=-1)
    assert torch.allclose(length, torch.ones_like(length), atol=2e-3)
    assert cameras.fov_y_deg == pytest.approx(33.8, abs=1e-4)


def test_our_own_orbits_are_taken_as_they_are(tmp_path):
    write_truth(tmp_path / "ball", size=16)
    assert list_objects("orbits", tmp_path) == ["ball"]
    assert truth_folder("orbits", tmp_path, "ball", tmp_path / "out", SIZE) == tmp_path / "ball"


@pytest.mark.parametrize(
    ("suite", "looked_for"),
    [
        ("orbits", "orbit.json"),
        ("poly-haven", "transforms_train.json"),
        ("gso", "meshes/model.obj"),
        ("stanford-orb", "blender_HDR"),
    ],
)
def test_an_empty_folder_is_told_what_was_looked_for(suite, looked_for, tmp_path):
    with pytest.raises(InputError, match=looked_for):
        list_objects(suite, tmp_path)


@pytest.mark.parametrize(
    ("missing", "told"),
    [
        ("ground_truth/ball_scene002/env_map/0001.exr", "env_map/0001"),
        ("blender_HDR/ball_scene001/train_mask/0002.png", "train_mask/0002"),
        ("blender_HDR/ball_scene001/transforms_test.json", "transforms_test.json"),
    ],
)
def test_what_a_capture_lacks_is_named(missing, told, tmp_path):
    write_orb(tmp_path / "in")
    (tmp_path / "in" / missing).unlink()
    with pytest.raises(InputError, match=told):
        truth_folder("stanford-orb", tmp_path / "in", "ball_scene001", tmp_path / "out", SIZE)
    assert not list((tmp_path / "out").glob("*"))
