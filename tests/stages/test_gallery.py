import io
import json

import numpy as np
import pytest
import torch
from PIL import Image
from sphere_views import sphere_views, with_a_pattern_in_colour
from textured_sphere import sphere_asset

from stages.gallery import CELL, COLUMNS, Gallery, run
from stages.photo_artifact import Placement, PreparedPhoto
from stages.settings.gallery import GalleryConfig
from svim3d.color import srgb_from_linear
from svim3d.io.exr import write_rgb
from svim3d.io.hdr import read_hdr
from svim3d.io.image import write_png

CONFIG = GalleryConfig()


@pytest.fixture
def ctx(make_context):
    with make_context("gallery") as context:
        yield context


def views_of(paint=with_a_pattern_in_colour, **more):
    return sphere_views(paint, views=8, size=32, **more)


def opened(content):
    return np.asarray(Image.open(io.BytesIO(content)).convert("RGB"), np.float32) / 255.0


def centre(sheet, place):
    """Mean of the middle of a cell."""
    row, column = divmod(place, COLUMNS)
    y, x = row * CELL + CELL // 2, column * CELL + CELL // 2
    return sheet[y - 8 : y + 8, x - 8 : x + 8].mean((0, 1))


def test_sheets_begin_with_the_reference_and_go_on_around_the_object(ctx):
    views = views_of(lambda point: torch.full((len(point), 5), 0.5))
    # Each view has a colour of its own.
    shade = torch.linspace(0.1, 0.8, 8).view(8, 1, 1, 1)
    views = views.__class__(
        **{**vars(views), "basecolor": shade * views.mask.expand(-1, -1, -1, 3)}
    )
    gallery = run(None, None, views, None, config=CONFIG, ctx=ctx)
    about = json.loads(gallery.files["gallery.json"])
    assert [view["view"] for view in about["views"]] == [7, 0, 1, 2, 3, 4, 5, 6]
    around = [view["azimuth_deg"] for view in about["views"]]
    assert around == [45.0 * place for place in range(8)]
    sheet = opened(gallery.files["views/basecolor.webp"])
    assert sheet.shape == (2 * CELL, COLUMNS * CELL, 3)
    for place, view in enumerate([7, 0, 1, 2, 3, 4, 5, 6]):
        wanted = float(srgb_from_linear(shade[view]).squeeze())
        assert abs(centre(sheet, place).mean() - wanted) < 0.03
    assert "asset/rgb.webp" not in gallery.files and about["light"] == []


def test_normals_are_shown_as_each_camera_sees_them(ctx):
    sheet = opened(
        run(None, None, views_of(), None, config=CONFIG, ctx=ctx).files["views/normal.webp"]
    )
    for place in range(8):  # the middle of a sphere faces whoever looks at it
        assert np.abs(centre(sheet, place) - [0.5, 0.5, 1.0]).max() < 0.05


def test_the_asset_is_seen_from_where_its_views_were(ctx):
    gallery = run(None, None, views_of(), sphere_asset(), config=CONFIG, ctx=ctx)
    sheet = opened(gallery.files["asset/metallic.webp"])
    half = CELL // 4
    front = sheet[:CELL, :CELL].mean(-1)
    assert front[CELL // 2, CELL // 2 - half // 2] < 0.1  # plastic on the left
    assert front[CELL // 2, CELL // 2 + half // 2] > 0.9  # gold on the right
    # The back is seen mirrored: its left is the object's right.
    row, column = divmod(4, COLUMNS)
    back = sheet[row * CELL :, column * CELL :][:CELL, :CELL].mean(-1)
    assert back[CELL // 2, CELL // 2 - half // 2] > 0.9
    poster = Image.open(io.BytesIO(gallery.files["poster.webp"]))
    assert poster.mode == "RGBA" and np.asarray(poster)[0, 0, 3] == 0


def test_lights_are_turned_as_web_viewers_hold_them(ctx, tmp_path):
    # One bright texel of the found light towards +x: a quarter of a turn right of the middle.
    picture = np.full((16, 32, 3), 0.1, np.float32)
    picture[8, 24] = 50.0
    write_rgb(tmp_path / "light.exr", picture, half=True)
    asset = sphere_asset(**{"environment.exr": (tmp_path / "light.exr").read_bytes()})
    gallery = run(None, None, views_of(), asset, config=CONFIG, ctx=ctx)
    assert json.loads(gallery.files["gallery.json"])["light"][0] == "found"
    (tmp_path / "found.hdr").write_bytes(gallery.files["lights/found.hdr"])
    turned = read_hdr(tmp_path / "found.hdr")
    assert np.unravel_index(turned[..., 0].argmax(), (16, 32)) == (
        8,
        16,
    )  # three.js: +x in the middle
    for name in json.loads(gallery.files["gallery.json"])["light"]:
        assert f"lights/{name}.hdr" in gallery.files and f"lights/{name}.webp" in gallery.files


def test_an_asset_too_large_for_a_page_is_reduced_or_left_out_and_that_is_told(ctx):
    large = sphere_asset(texture=0)
    assert "model.glb" not in run(None, None, None, large, config=CONFIG, ctx=ctx).files
    noisy = torch.rand(512, 512, 3, generator=torch.Generator().manual_seed(2))
    from svim3d.io.glb import glb_bytes

    content = glb_bytes(
        vertices=torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]),
        faces=torch.tensor([[0, 1, 2]]),
        normals=torch.tensor([[0.0, 0, 1]]).expand(3, 3),
        uv=torch.tensor([[0.0, 1], [1, 1], [0, 0]]),
        basecolor=noisy,
        orm=torch.tensor([1.0, 0.5, 0.0]),
    )
    small = GalleryConfig(most_model_mib=0.3)
    asset = sphere_asset().__class__({"asset.glb": content}, {})
    found = run(None, None, None, asset, config=small, ctx=ctx)
    assert len(found.files["model.glb"]) <= 0.3 * 2**20
    assert [event["kind"] for event in ctx.events] == ["model_reduced"]


def test_a_photo_and_its_cut_out_are_shown_small(ctx, tmp_path):
    write_png(tmp_path / "photo.png", torch.full((900, 700, 3), 0.25))
    place = Placement(height=900, width=700, top=0, left=0, bottom=9, right=9, scale=1.0)
    cut_out = PreparedPhoto(torch.full((8, 8, 3), 0.5), torch.zeros(8, 8, 1), place, "plain")
    gallery = run(tmp_path / "photo.png", cut_out, None, None, config=CONFIG, ctx=ctx)
    picture = opened(gallery.files["input.webp"])
    assert picture.shape[0] == 640 and abs(picture.mean() - 0.25) < 0.01
    assert abs(opened(gallery.files["cut_out.webp"]).mean() - 0.11) < 0.01  # nothing but paper


def test_equal_input_gives_equal_bytes_and_what_is_saved_is_read_back(ctx, tmp_path):
    one, two = (run(None, None, views_of(), None, config=CONFIG, ctx=ctx) for _ in range(2))
    assert one.files == two.files
    one.save(tmp_path)
    found = Gallery.load(tmp_path)
    assert found.files == one.files and found.headline() == one.headline()
