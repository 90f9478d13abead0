import json
import shutil
from dataclasses import replace

import pytest
import torch
from feature_weights import lite0_state
from lpips_weights import blank_state, formula_weights
from scored_sphere import COLOUR, LIGHTS, ball_asset, plain_images, write_truth
from sphere_orbit import sphere_cameras

from stages.artifacts import ExportedAsset, MaterialViews
from stages.errors import InputError
from stages.missing_scores import run as missing_run
from stages.scores_artifact import TableScores
from stages.set_figures import set_figures
from stages.settings.table_scores import TableScoresConfig
from stages.table_scores import run
from svim3d.io.exr import read_exr, read_rgb, write_exr, write_rgb
from svim3d.io.orbit import read_orbit
from svim3d.io.triangles import read_triangles
from svim3d.io.weights import save_tensors
from svim3d.metrics.stanford_orb import eroded
from svim3d.render.view_consistency import mesh_depth

TINY = TableScoresConfig(surface_samples=2000, volume_cells=24, supersample=2, light_size=16)
SIZE = 32


@pytest.fixture(scope="module")
def truth(tmp_path_factory):
    return write_truth(tmp_path_factory.mktemp("truth"), size=SIZE)


@pytest.fixture
def ctx(make_context):
    with make_context("table_scores") as context:
        yield context


def lit_asset(tmp_path, **rest):
    """The ball with the light of the given views."""
    file = tmp_path / "environment.exr"
    write_rgb(file, torch.full((16, 32, 3), LIGHTS["A"]).numpy())
    return ExportedAsset(ball_asset(**rest).files | {"environment.exr": file.read_bytes()}, {})


def views_of(truth):
    cameras, images, reference = read_orbit(truth)
    return MaterialViews(cameras=cameras, reference=reference, **images)


def drawn(views=4, radius=2.2):
    """What a generator might draw: the truth, from another distance."""
    cameras = sphere_cameras(views, SIZE)
    cameras = replace(cameras, c2w=cameras.c2w.clone())
    cameras.c2w[:, :3, 3] *= radius / 2.2
    return MaterialViews(cameras=cameras, reference=views - 1, **plain_images(cameras, LIGHTS["A"]))


def scores_of(scores, part, subject, figure):
    return [
        view.figures[figure]
        for view in scores.views
        if view.part == part and view.subject == subject
    ]


def test_the_true_asset_is_right_everywhere(truth, tmp_path, ctx):
    asset = lit_asset(tmp_path)
    scores = run(truth, asset, views_of(truth), None, config=TINY, ctx=ctx)
    assert scores.framing == 1.0
    assert scores.surface["chamfer"] < 1e-4
    assert scores.surface["f_0.01"] == 1.0
    assert scores.surface["volume_iou"] == 1.0
    assert scores.agreement == {}
    parts = {(view.part, view.subject, view.light) for view in scores.views}
    assert parts == {
        ("reference", "asset", "A"),
        ("given", "asset", "A"),
        ("novel", "asset", "A"),
        *((("relit", subject, light)) for subject in ("asset", "true views") for light in "BC"),
    }
    assert len(scores_of(scores, "given", "asset", "normal_deg")) == 3
    # Pixels of the rim are shared with the background.
    assert min(scores_of(scores, "given", "asset", "basecolor_scaled_db")) > 15
    assert max(scores_of(scores, "novel", "asset", "roughness_rmse")) < 0.15
    (azimuth,) = {v.azimuth_deg for v in scores.views if v.part == "reference"}
    assert azimuth == pytest.approx(0.0, abs=1e-4)


def test_relighting_is_told_by_the_true_light(truth, tmp_path, ctx):
    bright = run(truth, lit_asset(tmp_path), views_of(truth), None, config=TINY, ctx=ctx)
    dark = run(
        truth,
        lit_asset(tmp_path, colour=tuple(0.3 * c for c in COLOUR)),
        views_of(truth),
        None,
        config=TINY,
        ctx=ctx,
    )
    for subject, changes in (("asset", True), ("true views", False)):
        pair = [scores_of(s, "relit", subject, "rgb_db") for s in (bright, dark)]
        assert (pair[0] != pair[1]) == changes
    better, worse = (sum(scores_of(s, "relit", "asset", "rgb_db")) for s in (bright, dark))
    assert better > worse + 10


def test_a_photo_s_asset_is_laid_over_the_truth(truth, tmp_path, ctx):
    config = TINY.model_copy(update={"from_photo": True})
    # Drawn as large as from 2.2, believed to be farther away: the asset is larger by as much.
    generation = drawn()
    farther = generation.cameras
    farther.c2w[:, :3, 3] *= 1.2
    asset = lit_asset(tmp_path, radius=0.5 * 1.2)
    scores = run(truth, asset, generation, None, config=config, ctx=ctx)
    assert scores.framing == pytest.approx(1.0 / 1.2, rel=1e-4)
    assert scores.surface["chamfer"] < 1e-3
    assert min(scores_of(scores, "given", "drawn", "basecolor_db")) > 40
    assert min(scores_of(scores, "reference", "drawn", "rgb_db")) > 40
    # Of one colour, so that neighbours agree but for pixels of the rim.
    for subject in ("drawn", "true views"):
        figures = scores.agreement[subject]
        assert figures["apart"] < 0.02
        # As bright as its basecolor times the light, and encoded by a curve.
        assert figures["rgb_apart"] < 0.02
        assert 0.05 < figures["compared"] < 1.0


def test_what_was_drawn_at_test_cameras_is_relit(truth, tmp_path, ctx):
    config = TINY.model_copy(update={"from_photo": True})
    novel = drawn(2)
    scores = run(truth, lit_asset(tmp_path), drawn(), novel, config=config, ctx=ctx)
    assert len(scores_of(scores, "novel", "drawn", "rgb_db")) == 2
    relit = scores_of(scores, "relit", "drawn", "rgb_db")
    assert len(relit) == 4
    assert relit == pytest.approx(scores_of(scores, "relit", "true views", "rgb_db"), abs=0.5)


def test_views_from_elsewhere_are_not_taken_for_the_truth_s(truth, tmp_path, ctx):
    config = TINY.model_copy(update={"from_photo": True})
    scores = run(truth, lit_asset(tmp_path), drawn(5), drawn(3), config=config, ctx=ctx)
    assert len(scores_of(scores, "reference", "drawn", "rgb_db")) == 1
    assert not scores_of(scores, "given", "drawn", "rgb_db")
    assert not scores_of(scores, "novel", "drawn", "rgb_db")


def test_stanford_orb_s_rules_are_told_beside_ours(truth, tmp_path, ctx):
    config = TINY.model_copy(update={"stanford_orb": True})
    scores = run(truth, lit_asset(tmp_path), views_of(truth), None, config=config, ctx=ctx)
    for part in ("novel", "relit"):
        official, foreground = (
            scores_of(scores, part, "asset", f"orb.{row}.psnr_ldr_db")
            for row in ("official", "foreground")
        )
        assert all(a > b for a, b in zip(official, foreground, strict=True))
    assert not any("orb." in name for v in scores.views if v.part == "given" for name in v.figures)


def orb_truth(truth, folder, *, unit=1.0, origin=(0.0, 0.0, 0.0)):
    """A copy whose test views under the first light know their depth, and whose world is larger."""
    shutil.copytree(truth, folder)
    index = json.loads((folder / "orbit.json").read_text())
    cameras, _, _ = read_orbit(folder, "test_A")
    vertices, faces = read_triangles(folder / "mesh.ply")
    depth, _ = mesh_depth(vertices, faces, cameras)
    for view, frame in enumerate(index["test"]):
        file = folder / frame["files"]["A"]
        write_exr(file, read_exr(file) | {"depth.Z": depth[view, ..., 0].numpy()})
    index["capture"] = {"unit": unit, "origin": origin}
    (folder / "orbit.json").write_text(json.dumps(index))
    return folder


ORB = TINY.model_copy(update={"stanford_orb": True})


def test_a_capture_s_materials_and_geometry_are_scored_by_its_rules(truth, tmp_path, ctx):
    folder = orb_truth(truth, tmp_path / "truth")
    scores = run(folder, lit_asset(tmp_path), views_of(truth), None, config=ORB, ctx=ctx)
    albedo = scores_of(scores, "novel", "asset", "orb.albedo.official.psnr_ldr_db")
    assert min(albedo) > 60.0  # equal but for half floats
    assert max(scores_of(scores, "novel", "asset", "orb.geometry.normal")) < 1e-3
    # Depth is drawn at several places of a pixel, and of a curved surface.
    assert 0.0 <= scores.capture["depth"] < 1e-2
    # The asset is sampled, the scan is its vertices: a floor of half of their spacing, squared.
    assert 0.0 < scores.capture["shape"] < 2e3 * 0.033**2
    relit = [v for v in scores.views if (v.part, v.subject) == ("relit", "asset")]
    assert not any("albedo" in name or "geometry" in name for v in relit for name in v.figures)
    # Dark albedo of one hue is scaled per channel, and forgiven; unscaled it is not.
    dark = lit_asset(tmp_path, colour=tuple(0.25 * c for c in COLOUR))
    other = run(folder, dark, views_of(truth), None, config=ORB, ctx=ctx)
    rows = [
        scores_of(other, "novel", "asset", f"orb.albedo.{row}.psnr_ldr_db")
        for row in ("official", "unscaled")
    ]
    assert min(rows[0]) > max(rows[1]) + 15.0


def test_a_capture_s_lengths_are_those_of_its_world(truth, tmp_path, ctx):
    folders = [
        orb_truth(truth, tmp_path / str(unit), unit=unit, origin=(2.0, 0.0, 0.0))
        for unit in (1.0, 3.0)
    ]
    larger = lit_asset(tmp_path, radius=0.6)
    one, three = (
        run(f, larger, views_of(truth), None, config=ORB, ctx=ctx).capture for f in folders
    )
    for name in ("depth", "shape"):
        assert three[name] == pytest.approx(9.0 * one[name], rel=1e-6)
    # A tenth off everywhere, both ways: the mean of two equal squares, times 2e3.
    assert one["shape"] == pytest.approx(2e3 * 0.1**2, rel=0.05)
    white = missing_run(folders[1], config=ORB, ctx=ctx)
    # A point in the origin of the capture's world, two of our units, six of its own away: its
    # nearest point is 1.5 away, and the mean square from the sphere 4 + 1/4, times 9.
    assert white.capture["shape"] == pytest.approx(1e3 * 9.0 * (1.5**2 + 4.25), rel=0.02)
    assert "depth" not in white.capture


def test_white_stands_for_what_is_missing(truth, tmp_path, ctx):
    folder = orb_truth(truth, tmp_path / "truth")
    white = missing_run(folder, config=ORB, ctx=ctx)
    scores = run(folder, lit_asset(tmp_path), views_of(truth), None, config=ORB, ctx=ctx)

    def places(page):
        shown = [v for v in page.views if v.subject == "asset" and v.part in ("novel", "relit")]
        return {(v.part, v.light, n) for v in shown for n in v.figures if n.startswith("orb.")}

    assert places(white) == places(scores)
    assert set(scores_of(white, "novel", "asset", "orb.geometry.normal")) == {1.0}
    # The ball is plain: white, scaled per channel, is the ball. So much does the rule forgive.
    assert min(scores_of(white, "novel", "asset", "orb.albedo.official.psnr_ldr_db")) > 60.0
    # Unscaled it is white beside COLOUR, unless a constant 0.5 is nearer.
    (level, *_) = scores_of(white, "novel", "asset", "orb.albedo.foreground.psnr_ldr_db")
    assert level > 60.0
    colour = torch.tensor(COLOUR, dtype=torch.float64)
    nearest = min((1.0 - colour).square().mean(), (0.5 - colour).square().mean())
    share = scored_share(folder)
    unscaled = scores_of(white, "novel", "asset", "orb.albedo.unscaled.psnr_ldr_db")[0]
    assert unscaled == pytest.approx(float(-10.0 * (share * nearest).log10()), abs=0.01)
    white.save(tmp_path)
    assert TableScores.load(tmp_path) == white


def scored_share(folder):
    """Of the first test view, what the eroded mask covers."""
    _, images, _ = read_orbit(folder, "test_A")
    return float(eroded(images["mask"][0] > 0.5).double().mean())


def test_features_of_pictures_are_kept_for_sets(truth, tmp_path, ctx):
    file = tmp_path / "lite0.safetensors"
    save_tensors(file, lite0_state())
    config = TableScoresConfig.model_validate(
        TINY.model_dump(exclude={"digests"}) | {"efficientnet_weights": file}
    )
    assert set(config.digests) == {"efficientnet_weights"}
    scores = run(truth, lit_asset(tmp_path), views_of(truth), None, config=config, ctx=ctx)
    # Three given views but the photo's, and two test views.
    shapes = {name: tuple(rows.shape) for name, rows in scores.features.items()}
    assert shapes == {f"asset/frechet_efficientnet/{s}": (5, 1280) for s in ("shown", "true")}
    scores.save(tmp_path)
    folder = tmp_path
    found = set_figures([folder, folder])
    assert found["asset"].keys() == {"frechet_efficientnet"}
    equal = scores.features["asset/frechet_efficientnet/true"]
    assert 0.0 <= found["asset"]["frechet_efficientnet"] < float(equal.square().sum(1).mean())
    kept = TableScores.load(tmp_path).features
    assert all(torch.equal(kept[name], rows) for name, rows in scores.features.items())


def test_a_truth_of_pictures_alone_has_scores_of_pictures(truth, tmp_path, ctx):
    bare = tmp_path / "bare"
    shutil.copytree(truth, bare)
    (bare / "env_B.exr").unlink()  # of a light that no frame names
    (bare / "mesh.ply").unlink()
    index = json.loads((bare / "orbit.json").read_text())
    for frame in index["test"]:
        frame["files"] = {"A": frame["files"]["A"]}
    (bare / "orbit.json").write_text(json.dumps(index))
    scores = run(bare, lit_asset(tmp_path), views_of(bare), None, config=TINY, ctx=ctx)
    assert scores.surface == {}
    assert {view.part for view in scores.views} == {"reference", "given", "novel"}


def test_scores_come_back_from_their_folder(truth, tmp_path, ctx):
    scores = run(truth, lit_asset(tmp_path), views_of(truth), None, config=TINY, ctx=ctx)
    scores.save(tmp_path)
    assert TableScores.load(tmp_path) == scores


def test_a_folder_without_an_index_is_refused(tmp_path, truth, ctx):
    with pytest.raises(InputError, match=r"orbit\.json"):
        run(tmp_path, lit_asset(tmp_path), views_of(truth), None, config=TINY, ctx=ctx)


def test_the_found_light_lights_the_given_views(truth, tmp_path, ctx):
    asset = lit_asset(tmp_path)
    file = tmp_path / "twice.exr"
    write_rgb(file, 2.0 * read_rgb(tmp_path / "environment.exr"))
    twice = ExportedAsset(asset.files | {"environment.exr": file.read_bytes()}, {})
    one, other = (
        run(truth, a, views_of(truth), None, config=TINY, ctx=ctx) for a in (asset, twice)
    )
    assert max(scores_of(other, "given", "asset", "rgb_db")) < min(
        scores_of(one, "given", "asset", "rgb_db")
    )
    pair = [scores_of(s, "relit", "asset", "rgb_db") for s in (one, other)]
    assert pair[0] == pair[1]


@pytest.mark.parametrize(("kind", "name"), [("alex", "lpips"), ("shift tolerant", "st_lpips")])
def test_lpips_is_told_where_there_are_weights(kind, name, truth, tmp_path, ctx):
    file = tmp_path / "lpips.safetensors"
    save_tensors(file, formula_weights(blank_state("alex", kind)))
    config = TableScoresConfig(
        surface_samples=500, volume_cells=8, supersample=1, light_size=16, lpips_weights=file
    )
    assert set(config.digests) == {"lpips_weights"}
    scores = run(truth, lit_asset(tmp_path), views_of(truth), None, config=config, ctx=ctx)
    figures = scores_of(scores, "relit", "asset", f"rgb_{name}")
    assert len(figures) == 4 and min(figures) > 0.0
    assert all(f"basecolor_{name}" in v.figures for v in scores.views if v.part == "given")


def test_an_orbit_of_ours_without_test_views_has_scores_too(tmp_path, ctx):
    views = drawn()
    views.save(tmp_path)
    scores = run(tmp_path, lit_asset(tmp_path), views, None, config=TINY, ctx=ctx)
    assert {view.part for view in scores.views} == {"reference", "given"}


@pytest.mark.parametrize("missing", ["train/000.exr", "test_C/001.exr", "env_B.exr"])
def test_files_that_are_missing_are_named(missing, truth, tmp_path, ctx):
    folder = tmp_path / "truth"
    shutil.copytree(truth, folder)
    (folder / missing).unlink()
    with pytest.raises(InputError, match=missing):
        run(folder, lit_asset(tmp_path), views_of(truth), None, config=TINY, ctx=ctx)
