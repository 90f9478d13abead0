"""From a photo to the square: what is found, where it is put, what is told and what is refused."""

import math

import numpy as np
import pytest
import torch
from cut_out_scenes import HEIGHT, WIDTH, disc, gradient, grey, lollipop, orange, photo, ring, white
from onnx_file import pixel_network
from PIL import Image
from pydantic import ValidationError

import stages.prepare
from stages.errors import InputError
from stages.photo_artifact import PreparedPhoto
from stages.prepare import PREPARE, run
from stages.settings.prepare import PrepareConfig
from svim3d.color import linear_from_srgb, srgb_from_linear
from svim3d.io.image import write_png
from svim3d.placement import bounding_box

SMALL = PrepareConfig(size=96)


@pytest.fixture
def ctx(make_context, monkeypatch):
    """A context without any installed network, whatever this machine has."""
    monkeypatch.setattr(stages.prepare, "find_network", lambda: None)
    with make_context("prepare") as context:
        yield context


@pytest.fixture
def file(tmp_path):
    def write(picture, name="photo.png"):
        write_png(tmp_path / name, picture)
        return tmp_path / name

    return write


def kinds(ctx):
    return [event["kind"] for event in ctx.events]


def config(**changes):
    return PrepareConfig(**SMALL.model_dump() | changes)


def cut_out_file(file, mask=None):
    mask = disc() if mask is None else mask
    return file(torch.cat([srgb_from_linear(orange()), mask], -1))


# --- what tells the object from its background ----------------------------------------------------


def test_transparency_comes_first(file, ctx):
    prepared = run(cut_out_file(file), config=SMALL, ctx=ctx)
    assert prepared.cut_out == "alpha" and not ctx.events
    # A disc of radius 55 becomes one of 0.45 * 96, in the middle.
    y, x = torch.meshgrid(torch.arange(96) + 0.5, torch.arange(96) + 0.5, indexing="ij")
    radius = torch.hypot(x - 48, y - 48)[..., None]
    assert bool((prepared.mask[radius < 41] == 1.0).all())
    assert not prepared.mask[radius > 45].any()
    assert float(prepared.mask.sum()) == pytest.approx(math.pi * (0.45 * 96) ** 2, rel=0.01)


def test_equal_scale_keeps_transparency_and_colours_exactly(file, ctx):
    # 54 pixels are 0.9 of a square of 60.
    mask = torch.zeros(70, 80, 1)
    mask[4:58, 11:65] = (torch.rand(54, 54, 1, generator=torch.Generator().manual_seed(0))) * 0.5
    mask[4:58, 11:65] += 0.5019608
    mask = (mask * 255).round() / 255
    rgb = (torch.rand(70, 80, 3, generator=torch.Generator().manual_seed(1)) * 255).round() / 255
    prepared = run(file(torch.cat([rgb, mask], -1)), config=config(size=60), ctx=ctx)
    assert torch.equal(prepared.mask[3:57, 3:57], mask[4:58, 11:65])
    assert torch.equal(prepared.rgb[3:57, 3:57], rgb[4:58, 11:65])


def test_plain_background_is_the_last_resort_and_told(file, ctx):
    picture = photo(lollipop(), orange(), gradient())
    prepared = run(file(picture), config=SMALL, ctx=ctx)
    assert prepared.cut_out == "plain" and kinds(ctx)[0] == "plain_cut_out"
    truth = run(cut_out_file(file, lollipop()), config=SMALL, ctx=ctx)
    assert float((prepared.mask - truth.mask).abs().mean()) < 0.01
    seen = (prepared.mask > 0.2)[..., 0] & (truth.mask > 0.2)[..., 0]
    # No background along the edge: colours are those of the object alone.
    assert float((prepared.rgb[seen] - truth.rgb[seen]).abs().mean()) < 0.03


def test_network_is_taken_where_there_is_one(file, ctx, tmp_path, monkeypatch):
    pytest.importorskip("onnxruntime")
    network = tmp_path / "network.onnx"
    # Red minus blue, steep: the object is orange, the background bluish.
    network.write_bytes(pixel_network((6.0, 0.0, -6.0), height="h", width="w"))
    picture = file(photo(disc(), orange(), gradient()))
    given = run(picture, config=config(network=network), ctx=ctx)
    monkeypatch.setattr(stages.prepare, "find_network", lambda: network)
    installed = run(picture, config=SMALL, ctx=ctx)
    asked = run(picture, config=config(matting="network"), ctx=ctx)
    assert given.cut_out == installed.cut_out == asked.cut_out == "network"
    assert torch.equal(given.mask, installed.mask) and torch.equal(given.rgb, asked.rgb)
    truth = run(cut_out_file(file), config=SMALL, ctx=ctx)
    solid, whole = given.mask > 0.5, truth.mask > 0.5
    assert float((solid & whole).sum() / (solid | whole).sum()) > 0.97
    # Transparency is worth more than a network.
    assert run(cut_out_file(file), config=config(network=network), ctx=ctx).cut_out == "alpha"
    assert run(picture, config=config(matting="plain"), ctx=ctx).cut_out == "plain"


def test_settings_know_the_network_by_its_content(tmp_path):
    (tmp_path / "n.onnx").write_bytes(b"1")
    first = PrepareConfig(network=tmp_path / "n.onnx")
    (tmp_path / "n.onnx").write_bytes(b"2")
    assert first.digests != PrepareConfig(network=tmp_path / "n.onnx").digests
    with pytest.raises(ValidationError, match="uses no network"):
        PrepareConfig(network=tmp_path / "n.onnx", matting="plain")


def test_transparency_that_is_not_asked_for_lies_on_white(file, ctx):
    prepared = run(cut_out_file(file), config=config(matting="plain"), ctx=ctx)
    assert "opacity_ignored" in kinds(ctx) and prepared.cut_out == "plain"


@pytest.mark.parametrize(
    ("picture", "changes", "said"),
    [
        (lambda: photo(disc(), orange(), white()), {"matting": "alpha"}, "all of it is opaque"),
        (lambda: photo(disc(), orange(), white()), {"matting": "network"}, "pip install --no-deps"),
        (lambda: photo(disc(), gradient(), gradient()), {}, "nothing stands out"),
        (lambda: torch.zeros(64, 64, 4), {}, "covers at least 0.1 % of the photo, got 0 %"),
        (lambda: torch.cat([grey(), disc(radius=2.0)], -1), {}, "crop the photo closer"),
        (lambda: torch.rand(1, 1, 3), {}, "at least 16 pixels"),
    ],
)
def test_what_cannot_be_cut_out_is_refused(file, ctx, picture, changes, said):
    with pytest.raises(InputError, match=said):
        run(file(picture()), config=config(**changes), ctx=ctx)


@pytest.mark.parametrize("content", [b"", b"no picture", b"\x89PNG\r\n\x1a\n\0"])
def test_what_is_no_photo_is_refused(tmp_path, ctx, content):
    (tmp_path / "x.png").write_bytes(content)
    with pytest.raises(InputError, match=r"wanted a photo .*x\.png"):
        run(tmp_path / "x.png", config=SMALL, ctx=ctx)


def test_missing_photo_is_refused(tmp_path, ctx):
    with pytest.raises(InputError, match="does not exist"):
        run(tmp_path / "x.png", config=SMALL, ctx=ctx)


# --- where it is put ------------------------------------------------------------------------------


@pytest.mark.parametrize("fill", [0.5, 0.9, 1.0])
@pytest.mark.parametrize(
    ("height", "width", "rows", "columns"),
    [
        (40, 300, (10, 30), (5, 290)),
        (400, 90, (0, 390), (20, 50)),
        (8, 3000, (2, 5), (10, 2990)),
        (64, 64, (30, 36), (20, 26)),
    ],
)
def test_object_is_centred_and_fills_the_square(file, ctx, fill, height, width, rows, columns):
    mask = torch.zeros(height, width, 1)
    mask[slice(*rows), slice(*columns)] = 1.0
    picture = torch.cat([torch.full((height, width, 3), 0.5), mask], -1)
    prepared = run(file(picture), config=config(fill=fill, min_coverage=0.0), ctx=ctx)
    assert prepared.rgb.shape == (96, 96, 3)
    along = prepared.mask.amax(0)[:, 0], prepared.mask.amax(1)[:, 0]
    longest = max(rows[1] - rows[0], columns[1] - columns[0])
    for covered, (first, last) in zip(along, (columns, rows), strict=True):
        length = (last - first) * fill * 96 / longest
        found = (covered > 0.5 * float(covered.max())).nonzero()[:, 0]
        assert abs(len(found) - length) <= 2.0 or length < 2.0
        assert float(found.float().mean()) + 0.5 == pytest.approx(48.0, abs=0.51)


def test_placement_leads_back_to_the_photo(file, ctx):
    mask = disc(radius=30.0, x=70.0, y=60.0)
    prepared = run(cut_out_file(file, mask), config=SMALL, ctx=ctx)
    place = prepared.placement
    assert (place.height, place.width) == (HEIGHT, WIDTH)
    assert (place.top, place.left, place.bottom, place.right) == (30, 40, 90, 100)
    assert place.scale == pytest.approx(0.9 * 96 / 60)
    # Colours are where the placement says.
    y = round((50.5 - 48) / place.scale + 0.5 * (place.top + place.bottom) - 0.5)
    x = round((40.5 - 48) / place.scale + 0.5 * (place.left + place.right) - 0.5)
    expected = srgb_from_linear(orange())[y, x]
    assert float((prepared.rgb[50, 40] - expected).abs().max()) < 0.03


def test_large_photos_are_placed_in_their_own_pixels(tmp_path, ctx):
    values = np.zeros((3000, 5000, 4), np.uint8)
    values[600:2400, 1200:3600] = [200, 100, 50, 255]
    Image.fromarray(values).save(tmp_path / "x.png", compress_level=1)
    place = run(tmp_path / "x.png", config=SMALL, ctx=ctx).placement
    assert (place.height, place.width) == (3000, 5000)
    found = (place.top, place.left, place.bottom, place.right)
    assert found == pytest.approx((600, 1200, 2400, 3600), abs=3)
    assert place.scale == pytest.approx(0.9 * 96 / 2400, rel=0.003)


def test_what_run_returns_is_what_load_reads(file, ctx, tmp_path):
    prepared = run(file(photo(ring(), orange(), gradient())), config=SMALL, ctx=ctx)
    (tmp_path / "saved").mkdir()
    prepared.save(tmp_path / "saved")
    again = PreparedPhoto.load(tmp_path / "saved")
    assert torch.equal(again.rgb, prepared.rgb) and torch.equal(again.mask, prepared.mask)
    assert again.placement == prepared.placement and again.cut_out == prepared.cut_out
    assert again.headline() == prepared.headline()
    assert not prepared.rgb[(prepared.mask == 0.0)[..., 0]].any()


def test_same_photo_gives_the_same_bits(file, ctx):
    picture = file(photo(lollipop(), orange(), gradient()))
    first, second = (run(picture, config=SMALL, ctx=ctx) for _ in range(2))
    assert torch.equal(first.rgb, second.rgb) and torch.equal(first.mask, second.mask)


# --- what is told ---------------------------------------------------------------------------------


def test_specks_are_dropped_and_told(file, ctx):
    mask = torch.maximum(disc(radius=40.0), disc(radius=2.0, x=20.0, y=20.0))
    prepared = run(cut_out_file(file, mask), config=SMALL, ctx=ctx)
    assert kinds(ctx) == ["specks_dropped"]
    clean = run(cut_out_file(file, disc(radius=40.0)), config=SMALL, ctx=ctx)
    assert torch.equal(prepared.mask, clean.mask)


def test_several_objects_are_kept_together_and_told(file, ctx):
    mask = torch.maximum(disc(radius=30.0, x=50.0), disc(radius=25.0, x=190.0))
    prepared = run(cut_out_file(file, mask), config=SMALL, ctx=ctx)
    assert kinds(ctx) == ["several_objects"]
    place = prepared.placement
    assert (place.left, place.right) == (20, 215)


def test_cut_off_objects_are_told(file, ctx):
    run(cut_out_file(file, disc(x=240.0, y=180.0)), config=config(size=64), ctx=ctx)
    assert kinds(ctx) == ["object_cut_off"]
    assert "bottom, right border" in ctx.events[0]["message"]


@pytest.mark.parametrize("side", [1, 8])
def test_tiny_photos_are_enlarged_and_told(file, ctx, side):
    picture = torch.full((side, side, 4), 0.5)
    if side > 1:
        picture[:, :3, 3] = 0.0
    picture[..., 3] *= 1.2
    prepared = run(file(picture), config=SMALL, ctx=ctx)
    assert "photo_enlarged" in kinds(ctx)
    assert float(prepared.mask.max()) == pytest.approx(0.6, abs=0.01)
    seen = prepared.rgb[prepared.mask[..., 0] > 0]
    assert float((seen - 0.5).abs().max()) < 0.01


def test_stage_knows_its_input_and_output():
    assert list(PREPARE.inputs) == ["source"] and PREPARE.output is PreparedPhoto


# --- real photos ----------------------------------------------------------------------------------


@pytest.mark.parametrize("asset", ["barrel", "boombox", "cat", "oculus", "spheres"])
def test_rendered_objects_keep_their_pixels(data, ctx, asset):
    source = data / "orbits" / asset / "reference.png"
    prepared = run(source, config=PrepareConfig(), ctx=ctx)
    assert prepared.cut_out == "alpha"
    with Image.open(source) as picture:
        whole = torch.from_numpy(np.asarray(picture, np.float32) / 255.0)
    box = bounding_box(whole[..., 3:])
    # Light and coverage grow with the area of a pixel, and nothing else happens to them.
    area = (0.9 * 576 / box.longest) ** 2
    assert float(prepared.mask.sum()) == pytest.approx(area * float(whole[..., 3].sum()), rel=0.002)
    light = (linear_from_srgb(prepared.rgb) * prepared.mask).sum((0, 1))
    before = (linear_from_srgb(whole[..., :3]) * whole[..., 3:]).sum((0, 1))
    torch.testing.assert_close(light, area * before, rtol=0.003, atol=0)


@pytest.mark.parametrize(
    ("name", "managed"),
    [
        ("coffee_cc0.png", False),
        ("rembg_animal3.jpg", False),
        ("rembg_car1.jpg", False),
        ("rembg_car2.jpg", False),
        ("u2_bike.jpg", False),
        ("u2_lamp2_meitu_1.jpg", True),
    ],
)
def test_scenes_are_refused_and_plain_backgrounds_are_not(data, ctx, name, managed):
    plain = config(matting="plain")
    if managed:
        assert float(run(data / "photos" / name, config=plain, ctx=ctx).mask.mean()) > 0.05
    else:
        with pytest.raises(InputError, match="--matting"):
            run(data / "photos" / name, config=plain, ctx=ctx)
