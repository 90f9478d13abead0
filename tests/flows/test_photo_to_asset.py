"""A photo through the whole command, with a tiny generator that draws the sphere it was shown."""

import pytest
import torch
import trimesh
from drawn_sphere import drawn_sphere, sphere_photo
from tiny_asset import TINY_ASSET, states
from tiny_model import write_tiny_model

from flows import cli, commands
from flows.pipeline import IMAGE_TO_ASSET
from flows.plan import Selection, Verdict, make_plan
from stages.errors import InputError
from stages.store import Store
from svim3d.diffusion.model import MaterialDiffusion
from svim3d.io.image import read_png, write_png

SMALL = ("prepare.size=48", "generation.sampler_steps=2", *TINY_ASSET)


@pytest.fixture(scope="module")
def photo(tmp_path_factory):
    """The sphere on a transparent ground, off centre."""
    shown = sphere_photo(48)
    picture = torch.zeros(60, 80, 4)
    picture[4:52, 20:68] = torch.cat([shown.rgb, shown.mask], -1)
    file = tmp_path_factory.mktemp("photo") / "sphere.PNG"
    write_png(file, picture)
    return file


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    return write_tiny_model(tmp_path_factory.mktemp("model"))


@pytest.mark.flow
def test_photo_becomes_an_asset(engine, photo, model, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(MaterialDiffusion, "decode", lambda *_: drawn_sphere(5, 16))
    out = tmp_path / "out"
    settings = [part for setting in SMALL for part in ("--set", setting)]
    where = ["-o", str(out), "--store", str(tmp_path / "store"), "--device", "cpu"]
    asked = ["run", str(photo), "--model", str(model), "--samples", "2", "--matting", "alpha"]
    assert cli.main([*asked, *where, *settings]) == cli.DONE
    computed = dict.fromkeys(IMAGE_TO_ASSET.names, "computed")
    assert states(out) == computed | {"capacity": "skipped"}
    (mesh,) = trimesh.load(out / "asset.glb", process=False, force="scene").geometry.values()
    # The sphere is 14 pixels wide in views of 16: a pixel is a fourteenth of it.
    radius = trimesh.util.row_norm(mesh.vertices).mean()
    assert abs(radius - 0.5) < 1 / 14
    sheet = read_png(out / "views.png")
    assert sheet.shape[0] > 5 * 128  # the confidence has a row of its own
    capsys.readouterr()
    assert cli.main(["plan", *asked[1:], *where[2:], *settings]) == cli.DONE
    assert "0 of 9 stages would be computed" in capsys.readouterr().out


def verdicts(source, store, **wishes):
    plan = make_plan(
        IMAGE_TO_ASSET,
        commands.load_config(commands.PipelineConfig, "standard"),
        source=source,
        seed=0,
        store=store,
        selection=Selection(**wishes),
    )
    return {step.node.name: (step.verdict, step.reason) for step in plan.steps}


def test_only_photos_are_prepared(photo, store):
    assert verdicts(photo, store)["prepare"][0] is Verdict.COMPUTE
    scene = commands.input_path("example")
    found = verdicts(scene, store)
    assert found["prepare"] == (Verdict.SKIPPED, "nothing to do for this input")
    assert found["generation"][0] is Verdict.COMPUTE


def test_a_folder_is_no_photo_whatever_its_name(tmp_path, store):
    (tmp_path / "orbit.png").mkdir()
    (tmp_path / "orbit.png" / "orbit.json").write_text("{}")
    assert verdicts(tmp_path / "orbit.png", store)["prepare"][0] is Verdict.SKIPPED


@pytest.mark.parametrize("name", ["notes.txt", "view.exr", "photo"])
def test_files_of_unknown_kinds_are_refused_before_anything_runs(tmp_path, store, name):
    (tmp_path / name).write_bytes(b"x")
    with pytest.raises(InputError, match=rf"wanted a photo, a mesh or a scene .* got {name}"):
        verdicts(tmp_path / name, store)


@pytest.mark.parametrize("option", ["only", "until", "start"])
def test_wishes_for_an_idle_stage_are_refused(store, option):
    with pytest.raises(InputError, match=r"prepare: the stage has nothing to do for example.json"):
        verdicts(commands.input_path("example"), store, **{option: "prepare"})


def test_the_example_photo_is_shipped_with_its_background_cut_out():
    picture = read_png(commands.input_path("photo"))
    assert picture.shape == (448, 448, 4)
    assert float(picture[0, 0, 3]) == 0.0 and float(picture[224, 224, 3]) == 1.0


@pytest.mark.parametrize(
    ("given", "settings"),
    [
        ([], ()),
        (["--samples", "3"], ("generation.samples=3",)),
        (["--matting", "plain"], ('prepare.matting="plain"',)),
        (["--matting", "a: b.onnx"], ('prepare.network="a: b.onnx"',)),
        (["--model", "x#y"], ('generation.model="x#y"',)),
    ],
)
def test_short_options_are_settings(given, settings, monkeypatch):
    asked = []
    monkeypatch.setattr(commands, "show_plan", lambda request: asked.append(request) or cli.DONE)
    assert cli.main(["plan", "photo", *given, "--set", "nerf.steps=5"]) == cli.DONE
    assert asked[0].overrides == (*settings, "nerf.steps=5")


def test_store_is_untouched_by_looking(photo, tmp_path):
    store = Store(tmp_path / "none")
    verdicts(photo, store)
    assert not store.root.exists()
