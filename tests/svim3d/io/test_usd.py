import io
import zipfile
from dataclasses import replace

import pytest
import torch
from painted_meshes import KINDS, constant_mesh, painted_mesh, partly_constant_mesh, textured_mesh

from svim3d.color import srgb_from_linear
from svim3d.io.image import decode_image
from svim3d.io.texture_files import texture_files
from svim3d.io.usd import reopen_usdz, usd_files, usdz_bytes

pytest.importorskip("pxr")
from pxr import Gf, Usd, UsdGeom, UsdShade, UsdValidation

STEP = 0.51 / 255  # half a step of 8 bits


@pytest.fixture(scope="module", params=KINDS)
def package(request, tmp_path_factory):
    mesh = KINDS[request.param]()
    content = usdz_bytes(mesh)
    file = tmp_path_factory.mktemp("usd") / "asset.usdz"
    file.write_bytes(content)
    return mesh, content, file


def test_every_validator_of_openusd_is_content(package):
    registry = UsdValidation.ValidationRegistry()
    context = UsdValidation.ValidationContext(registry.GetOrLoadAllValidators())
    found = context.Validate(Usd.Stage.Open(str(package[2])))
    assert [(error.GetName(), error.GetMessage()) for error in found] == []


def test_validators_would_find_a_fault(tmp_path):
    # The test above must be able to fail.
    stage = Usd.Stage.CreateNew(str(tmp_path / "bad.usda"))
    UsdShade.Shader.Define(stage, "/lonely").CreateIdAttr("UsdUVTexture")
    registry = UsdValidation.ValidationRegistry()
    context = UsdValidation.ValidationContext(registry.GetOrLoadAllValidators())
    assert context.Validate(stage)


def test_package_is_stored_aligned_and_led_by_the_stage(package):
    content = package[1]
    with zipfile.ZipFile(io.BytesIO(content)) as entries:
        names = entries.namelist()
        assert names[0] == "asset.usdc"
        assert all(name.startswith("textures/") for name in names[1:])
        for entry in entries.infolist():
            assert entry.compress_type == zipfile.ZIP_STORED
            header = content[entry.header_offset :][:30]
            name, extra = (int.from_bytes(header[at : at + 2], "little") for at in (26, 28))
            assert (entry.header_offset + 30 + name + extra) % 64 == 0
        assert entries.testzip() is None


def test_equal_assets_give_equal_bytes(package):
    assert usdz_bytes(package[0]) == package[1]


def test_geometry_reads_back_exactly(package):
    mesh, content, file = package
    found = reopen_usdz(content)
    assert torch.equal(found.vertices, mesh.vertices)
    assert torch.equal(found.faces.long(), mesh.faces.long())
    assert torch.equal(found.normals, mesh.normals)
    stage = Usd.Stage.Open(str(file))
    assert UsdGeom.GetStageUpAxis(stage) == "Y"
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    bounds = UsdGeom.BBoxCache(0, ["default"]).ComputeWorldBound(stage.GetDefaultPrim())
    low = Gf.Vec3d(*mesh.vertices.amin(0).double().tolist())
    assert Gf.IsClose(bounds.GetRange().GetMin(), low, 1e-6)


def test_textures_read_back_in_their_spaces():
    mesh = textured_mesh()
    found = reopen_usdz(usdz_bytes(mesh))
    assert torch.allclose(found.uv, mesh.uv, atol=1e-7)
    error = srgb_from_linear(found.basecolor) - srgb_from_linear(mesh.basecolor)
    assert error.abs().max() <= STEP
    for name, channel in (("occlusion", 0), ("roughness", 1), ("metallic", 2)):
        plane = getattr(found, name)[..., 0]
        assert (plane - mesh.orm[..., channel]).abs().max() <= STEP
    assert (found.normal_tangent - mesh.normal_tangent).abs().max() <= 2 * STEP


def test_v_points_up_in_the_file(tmp_path):
    mesh = textured_mesh()
    (tmp_path / "asset.usdc").write_bytes(usd_files(mesh)["asset.usdc"])
    stage = Usd.Stage.Open(str(tmp_path / "asset.usdc"))
    st = UsdGeom.PrimvarsAPI(stage.GetPrimAtPath("/asset/mesh")).GetPrimvar("st").Get()
    assert st[0] == pytest.approx((0.05, 0.95))


def test_constants_become_inputs_without_pictures():
    files = usd_files(constant_mesh())
    assert set(files) == {"asset.usdc"}
    found = reopen_usdz(usdz_bytes(constant_mesh()))
    assert found.basecolor.tolist() == pytest.approx([1.0, 0.71, 0.29])
    assert float(found.roughness) == pytest.approx(0.3)
    assert float(found.metallic) == float(found.occlusion) == 1.0


def test_a_constant_channel_is_not_read_from_the_picture():
    mesh = partly_constant_mesh()
    found = reopen_usdz(usdz_bytes(mesh))
    assert float(found.metallic) == 0.25
    assert float(found.occlusion) == 1.0
    assert (found.roughness[..., 0] - mesh.orm[..., 1]).abs().max() <= STEP


def test_vertices_carry_their_colour():
    mesh = painted_mesh()
    found = reopen_usdz(usdz_bytes(mesh))
    assert torch.equal(found.basecolor, mesh.basecolor)
    assert float(found.roughness) == pytest.approx(float(mesh.orm[:, 1].mean()))


def test_an_independent_reader_finds_the_same(tmp_path):
    tinyusdz = pytest.importorskip("tinyusdz")
    mesh = textured_mesh()
    (tmp_path / "asset.usdz").write_bytes(usdz_bytes(mesh))
    scene = tinyusdz.tydra.convert_to_render_scene(tinyusdz.load(str(tmp_path / "asset.usdz")))
    (shape,) = scene.meshes()
    points = torch.frombuffer(bytearray(memoryview(shape.points)), dtype=torch.float32)
    assert torch.equal(points.view(-1, 3), mesh.vertices)
    names = {picture.asset_identifier for picture in scene.images()}
    assert names == {f"textures/{name}.png" for name in ("basecolor", "orm", "normal")}


def test_texture_files_hold_each_map():
    mesh = partly_constant_mesh()
    files = texture_files(mesh)
    pictures = {name.removeprefix("textures/"): decode_image(f) for name, f in files.items()}
    assert pictures["metallic.png"].shape == (1, 1, 1)
    assert float(pictures["metallic.png"]) == pytest.approx(0.25, abs=STEP)
    assert torch.equal(pictures["roughness.png"][..., 0], pictures["orm.png"][..., 1])
    wanted = srgb_from_linear(mesh.basecolor)
    assert (pictures["basecolor.png"] - wanted).abs().max() <= STEP
    assert (pictures["normal.png"] * 2 - 1 - mesh.normal_tangent).abs().max() <= 2 * STEP
    assert texture_files(painted_mesh()) == {}
    flat = replace(mesh, normal_tangent=None, tangents=None)
    assert "textures/normal.png" not in texture_files(flat)
