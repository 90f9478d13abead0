"""The relight stage through `run`: what comes out, what turns, what is edited, what is refused."""

import io
import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from sphere_orbit import sphere_cameras, sphere_images

from stages.edit import edit_asset
from stages.errors import InputError
from stages.relight import run
from stages.settings.relight import RelightConfig
from svim3d.io.exr import read_exr, write_exr, write_rgb
from svim3d.io.glb import glb_bytes, read_mesh
from svim3d.io.hdr import write_hdr
from svim3d.io.image import write_png
from svim3d.io.orbit import write_orbit
from svim3d.shading.environment import direction_from_latlong
from svim3d.shading.tonemap import agx

EXAMPLE = Path(__file__).parents[2] / "configs" / "example.json"
STILL = RelightConfig(turntable="none")


@pytest.fixture
def ctx(make_context):
    with make_context("relight") as context:
        yield context


@pytest.fixture
def orbit(tmp_path):
    cameras = sphere_cameras()
    write_orbit(tmp_path / "orbit", cameras, sphere_images(cameras), reference=3)
    return tmp_path / "orbit"


def lamp(tmp_path: Path, axis: tuple[float, float, float], height: int = 32) -> Path:
    """A light whose one broad lamp shines from `axis`."""
    v, u = torch.meshgrid(
        (torch.arange(height) + 0.5) / height,
        (torch.arange(2 * height) + 0.5) / (2 * height),
        indexing="ij",
    )
    cosine = direction_from_latlong(torch.stack([u, v], -1)) @ torch.tensor(axis)
    file = tmp_path / f"lamp{axis}.exr"
    write_rgb(file, (5.0 * (8.0 * (cosine - 1.0)).exp())[..., None].expand(-1, -1, 3).numpy())
    return file


def layers(files: dict[str, bytes], name: str, tmp_path: Path) -> dict[str, np.ndarray]:
    (tmp_path / "read.exr").write_bytes(files[name])
    return read_exr(tmp_path / "read.exr")


def side(picture: torch.Tensor) -> float:
    """Centre of brightness from left (-1) to right (1)."""
    columns = torch.linspace(-1.0, 1.0, picture.shape[1])
    weight = picture[..., :3].sum((0, 2))
    return float((weight * columns).sum() / weight.sum())


def decoded(content: bytes) -> torch.Tensor:
    return torch.from_numpy(np.asarray(Image.open(io.BytesIO(content)), np.float32) / 255.0)


def test_every_view_comes_as_layers_and_as_a_picture(orbit, ctx, tmp_path):
    relit = run(orbit, config=STILL, ctx=ctx)
    assert {f"views/{i:03d}.{kind}" for i in range(4) for kind in ("exr", "png")} < set(relit.files)
    planes = layers(relit.files, "views/002.exr", tmp_path)
    assert {*"RGBA", *(f"{lobe}.{c}" for lobe in ("diffuse", "specular") for c in "RGB")} == set(
        planes
    )
    total = planes["diffuse.R"] + planes["specular.R"]
    np.testing.assert_allclose(planes["R"], total, atol=2e-3 * float(total.max()))
    picture = decoded(relit.files["views/002.png"])
    beauty = torch.from_numpy(np.stack([planes[c] for c in "RGB"], -1))
    solid = torch.from_numpy(planes["A"]) > 0.99
    torch.testing.assert_close(picture[solid][:, :3], agx(beauty)[solid], rtol=0, atol=0.01)
    assert float(picture[..., 3][~solid & (torch.from_numpy(planes["A"]) == 0)].max()) == 0.0


def test_exposure_changes_pictures_and_no_layers(orbit, ctx, tmp_path):
    normal = run(orbit, config=STILL, ctx=ctx)
    brighter = run(orbit, config=STILL.model_copy(update={"exposure": 1.0}), ctx=ctx)
    assert normal.files["views/000.exr"] == brighter.files["views/000.exr"]
    one, other = (decoded(f.files["views/000.png"])[..., :3] for f in (normal, brighter))
    assert float(other.mean()) > float(one.mean())


def test_a_lamp_on_plus_x_lights_the_right_and_turns_counter_clockwise(orbit, ctx, tmp_path):
    config = RelightConfig(
        environment=lamp(tmp_path, (1.0, 0.0, 0.0)),
        azimuths_deg=(0.0, 90.0, 180.0),
        views="reference",
        turntable="png",
        occlusion=False,
    )
    # The sphere's reference camera stands on +z: +x is on its right, and behind it lies -z.
    cameras = sphere_cameras()
    backward = cameras.c2w[3, :3, 2]
    right = cameras.c2w[3, :3, 0]
    assert float(backward[2]) > 0.8 and float(right[0]) > 0.8
    relit = run(orbit, config=config, ctx=ctx)
    frames = [decoded(relit.files[f"turntable/{i:04d}.png"]) - 0.11 for i in range(3)]
    assert side(frames[0].clamp_min(0.0)) > 0.1
    assert side(frames[2].clamp_min(0.0)) < -0.1
    # After 90 degrees the lamp shines from -z, behind the sphere.
    assert float(frames[1].clamp_min(0.0).mean()) < 0.5 * float(frames[0].clamp_min(0.0).mean())


@pytest.mark.parametrize("kind", ["gif", "png", "none"])
def test_turntables(orbit, ctx, kind):
    config = RelightConfig(azimuths_deg=(0.0, 120.0, 240.0), views="reference", turntable=kind)
    relit = run(orbit, config=config, ctx=ctx)
    names = {name for name in relit.files if name.startswith("turntable")}
    assert (
        names
        == {
            "gif": {"turntable.gif"},
            "png": {f"turntable/{i:04d}.png" for i in range(3)},
            "none": set(),
        }[kind]
    )
    if kind == "gif":
        assert Image.open(io.BytesIO(relit.files["turntable.gif"])).n_frames == 3
    assert relit.summary["frames"] == 3


def test_exact_shading_agrees_with_the_split_sum(orbit, ctx, tmp_path):
    config = STILL.model_copy(update={"views": (0,)})
    fast = run(orbit, config=config, ctx=ctx)
    exact = run(orbit, config=config.model_copy(update={"quality": "exact"}), ctx=ctx)
    one, other = (layers(f.files, "views/000.exr", tmp_path) for f in (fast, exact))
    # 7 % is the split sum's bias for metals of this roughness, the rest noise of 256 samples.
    assert float(np.abs(one["R"] - other["R"]).mean() / one["R"].mean()) < 0.12
    assert not np.array_equal(one["R"], other["R"])
    again = run(orbit, config=config.model_copy(update={"quality": "exact"}), ctx=ctx)
    assert again.files == exact.files


def test_one_frame_takes_its_camera_from_the_orbit(orbit, ctx):
    whole = run(orbit, config=STILL, ctx=ctx)
    frame = run(orbit / "001.exr", config=STILL, ctx=ctx)
    assert frame.files["views/000.exr"] == whole.files["views/001.exr"]
    assert "camera_assumed" not in {event["kind"] for event in ctx.events}
    (orbit / "orbit.json").unlink()
    run(orbit / "001.exr", config=STILL, ctx=ctx)
    assert "camera_assumed" in {event["kind"] for event in ctx.events}


def test_scene_is_rendered_first_and_occluded(ctx, tmp_path):
    config = STILL.model_copy(update={"orbit_views": 1, "size": 48, "supersample": 2})
    open_air = config.model_copy(update={"occlusion": False})
    one, other = (run(EXAMPLE, config=c, ctx=ctx) for c in (config, open_air))
    planes = [layers(f.files, "views/000.exr", tmp_path) for f in (one, other)]
    assert planes[0]["R"].shape == (48, 48)
    np.testing.assert_array_equal(planes[0]["A"], planes[1]["A"])
    assert planes[0]["diffuse.G"].sum() < planes[1]["diffuse.G"].sum()


def test_views_without_depth_say_so(orbit, ctx):
    run(orbit, config=STILL.model_copy(update={"views": (0,)}), ctx=ctx)
    assert any(event["kind"] == "no_depth" for event in ctx.events)


def test_other_channels_may_be_missing_but_not_these(orbit, ctx):
    planes = read_exr(orbit / "002.exr")
    for name in "RGB":
        del planes[name]
    write_exr(orbit / "002.exr", planes)
    run(orbit, config=STILL, ctx=ctx)
    del planes["roughness.V"]
    write_exr(orbit / "002.exr", planes)
    with pytest.raises(InputError, match=r"missing roughness\.V"):
        run(orbit, config=STILL, ctx=ctx)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"views": (0, 7)}, r"wanted views \[7\], but there are 4"),
        ({"edits": ("gloss=1",)}, "wanted one of basecolor, roughness, metallic"),
        ({"engine": "path"}, "--engine path needs an asset"),
    ],
)
def test_wishes_that_cannot_be_met_are_refused(orbit, ctx, change, said):
    with pytest.raises(InputError, match=said):
        run(orbit, config=STILL.model_copy(update=change), ctx=ctx)


def test_a_photo_is_refused_with_advice(ctx, tmp_path):
    (tmp_path / "cat.png").write_bytes(b"never read")
    with pytest.raises(InputError, match=r"cat.png is a picture, .* svim3d run cat.png"):
        run(tmp_path / "cat.png", config=STILL, ctx=ctx)


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("empty.hdr", b"", "empty|cannot|wanted"),
        ("cut.exr", b"\x76\x2f\x31\x01 and no more", "OpenEXR"),
        ("text.hdr", b"to whom it may concern", "wanted|cannot"),
        ("notes.txt", b"nothing", "wanted a light as"),
    ],
)
def test_lights_that_are_none_are_refused(orbit, ctx, tmp_path, name, content, said):
    (tmp_path / name).write_bytes(content)
    config = STILL.model_copy(update={"environment": tmp_path / name})
    with pytest.raises(InputError, match=said):
        run(orbit, config=config, ctx=ctx)


def test_unphysical_texels_are_mended_and_told(orbit, ctx, tmp_path):
    radiance = np.ones((16, 32, 3), np.float32)
    radiance[3, 4], radiance[5, 6, 0], radiance[7, 8, 1] = -5.0, np.nan, np.inf
    write_rgb(tmp_path / "odd.exr", radiance, half=False)
    config = STILL.model_copy(update={"environment": tmp_path / "odd.exr", "views": (0,)})
    relit = run(orbit, config=config, ctx=ctx)
    assert any("3 texels were no light" in event["message"] for event in ctx.events)
    assert math.isfinite(relit.summary["mean_radiance"])


def test_radiance_and_8_bit_lights(orbit, ctx, tmp_path):
    grey = np.full((16, 32, 3), 0.5, np.float32)
    write_hdr(tmp_path / "grey.hdr", grey)
    write_png(tmp_path / "grey.png", torch.from_numpy(grey), srgb=True)
    means = []
    for name in ("grey.hdr", "grey.png"):
        config = STILL.model_copy(update={"environment": tmp_path / name, "views": (0,)})
        means.append(run(orbit, config=config, ctx=ctx).summary["mean_radiance"])
    assert means == pytest.approx([0.5, 0.5], abs=0.005)
    assert any(event["kind"] == "ldr_light" for event in ctx.events)


# --- edits ---------------------------------------------------------------------------------------


def disc(tmp_path: Path, size: int, centre: tuple[int, int], radius: float) -> Path:
    row, column = torch.meshgrid(torch.arange(size), torch.arange(size), indexing="ij")
    inside = (row - centre[0]) ** 2 + (column - centre[1]) ** 2 <= radius**2
    write_png(tmp_path / "region.png", inside.float()[..., None])
    return tmp_path / "region.png"


def test_edits_change_what_they_name_and_leave_a_record(orbit, ctx, tmp_path):
    config = STILL.model_copy(update={"views": "reference", "edits": ("basecolor=#ff0000",)})
    relit = run(orbit, config=config, ctx=ctx)
    planes = layers(relit.files, "views/003.exr", tmp_path)
    assert planes["diffuse.R"].max() > 0.0 and planes["diffuse.G"].max() == 0.0
    record = json.loads(relit.files["edits.json"])
    assert record == {"format": 1, "edits": ["basecolor=#ff0000"]}


def square_asset(tmp_path: Path) -> Path:
    """Two textured squares behind each other, both facing +z."""
    corners = torch.tensor([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
    near, far = (torch.cat([corners, torch.full((4, 1), z)], 1) for z in (0.2, -0.2))
    uv = torch.tensor([[0.0, 1.0], [0.5, 1.0], [0.5, 0.0], [0.0, 0.0]])
    faces = torch.tensor([[0, 1, 2], [0, 2, 3]])
    file = tmp_path / "squares.glb"
    file.write_bytes(
        glb_bytes(
            vertices=torch.cat([near, far]),
            faces=torch.cat([faces, faces + 4]),
            normals=torch.tensor([0.0, 0.0, 1.0]).expand(8, 3),
            uv=torch.cat([uv, uv + torch.tensor([0.5, 0.0])]),
            basecolor=torch.full((64, 64, 3), 0.5),
            orm=torch.tensor([1.0, 0.5, 0.0]).expand(64, 64, 3),
        )
    )
    return file


def test_a_region_drawn_on_a_view_is_replayed_on_the_texture(ctx, tmp_path):
    asset = square_asset(tmp_path)
    config = STILL.model_copy(
        update={
            "orbit_views": 1,
            "elevation_deg": 0.0,
            "size": 64,
            "edits": ("basecolor=#ff0000",),
            "mask": disc(tmp_path, 64, (32, 32), 8.0),
        }
    )
    relit = run(asset, config=config, ctx=ctx)
    for name in ("edits.json", "mask.png"):
        (tmp_path / name).write_bytes(relit.files[name])
    edited, _ = edit_asset(asset, [], record=tmp_path / "edits.json")
    (tmp_path / "edited.glb").write_bytes(edited)
    texture = read_mesh(tmp_path / "edited.glb").materials[0].basecolor
    red = texture[..., 1] < 0.25
    # The left half shows the near square, whose middle the view sees; the right half lies behind.
    assert bool(red[30:34, 14:18].all())
    assert not bool(red[:, 32:].any())
    assert not bool(red[:16].any()) and not bool(red[48:].any())


def test_a_region_follows_the_surface_into_other_views(ctx, tmp_path):
    asset = square_asset(tmp_path)
    config = STILL.model_copy(
        update={
            "orbit_views": 2,  # behind, and in front
            "elevation_deg": 0.0,
            "size": 64,
            "edits": ("basecolor=#ff0000",),
            "mask": disc(tmp_path, 64, (32, 32), 8.0),
            "occlusion": False,
        }
    )
    relit = run(asset, config=config, ctx=ctx)
    behind, front = (layers(relit.files, f"views/{i:03d}.exr", tmp_path) for i in (0, 1))
    red = front["diffuse.R"] > 4.0 * (front["diffuse.G"] + 1e-4)
    assert red[32, 32] and not red[32, 10]
    # From behind the far square is seen, which the region does not reach.
    assert not (behind["diffuse.R"] > 4.0 * (behind["diffuse.G"] + 1e-4)).any()


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda f: write_png(f, torch.zeros(16, 16, 1)), "is empty: white marks"),
        (lambda f: write_png(f, torch.ones(16, 8, 1)), "in the proportions of"),
        (lambda f: f.write_bytes(b"no picture"), "wanted a PNG or JPEG"),
    ],
)
def test_regions_that_are_none_are_refused(orbit, ctx, tmp_path, make, said):
    make(tmp_path / "region.png")
    config = STILL.model_copy(
        update={"edits": ("metallic=1",), "mask": tmp_path / "region.png", "views": "reference"}
    )
    with pytest.raises(InputError, match=said):
        run(orbit, config=config, ctx=ctx)


def test_a_region_beside_the_object_is_refused(orbit, ctx, tmp_path):
    config = STILL.model_copy(
        update={"edits": ("metallic=1",), "mask": disc(tmp_path, 16, (0, 0), 1.0)}
    )
    with pytest.raises(InputError, match="it misses the object"):
        run(orbit, config=config, ctx=ctx)


def test_a_region_belongs_to_the_reference_view_whatever_is_shown(orbit, ctx, tmp_path):
    config = STILL.model_copy(
        update={"edits": ("metallic=1",), "mask": disc(tmp_path, 16, (8, 8), 3.0), "views": (0, 3)}
    )
    with pytest.raises(InputError, match=r"by depth, and these views have none|add the channel"):
        run(orbit, config=config, ctx=ctx)
    relit = run(orbit, config=config.model_copy(update={"views": (3,)}), ctx=ctx)
    camera = json.loads(relit.files["edits.json"])["camera"]
    assert camera["c2w"] == sphere_cameras().c2w[3].tolist()


@pytest.mark.parametrize(
    "index", ['{"frames": ["a"]}', '{"camera": null, "frames": [{"file": "000.exr", "c2w": 1}]}']
)
def test_an_index_of_another_kind_is_refused(orbit, ctx, index):
    (orbit / "orbit.json").write_text(index)
    with pytest.raises(InputError, match=r"index near|wanted"):
        run(orbit, config=STILL, ctx=ctx)


def test_a_mask_without_edits_is_an_error():
    with pytest.raises(ValueError, match="give an edit too"):
        RelightConfig(mask=Path("region.png"))


def test_assets_are_edited_alone_too(tmp_path):
    asset = square_asset(tmp_path)
    content, notices = edit_asset(asset, ["roughness*4"])
    assert notices == ["asset: roughness*4: 4096 pixels clamped to [0, 1]"]
    (tmp_path / "edited.glb").write_bytes(content)
    assert (
        float(read_mesh(tmp_path / "edited.glb").materials[0].roughness_metallic[..., 0].min())
        == 1.0
    )
    for texts, said in (([], "nothing to edit"), (["rough=1"], "did you mean roughness")):
        with pytest.raises(InputError, match=said):
            edit_asset(asset, texts)
    with pytest.raises(InputError, match="there is no record"):
        edit_asset(asset, [], record=tmp_path / "none.json")
