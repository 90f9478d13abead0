import numpy as np
import pytest
import torch

from stages.hazard_trial import HAZARDS, judge, lay_out, make_trial, unwrap_torture
from svim3d.io.exr import read_exr, write_rgb
from svim3d.io.glb import glb_bytes, read_mesh
from svim3d.io.orbit import read_orbit
from svim3d.shading.environment import latlong_from_octahedral
from svim3d.synthesis.hazards.trials import exposure_of


@pytest.fixture(scope="module")
def shared(tmp_path_factory):
    return tmp_path_factory.mktemp("shared")


def trial_of(shared, hazard, severity=0.0, variant=""):
    return make_trial(hazard, variant, severity, 0, shared=shared, size=32, views=6)


def write_asset(folder, mesh, light, scale=1.0, metallic=None):
    """The mesh itself as the export stage would have left it."""
    material = mesh.materials[0]
    metal = material.metallic_factor if metallic is None else metallic
    orm = torch.tensor([1.0, material.roughness_factor, metal])
    content = glb_bytes(
        vertices=mesh.vertices * scale,
        faces=mesh.faces,
        normals=mesh.normals,
        basecolor=mesh.colors,
        orm=orm.expand(len(mesh.vertices), 3),
    )
    folder.mkdir()
    (folder / "asset.glb").write_bytes(content)
    write_rgb(folder / "environment.exr", light.numpy(), half=False)


@pytest.fixture(scope="module")
def toy(shared):
    """A harmless trial, and the light that it was photographed in."""
    trial = trial_of(shared, "misaligned")
    from stages.prefilter_cache import cached_operator
    from svim3d.synthesis.hazards.trials import Darkroom

    room = Darkroom(cached_operator(shared, 64), 32, 6)
    plain = room.pictures(trial.truth.mesh, trial.cameras, room.studio())
    return trial, latlong_from_octahedral(room.studio() * exposure_of(plain), height=128)


def test_the_truth_itself_scores_high(toy, shared, tmp_path):
    trial, light = toy
    write_asset(tmp_path / "a", trial.truth.mesh, light)
    figures, strip = judge(trial, tmp_path / "a", shared=shared)
    # The light is resampled on its way through the file.
    assert figures["view_db"] > 45.0 and figures["relit_db"] > 60.0
    assert figures["score_db"] == min(figures["view_db"], figures["relit_db"])
    assert figures["mask_iou"] == 1.0 and figures["normal_deg"] < 0.1
    # Two sets of points drawn on one surface.
    assert figures["distance"] < 1e-6
    assert figures["finite"] and figures["watertight"] and figures["euler"] == 2
    assert strip.startswith(b"\xff\xd8")


def test_what_is_wrong_costs(toy, shared, tmp_path):
    trial, light = toy
    write_asset(tmp_path / "small", trial.truth.mesh, light, scale=0.8)
    write_asset(tmp_path / "metal", trial.truth.mesh, light, metallic=1.0)
    small, _ = judge(trial, tmp_path / "small", shared=shared)
    metal, _ = judge(trial, tmp_path / "metal", shared=shared)
    assert small["mask_iou"] == pytest.approx(0.64, abs=0.05)
    assert small["score_db"] < 20.0
    assert metal["is_metal"] and not metal["was_metal"]
    assert metal["relit_db"] < 30.0 and metal["basecolor_db"] > 50.0


def test_values_that_are_none_are_found(toy, shared, tmp_path):
    trial, light = toy
    spoilt = light.clone()
    spoilt[3, 5] = float("nan")
    write_asset(tmp_path / "a", trial.truth.mesh, spoilt)
    assert not judge(trial, tmp_path / "a", shared=shared)[0]["finite"]


def test_an_orbit_is_laid_out_as_it_was_spoilt(shared, tmp_path):
    trial = trial_of(shared, "numeric", 1.0, "basecolor nan")
    given = lay_out(trial, tmp_path)
    assert given.source == tmp_path and given.overrides == ()
    planes = read_exr(tmp_path / "000.exr")
    bad = np.isnan(planes["basecolor.R"])
    assert int(bad.sum()) == round(0.008 * 32 * 32)
    assert np.isfinite(read_exr(tmp_path / "001.exr")["basecolor.R"]).all()
    cameras, images, reference = read_orbit(tmp_path)
    assert len(cameras) == 6 and reference == 5 and "confidence" not in images


def test_a_light_comes_with_the_mesh(shared, tmp_path):
    trial = trial_of(shared, "numeric", 1.0, "light nan")
    given = lay_out(trial, tmp_path)
    assert given.source.name == "thing.glb"
    assert f'generation.environment="{tmp_path / "light.exr"}"' in given.overrides
    assert np.isnan(read_exr(tmp_path / "light.exr")["R"]).any()
    assert len(read_mesh(given.source).faces) == len(trial.truth.mesh.faces)


@pytest.mark.parametrize("kind", HAZARDS["uv-torture"].variants)
def test_tortured_meshes_get_an_atlas_without_overlaps(kind):
    figures = unwrap_torture(kind, 0.0, 0)
    assert figures["finite"] and figures["is_whole"], figures
    assert figures["overlapping"] == figures["raw_overlapping"] == 0
    assert figures["charts"] > 0 and figures["coverage"] > 0.01
