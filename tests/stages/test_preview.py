import math

import pytest
import torch
from sphere_orbit import sphere_cameras, sphere_images

from stages.artifacts import ExportedAsset, FittedField, MaterialViews
from stages.preview import INK, PAPER, TEXT_PX, PreviewSheet, doubts_of, run
from stages.settings.preview import PreviewConfig
from svim3d.fields.material_field import MaterialFieldSpec
from svim3d.io.exr import write_rgb
from svim3d.io.glb import glb_bytes
from svim3d.io.image import Label, with_labels
from svim3d.mesh.lathe import revolve

TINY = PreviewConfig(views=3, cell=64, supersample=4)


@pytest.fixture
def ctx(make_context):
    with make_context("preview") as context:
        yield context


@pytest.fixture
def views():
    """The analytic sphere, in plain red plastic."""
    cameras = sphere_cameras(views=7, size=48)
    images = sphere_images(cameras)
    images["basecolor"] = torch.tensor([0.8, 0.1, 0.1]) * images["mask"]
    images["metallic"] = torch.zeros_like(images["mask"])
    return MaterialViews(cameras=cameras, reference=6, **images)


@pytest.fixture
def field():
    """Only its light is read."""
    return FittedField(
        sdf=torch.zeros(2, 2, 2),
        half_extent=0.55,
        material_spec=MaterialFieldSpec(),
        material_state={},
        environment=torch.full((16, 16, 3), 0.5),
    )


def asset(radius=0.5, basecolor=(0.8, 0.1, 0.1), **files):
    angle = torch.linspace(-math.pi / 2, math.pi / 2, 65)
    profile = torch.stack([angle.cos(), angle.sin()], 1)
    profile[[0, -1], 0] = 0.0
    body = revolve(profile * radius, rounds=0, segments=128)
    count = len(body.vertices)
    glb = glb_bytes(
        vertices=body.vertices,
        faces=body.faces,
        normals=body.normals,
        basecolor=torch.tensor(basecolor).expand(count, 3),
        orm=torch.tensor([1.0, 0.5, 0.0]).expand(count, 3),
    )
    return ExportedAsset({"asset.glb": glb} | files, {})


def test_true_asset_reproduces_the_views(views, field, ctx):
    figures = run(views, field, asset(), config=TINY, ctx=ctx).figures
    assert figures["basecolor_psnr_db"] > 60
    assert figures["roughness_psnr_db"] > 60
    assert figures["metallic_psnr_db"] > 60
    assert figures["normal_angle_deg"] < 0.5
    assert figures["mask_iou"] > 0.98


def test_a_wrong_colour_costs_what_the_formula_says(views, field, ctx):
    figures = run(views, field, asset(basecolor=(0.8, 0.1, 0.0)), config=TINY, ctx=ctx).figures
    # sRGB(0.1) = 0.349 of error in one of three channels.
    expected = -10 * math.log10(0.349190**2 / 3)
    assert figures["basecolor_psnr_db"] == pytest.approx(expected, abs=0.02)


def test_overlap_tells_the_size(views, field, ctx):
    figures = run(views, field, asset(radius=0.25), config=TINY, ctx=ctx).figures
    # Silhouettes of spheres at distance d: tan^2 = r^2 / (d^2 - r^2).
    expected = (0.25**2 / (2.2**2 - 0.25**2)) / (0.5**2 / (2.2**2 - 0.5**2))
    assert figures["mask_iou"] == pytest.approx(expected, abs=0.02)


def test_light_delivered_with_the_asset_is_used(views, field, ctx, tmp_path):
    write_rgb(tmp_path / "dark.exr", torch.full((16, 32, 3), 1e-4).numpy())
    dark = {"environment.exr": (tmp_path / "dark.exr").read_bytes()}
    sheet = run(views, field, asset(**dark), config=TINY, ctx=ctx).sheet
    bright = run(views, field, asset(), config=TINY, ctx=ctx).sheet
    changed = (sheet - bright).abs().amax(-1) > 0.1
    cell, step, top = 64, 72, 36
    rows = [bool(changed[top + i * step : top + i * step + cell].any()) for i in range(6)]
    # Only the shaded asset (and its note) and the panorama below change.
    assert rows == [False, True, False, False, False, False]
    assert bool(changed[top + 6 * step :].any())


def test_sheet_shows_the_reference_first_and_all_rows(views, field, ctx):
    sheet = run(views, field, asset(), config=TINY, ctx=ctx).sheet
    assert sheet.shape == (36 + 7 * 72, 104 + 3 * 72, 3)
    labelled = with_labels(
        torch.full((36, 120, 3), PAPER), [Label(0, 18, "view 6", TEXT_PX)], ink=INK
    )
    assert torch.equal(sheet[:36, 104:164], labelled[:, :60])
    cell = sheet[36 + 2 * 72 :, 104:][:64, :64]
    srgb = torch.tensor([0.9063, 0.3492, 0.3492])
    torch.testing.assert_close(cell[32, 32], srgb, rtol=0, atol=0.01)


def test_round_trip_and_same_bytes(views, field, ctx, tmp_path):
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        run(views, field, asset(), config=TINY, ctx=ctx).save(tmp_path / name)
    again = PreviewSheet.load(tmp_path / "a")
    assert again.headline().startswith("basecolor ")
    (tmp_path / "c").mkdir()
    again.save(tmp_path / "c")
    for file in ("preview.png", "metrics.json"):
        content = {(tmp_path / name / file).read_bytes() for name in "abc"}
        assert len(content) == 1


def test_an_asset_of_its_views_is_not_doubted(views, field, ctx):
    run(views, field, asset(), config=TINY, ctx=ctx)
    doubted = [e for e in ctx.events if e["kind"] == "views_disagree"]
    # The flat light of the test is not that of the views: radiance alone may be off.
    assert all("radiance" in e["message"] and "normals" not in e["message"] for e in doubted)


def test_an_asset_that_shows_something_else_is_told(views, field, ctx):
    run(views, field, asset(radius=0.4, basecolor=(0.1, 0.8, 0.1)), config=TINY, ctx=ctx)
    (message,) = [e["message"] for e in ctx.events if e["kind"] == "views_disagree"]
    assert "basecolor" in message and "outlines overlap by" in message
    assert "metallic" not in message


def test_figures_that_are_no_numbers_are_doubted():
    sound = {f"{name}_psnr_db": 40.0 for name in ("radiance", "basecolor", "roughness", "metallic")}
    sound |= {"normal_angle_deg": 1.0, "mask_iou": 0.99}
    assert doubts_of(sound) == []
    assert doubts_of(sound | {"radiance_psnr_db": math.nan}) == ["radiance nan dB"]
    assert doubts_of(sound | {"mask_iou": math.nan}) == ["outlines overlap by nan%"]
