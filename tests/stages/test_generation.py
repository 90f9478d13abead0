import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from sphere_orbit import RADIUS, sphere_cameras, sphere_images

from stages.artifacts import MaterialViews
from stages.errors import InputError
from stages.generation import run
from stages.settings.generation import GenerationConfig
from svim3d.io.exr import read_exr, write_exr, write_rgb
from svim3d.io.glb import glb_bytes
from svim3d.io.orbit import write_orbit
from svim3d.mesh.lathe import revolve

EXAMPLE = Path(__file__).parents[2] / "configs" / "example.json"
TINY = GenerationConfig(views=4, size=32, supersample=2, environment_size=16)


@pytest.fixture
def ctx(make_context):
    with make_context("generation") as context:
        yield context


def repairs(ctx):
    """Events but for what is found in sound views: these are few."""
    findings = {"few_views", "mirror_like", "grazing_views"}
    return [event for event in ctx.events if event["kind"] not in findings]


@pytest.fixture
def cameras():
    return sphere_cameras()


@pytest.fixture
def images(cameras):
    return sphere_images(cameras)


@pytest.fixture
def folder(tmp_path, cameras, images):
    write_orbit(tmp_path / "orbit", cameras, images, reference=3)
    return tmp_path / "orbit"


def rewrite_index(folder, change):
    index = json.loads((folder / "orbit.json").read_text())
    change(index)
    (folder / "orbit.json").write_text(json.dumps(index))


def rewrite_view(folder, view, change):
    planes = read_exr(folder / f"{view:03d}.exr")
    change(planes)
    # Full precision: half floats would turn infinities into 65504.
    write_exr(folder / f"{view:03d}.exr", planes, half=False)


# --- orbit folders -------------------------------------------------------------------------------


def test_orbit_is_taken_as_it_is(folder, images, cameras, ctx):
    views = run(folder, config=GenerationConfig(), ctx=ctx)
    assert not repairs(ctx)
    assert views.reference == 3
    assert torch.equal(views.cameras.c2w, cameras.c2w)
    for name, image in images.items():
        assert torch.equal(getattr(views, name), image), name


def drop_frames(index):
    index["frames"] = []


def keep_two_frames(index):
    index["frames"], index["reference"] = index["frames"][:2], 1


def keep_one_frame(index):
    index["frames"], index["reference"] = index["frames"][:1], 0


def enter_object(index):
    index["frames"][1]["c2w"][0][3] = index["frames"][1]["c2w"][1][3] = 0.0
    index["frames"][1]["c2w"][2][3] = 0.3


def scale_pose(index):
    index["frames"][0]["c2w"] = (2.0 * np.array(index["frames"][0]["c2w"])).tolist()


def mirror_pose(index):
    for row in index["frames"][0]["c2w"]:
        row[0] = -row[0]


def change_size(index):
    index["camera"]["width"] = 17


def shrink_world(index):
    for frame in index["frames"]:
        for row in frame["c2w"][:3]:
            row[3] *= 4.0


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (drop_frames, "the list 'frames' is empty or missing"),
        (keep_one_frame, "at least 3 views .* got 1 of 1"),
        (keep_two_frames, "at least 3 views .* got 2 of 2"),
        (enter_object, r"views \[1\] stand inside it"),
        (scale_pose, "wanted a rigid 4x4 .* 000.exr"),
        (mirror_pose, "remove scale and mirroring"),
        (change_size, "wanted 17x16 pixels in .*000.exr .* got 16x16"),
        (shrink_world, "covered pixels look past it"),
        (lambda index: index.pop("camera"), "wanted camera"),
        (lambda index: index["frames"][2].pop("c2w"), "a c2w for frame 2"),
        (lambda index: index["camera"].update(cx=3.0), "principal point at the image centre"),
        (lambda index: index.update(reference=9), "wanted a reference below the 4 views, got 9"),
    ],
)
def test_unusable_index_is_refused(folder, ctx, change, said):
    rewrite_index(folder, change)
    with pytest.raises(InputError, match=said):
        run(folder, config=GenerationConfig(), ctx=ctx)


def truncate(file):
    file.write_bytes(file.read_bytes()[:300])


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (Path.unlink, "its file 002.exr does not exist"),
        (truncate, "cannot read .*002.exr as OpenEXR"),
        (lambda file: file.write_bytes(b""), "cannot read .*002.exr as OpenEXR"),
        (lambda file: file.write_text("no picture"), "cannot read .*002.exr as OpenEXR"),
    ],
)
def test_unreadable_view_is_refused_by_name(folder, ctx, damage, said):
    damage(folder / "002.exr")
    with pytest.raises(InputError, match=said):
        run(folder, config=GenerationConfig(), ctx=ctx)


def test_missing_channels_are_named(folder, ctx):
    def drop(planes):
        del planes["metallic.V"], planes["normal.X"]

    rewrite_view(folder, 1, drop)
    with pytest.raises(InputError, match=r"001\.exr, missing metallic\.V, normal\.X"):
        run(folder, config=GenerationConfig(), ctx=ctx)


def test_one_view_of_another_size_is_refused_by_name(folder, ctx):
    def crop(planes):
        for name in planes:
            planes[name] = planes[name][:-2]

    rewrite_view(folder, 1, crop)
    with pytest.raises(InputError, match=r"001\.exr .* got 16x14; all views need one size"):
        run(folder, config=GenerationConfig(), ctx=ctx)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("channel", ["G", "A", "normal.Y"])
def test_few_non_finite_pixels_are_mended_and_told(folder, ctx, images, value, channel):
    def spoil(planes):
        planes[channel][8, 8] = value

    rewrite_view(folder, 2, spoil)
    views = run(folder, config=GenerationConfig(), ctx=ctx)
    assert [event["kind"] for event in repairs(ctx)] == ["non_finite_pixels"]
    assert "002.exr: 1 pixels" in repairs(ctx)[0]["message"]
    for name, image in images.items():
        mended = getattr(views, name)
        assert bool(torch.isfinite(mended).all())
        changed = (mended != image).any(-1).nonzero()
        assert all(pixel == [2, 8, 8] for pixel in changed.tolist())


def test_radiance_at_the_end_of_half_floats_counts_as_infinite(folder, ctx, images):
    def spoil(planes):
        planes["G"][8, 8] = 65504.0

    rewrite_view(folder, 2, spoil)
    views = run(folder, config=GenerationConfig(), ctx=ctx)
    assert [event["kind"] for event in repairs(ctx)] == ["non_finite_pixels"]
    assert float(views.radiance.max()) == float(images["radiance"].max())


def test_many_non_finite_pixels_are_refused(folder, ctx):
    def spoil(planes):
        planes["basecolor.R"][4, :4] = math.nan

    rewrite_view(folder, 2, spoil)
    with pytest.raises(InputError, match=r"002\.exr, got NaN or infinity in 4 of 256"):
        run(folder, config=GenerationConfig(), ctx=ctx)


@pytest.mark.parametrize(("state", "value"), [("empty", 0.0), ("full", 1.0)])
def test_view_without_object_or_background_is_dropped(folder, ctx, state, value):
    def paint(planes):
        planes["A"][:] = value

    rewrite_view(folder, 1, paint)
    views = run(folder, config=GenerationConfig(), ctx=ctx)
    assert repairs(ctx)[-1] == {
        "kind": "view_dropped",
        "message": f"view 1 dropped: its mask is all {state}",
    }
    assert len(views.cameras) == len(views.mask) == 3
    assert views.reference == 2


@pytest.mark.parametrize("value", [0.0, 1.0])
def test_all_masks_empty_or_full_is_refused(folder, ctx, value):
    def paint(planes):
        planes["A"][:] = value

    for view in range(4):
        rewrite_view(folder, view, paint)
    with pytest.raises(InputError, match="got 0 of 4; check the masks"):
        run(folder, config=GenerationConfig(), ctx=ctx)


def test_values_out_of_range_are_clamped_and_told(folder, ctx):
    def spoil(planes):
        planes["R"][8, 8] = -1.0
        planes["roughness.V"][8, 7:9] = 1.5
        planes["basecolor.B"][8, 8] = -0.25

    rewrite_view(folder, 0, spoil)
    views = run(folder, config=GenerationConfig(), ctx=ctx)
    assert {event["message"] for event in repairs(ctx)} == {
        "000.exr: 1 values of radiance out of range",
        "000.exr: 2 values of roughness out of range",
        "000.exr: 1 values of basecolor out of range",
    }
    assert views.radiance[0, 8, 8, 0] == 0.0
    assert views.roughness[0, 8, 8] == 1.0
    assert views.basecolor[0, 8, 8, 2] == 0.0


def test_long_normals_are_rescaled_and_told(folder, ctx, images):
    def stretch(planes):
        for axis in "XYZ":
            planes[f"normal.{axis}"] *= 2.0

    rewrite_view(folder, 3, stretch)
    views = run(folder, config=GenerationConfig(), ctx=ctx)
    assert [event["kind"] for event in repairs(ctx)] == ["normals_rescaled"]
    torch.testing.assert_close(views.normal_world[3], images["normal_world"][3], rtol=0, atol=2e-3)


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("nowhere", None, "does not exist"),
        ("x.txt", b"", "is no mesh that can be read"),
        ("x.json", b"{", "wanted a scene as JSON"),
        ("x.json", b"{}", "'parts'|'materials'"),
        ("x.json", b"[1]", "wanted parts with known materials"),
        ("x.glb", b"glTF", r"x\.glb"),
    ],
)
def test_other_sources_are_refused(tmp_path, ctx, name, content, said):
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=said):
        run(tmp_path / name, config=TINY, ctx=ctx)


def test_folder_without_index_is_refused(tmp_path, ctx):
    with pytest.raises(InputError, match=r"holds no orbit\.json"):
        run(tmp_path, config=TINY, ctx=ctx)


# --- meshes and scenes ---------------------------------------------------------------------------


def sphere_glb(file, *, scale, offset):
    """A sphere of lathe rings, red plastic, anywhere and of any size."""
    angle = torch.linspace(-math.pi / 2, math.pi / 2, 49)
    profile = torch.stack([angle.cos(), angle.sin()], 1)
    profile[[0, -1], 0] = 0.0
    body = revolve(profile, rounds=0, segments=96)
    count = len(body.vertices)
    file.write_bytes(
        glb_bytes(
            vertices=body.vertices * scale + offset,
            faces=body.faces,
            normals=body.normals,
            basecolor=torch.tensor([0.8, 0.1, 0.1]).expand(count, 3),
            orm=torch.tensor([1.0, 0.5, 0.0]).expand(count, 3),
        )
    )
    return file


def test_mesh_of_any_size_and_place_becomes_the_unit_sphere(tmp_path, ctx):
    file = sphere_glb(tmp_path / "x.glb", scale=7.0, offset=torch.tensor([3.0, -2.0, 5.0]))
    config = TINY.model_copy(update={"size": 64})
    views = run(file, config=config, ctx=ctx)
    cameras = sphere_cameras(4, 64)
    radius = RADIUS / math.sin(math.atan(0.85 * math.tan(math.radians(33.8 / 2))))
    scaled = replace(cameras, c2w=cameras.c2w.clone())
    scaled.c2w[:, :3, 3] *= radius / 2.2
    truth = sphere_images(scaled)
    torch.testing.assert_close(views.cameras.c2w, scaled.c2w, rtol=0, atol=2e-3)
    inside = (views.mask == 1.0) & (truth["mask"] == 1.0)
    # Pixels along the rim are covered in part, and only there the two differ.
    assert float((views.mask - truth["mask"]).abs().mean()) < 0.02
    assert float(inside.float().sum() / truth["mask"].sum()) > 0.9
    error = (views.normal_world - truth["normal_world"]).norm(dim=-1, keepdim=True)
    assert float(error[inside].mean()) < 0.02
    basecolor = views.basecolor[inside.expand_as(views.basecolor)].view(-1, 3)
    torch.testing.assert_close(
        basecolor, torch.tensor([0.8, 0.1, 0.1]).expand_as(basecolor), rtol=0, atol=1e-3
    )
    assert views.reference == 3


def test_white_light_on_a_white_rough_sphere_gives_its_albedo(tmp_path, ctx):
    write_rgb(tmp_path / "white.exr", np.full((8, 16, 3), 2.0, np.float32))
    file = sphere_glb(tmp_path / "x.glb", scale=1.0, offset=torch.zeros(3))
    config = GenerationConfig(**TINY.model_dump() | {"environment": tmp_path / "white.exr"})
    views = run(file, config=config, ctx=ctx)
    full = (views.mask == 1.0)[..., 0]
    shown = views.radiance[full]
    # Diffuse 2 * basecolor, less and more of it by the Fresnel reflection at the rim.
    assert float(shown[:, 0].min()) > 2.0 * 0.8 * 0.9
    assert float(shown.max()) < 2.0 * 1.02


def test_another_light_file_makes_other_settings(tmp_path):
    file = tmp_path / "light.exr"
    write_rgb(file, np.full((8, 16, 3), 1.0, np.float32))
    first = GenerationConfig(environment=file)
    write_rgb(file, np.full((8, 16, 3), 2.0, np.float32))
    second = GenerationConfig(environment=file)
    assert first.digests != second.digests
    assert GenerationConfig(**second.model_dump()) == second
    assert not any(name.startswith("environment") for name in GenerationConfig().digests)


def test_light_with_impossible_texels_is_mended_and_told(tmp_path, ctx):
    light = np.full((8, 16, 3), 1.0, np.float32)
    light[2, 3] = -5.0
    write_rgb(tmp_path / "light.exr", light)
    file = sphere_glb(tmp_path / "x.glb", scale=1.0, offset=torch.zeros(3))
    config = GenerationConfig(**TINY.model_dump() | {"environment": tmp_path / "light.exr"})
    run(file, config=config, ctx=ctx)
    assert [event["kind"] for event in repairs(ctx)] == ["light_mended"]


def test_missing_light_is_refused(tmp_path, ctx):
    config = GenerationConfig(environment=tmp_path / "none.exr")
    with pytest.raises(InputError, match=r"none\.exr"):
        run(EXAMPLE, config=config, ctx=ctx)


def test_example_has_varied_materials_and_reloads_to_the_same_bits(tmp_path, ctx):
    views = run(EXAMPLE, config=TINY, ctx=ctx)
    covered = (views.mask == 1.0)[..., 0]
    assert float(views.metallic[covered].min()) == 0.0
    assert float(views.metallic[covered].max()) == 1.0
    assert float(views.roughness[covered].std()) > 0.1
    # The bounding sphere takes 85 % of the height: nothing touches the border.
    border = torch.ones(32, 32, dtype=torch.bool)
    border[1:-1, 1:-1] = False
    assert not bool(views.mask[:, border].any())
    views.save(tmp_path / "saved")
    again = MaterialViews.load(tmp_path / "saved")
    for name in ("radiance", "mask", "basecolor", "roughness", "metallic", "normal_world"):
        assert torch.equal(getattr(again, name), getattr(views, name)), name


def test_same_scene_gives_the_same_bits(tmp_path, ctx):
    first, second = (run(EXAMPLE, config=TINY, ctx=ctx) for _ in range(2))
    assert torch.equal(first.radiance, second.radiance)
    assert torch.equal(first.normal_world, second.normal_world)
