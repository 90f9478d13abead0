import pytest
import torch
from painted_meshes import KINDS, painted_mesh, textured_mesh
from pydantic import ValidationError
from sphere_views import grey_sphere, of_two_materials, sphere_views

from stages import export_formats
from stages.artifacts import ExportedAsset, MaterialViews
from stages.base import Context
from stages.export import run
from stages.finished_views import ViewFolder
from stages.settings.export import ExportConfig
from svim3d.io.exr import read_exr, read_exr_attributes
from svim3d.io.glb_small import small_glb_bytes
from svim3d.io.usd import usdz_bytes


@pytest.fixture(scope="module")
def field():
    return grey_sphere()


@pytest.fixture(scope="module")
def given():
    views = sphere_views(of_two_materials, views=3, size=32)
    trust = torch.linspace(0.0, 1.0, 32).expand(3, 32, 32)[..., None]
    return MaterialViews(**vars(views) | {"confidence": trust})


@pytest.fixture(scope="module")
def views(given, tmp_path_factory):
    folder = tmp_path_factory.mktemp("views")
    given.save(folder)
    return ViewFolder.load(folder)


@pytest.fixture
def make(field, views, tmp_path):
    def make(mesh, **settings):
        ctx = Context("export", torch.device("cpu"), 0, tmp_path / "work", tmp_path / "shared")
        settings = {"formats": ("glb", *settings.pop("formats", ())), **settings}
        asset = run(field, None, mesh, views, config=ExportConfig(**settings), ctx=ctx)
        return asset, ctx.events

    return make


@pytest.mark.parametrize("kind", KINDS)
def test_usd_of_every_kind_is_checked_and_lies_beside_its_pictures(make, kind):
    pytest.importorskip("pxr")
    asset, _ = make(KINDS[kind](), formats=("usdc", "usdz"))
    assert {"asset.glb", "asset.usdc", "asset.usdz", "environment.exr"} <= set(asset.files)
    pictures = {name for name in asset.files if name.startswith("textures/")}
    has_texture = kind in ("textured", "partly constant")
    names = {f"textures/{name}.png" for name in ("basecolor", "orm", "normal")}
    assert pictures == (names if has_texture else set())


def test_a_package_that_reads_back_wrong_is_not_published(make, monkeypatch):
    pytest.importorskip("pxr")

    def upside_down(mesh, name):
        return usdz_bytes(type(mesh)(**vars(mesh) | {"uv": 1.0 - mesh.uv}), name=name)

    monkeypatch.setattr(export_formats, "usdz_bytes", upside_down)
    with pytest.raises(RuntimeError, match=r"asset.usdz reads back with uv off by"):
        make(textured_mesh(), formats=("usdz",))


def test_a_smaller_file_that_reads_back_wrong_is_not_published(make, monkeypatch):
    def moved(mesh, compression, name):
        return small_glb_bytes(
            type(mesh)(**vars(mesh) | {"vertices": mesh.vertices + 1e-3}), compression, name=name
        )

    monkeypatch.setattr(export_formats, "small_glb_bytes", moved)
    with pytest.raises(RuntimeError, match=r"asset_small.glb reads back with positions off"):
        make(textured_mesh(), compression="quantised")


def test_textures_alone(make):
    asset, events = make(textured_mesh(), formats=("textures",))
    wanted = {"basecolor", "orm", "occlusion", "roughness", "metallic", "normal"}
    assert {name for name in asset.files if "/" in name} == {f"textures/{n}.png" for n in wanted}
    assert not events
    _, events = make(painted_mesh(), formats=("textures",))
    assert [event["kind"] for event in events] == ["no_textures"]


def test_layers_are_an_orbit_of_the_asset(make, given, tmp_path):
    asset, _ = make(textured_mesh(offset=(0.0, 0.0, 0.0)), formats=("aov",))
    folder = tmp_path / "saved"
    folder.mkdir()
    asset.save(folder)
    assert ExportedAsset.load(folder) == asset
    seen = MaterialViews.load(folder / "aov")
    assert torch.allclose(seen.cameras.c2w, given.cameras.c2w)
    assert seen.reference == given.reference
    assert torch.allclose(seen.confidence, given.confidence, atol=1e-3)
    inside = seen.mask[..., 0] > 0.999
    assert 0.02 < inside.float().mean() < 0.9
    assert torch.allclose(seen.normal_world[inside].norm(dim=-1), torch.ones(1), atol=1e-3)
    # Depth and pixels lead back to the surface: each point lies on a plane of the tetrahedron.
    cameras = seen.cameras
    pixels = torch.arange(cameras.height * cameras.width)
    directions = cameras.pixel_directions(pixels)
    for view in range(len(cameras)):
        local = directions / -directions[:, 2:] * seen.depth[view].reshape(-1, 1)
        points = local @ cameras.c2w[view, :3, :3].T + cameras.positions[view]
        points = points[inside[view].flatten()]
        planes = torch.tensor([[1.0, 1, -1], [1, -1, 1], [-1, 1, 1], [-1, -1, -1]])
        heights = (points @ planes.T).amax(1)
        # Pixels across an edge mix two faces: most, not all, are on the surface.
        assert (heights - 0.4).abs().median() < 2e-3


def test_layers_say_what_they_hold(make, tmp_path, given):
    asset, _ = make(textured_mesh(), formats=("aov",))
    file = tmp_path / "000.exr"
    file.write_bytes(asset.files["aov/000.exr"])
    wanted = {"R", "G", "B", "A", "basecolor.R", "roughness.V", "metallic.V", "normal.X"}
    assert wanted | {"depth.Z", "confidence.V"} <= set(read_exr(file))
    said = read_exr_attributes(file)
    assert said["colorInteropID"] == "lin_rec709_scene"
    assert said["chromaticities"][:2] == pytest.approx((0.64, 0.33))
    assert "scene-linear" in said["comments"]
    # Row vectors: the camera's centre goes to the origin.
    centre = torch.cat([given.cameras.positions[0], torch.ones(1)])
    seen = centre @ torch.from_numpy(said["worldToCamera"].copy())
    assert torch.allclose(seen, torch.tensor([0.0, 0.0, 0.0, 1.0]), atol=1e-5)


def test_a_missing_library_is_told_before_anything_is_computed(monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(ValidationError, match=r"pip install 'svim3d\[usd\]'"):
        ExportConfig(formats=("glb", "usdz"))
    with pytest.raises(ValidationError, match=r"pip install 'svim3d\[draco\]'"):
        ExportConfig(compression="draco")
