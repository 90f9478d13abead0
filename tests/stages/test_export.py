import dataclasses
import json
import os
import subprocess

import pytest
import torch
from pydantic import ValidationError
from sphere_views import of_one_material, sphere_views

from stages import export
from stages.artifacts import ExportedAsset, FittedField, TexturedMesh
from stages.base import Context
from stages.errors import InputError
from stages.export import EXPORT, run
from stages.finished_views import ViewFolder
from stages.settings.export import ExportConfig
from svim3d.fields.material_field import MaterialField, MaterialFieldSpec
from svim3d.fields.sdf_grid import node_positions
from svim3d.io.exr import read_rgb
from svim3d.io.glb import glb_bytes, read_mesh, reopen_glb
from svim3d.mesh.frames import tangent_frames
from svim3d.mesh.mesh import signed_volume

SPEC = MaterialFieldSpec(levels=2, log2_entries=10, coarsest=4, finest=8, hidden=8)


@pytest.fixture(scope="module")
def field():
    generator = torch.Generator().manual_seed(0)
    materials = MaterialField(SPEC)
    materials.reset(generator)
    state = materials.state_dict()
    state["network.second.weight"] = torch.randn(8, SPEC.hidden, generator=generator)
    for name, value in state.items():
        if "encoding" in name:
            state[name] = torch.randn(value.shape, generator=generator)
    sdf = 0.4 - node_positions(16, 0.55, like=torch.zeros(1)).norm(dim=-1)
    return FittedField(sdf, 0.55, SPEC, state, torch.full((8, 8, 3), 2.0))


@pytest.fixture(scope="module")
def textured():
    """A tetrahedron, one corner of the texture per face."""
    corners = torch.tensor([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) * 0.4
    faces = torch.tensor([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]])
    vertices = corners[faces.reshape(-1)]
    faces = torch.arange(12).view(4, 3)
    normals = torch.nn.functional.normalize(vertices, dim=1)
    inner = torch.tensor([[0.05, 0.05], [0.45, 0.05], [0.05, 0.45]])
    offsets = torch.tensor([[0.0, 0], [0.5, 0], [0, 0.5], [0.5, 0.5]])
    uv = (inner[None] + offsets[:, None]).reshape(-1, 2)
    generator = torch.Generator().manual_seed(0)
    maps = torch.rand(2, 16, 16, 3, generator=generator)
    return TexturedMesh(
        vertices=vertices,
        faces=faces,
        normals=normals,
        uv=uv,
        tangents=tangent_frames(vertices, faces, normals, uv).tangents,
        basecolor=maps[0],
        orm=maps[1],
        normal_tangent=torch.tensor([0.0, 0.6, 0.8]).expand(16, 16, 3),
    )


@pytest.fixture(scope="module")
def views(tmp_path_factory):
    """Three views that the asset is said to come of."""
    folder = tmp_path_factory.mktemp("views")
    sphere_views(of_one_material, views=3, size=24).save(folder)
    return ViewFolder.load(folder)


@pytest.fixture
def ctx(tmp_path):
    return Context("export", torch.device("cpu"), 0, tmp_path / "work", tmp_path / "shared")


def test_textured_mesh_becomes_a_checked_glb(field, textured, ctx, views):
    asset = run(field, None, textured, views, config=ExportConfig(), ctx=ctx)
    assert set(asset.files) == {"asset.glb", "environment.exr"}
    found = reopen_glb(asset.files["asset.glb"])
    assert torch.equal(found.vertices, textured.vertices)
    assert (found.orm - textured.orm).abs().max() <= 0.51 / 255
    assert asset.summary["faces"] == 4
    assert asset.summary["vertices"] == 12
    assert asset.summary["watertight"] is True
    assert asset.summary["atlas_overlaps"] == 0
    assert asset.summary["glb_bytes"] == len(asset.files["asset.glb"])
    assert asset == run(field, None, textured, views, config=ExportConfig(), ctx=ctx)


def test_obj_holds_the_same_mesh(field, textured, ctx, tmp_path, views):
    config = ExportConfig(formats=("glb", "obj"))
    asset = run(field, None, textured, views, config=config, ctx=ctx)
    folder = tmp_path / "saved"
    folder.mkdir()
    asset.save(folder)
    assert ExportedAsset.load(folder) == asset
    glb, obj = (read_mesh(folder / f"asset.{kind}") for kind in ("glb", "obj"))
    assert len(glb.faces) == len(obj.faces)
    assert torch.allclose(glb.vertices.amax(0), obj.vertices.amax(0))
    assert torch.equal(glb.materials[0].basecolor, obj.materials[0].basecolor)
    assert torch.equal(glb.materials[0].roughness_metallic, obj.materials[0].roughness_metallic)


def test_without_phase_3_vertices_carry_the_field(field, ctx, views):
    config = ExportConfig(vertex_color_faces=500)
    asset = run(field, None, None, views, config=config, ctx=ctx)
    found = reopen_glb(asset.files["asset.glb"])
    truth = field.own_surface().material_field(torch.device("cpu"))(found.vertices)
    assert torch.allclose(found.basecolor, truth.basecolor, atol=1e-6)
    assert truth.basecolor.std() > 0.05
    assert asset.summary["materials"] == "vertex"
    assert asset.summary["watertight"] is True
    assert asset.summary["faces"] <= 525
    assert float(signed_volume(found.vertices, found.faces)) == pytest.approx(0.268, rel=0.05)


def test_environment_is_that_of_the_last_phase(field, textured, ctx, tmp_path, views):
    surface = dataclasses.replace(field.own_surface(), environment=torch.full((8, 8, 3), 5.0))
    file = tmp_path / "environment.exr"
    for fitted, value in ((None, 2.0), (surface, 5.0)):
        asset = run(field, fitted, textured, views, config=ExportConfig(), ctx=ctx)
        file.write_bytes(asset.files["environment.exr"])
        assert read_rgb(file) == pytest.approx(value)


def test_a_glb_that_reads_back_wrong_is_not_published(field, textured, ctx, monkeypatch, views):
    def swapped(**parts):
        return glb_bytes(**parts | {"orm": parts["orm"].flip(-1)})  # a classic: channel order

    monkeypatch.setattr(export, "glb_bytes", swapped)
    with pytest.raises(RuntimeError, match="orm off by"):
        run(field, None, textured, views, config=ExportConfig(), ctx=ctx)


def test_nothing_to_export_is_an_input_error(field, textured, ctx, views):
    empty = dataclasses.replace(textured, faces=torch.zeros(0, 3, dtype=torch.int64))
    with pytest.raises(InputError, match="without faces"):
        run(field, None, empty, views, config=ExportConfig(), ctx=ctx)
    hollow = dataclasses.replace(field, sdf=-torch.ones(8, 8, 8))
    with pytest.raises(InputError, match="wanted a surface"):
        run(hollow, None, None, views, config=ExportConfig(), ctx=ctx)
    with pytest.raises(ValidationError, match='must contain "glb"'):
        ExportConfig(formats=("obj",))


@pytest.mark.skipif("GLTF_VALIDATOR" not in os.environ, reason="path of the node module not set")
@pytest.mark.parametrize("skip", [False, True], ids=["textured", "painted"])
def test_khronos_validator_has_nothing_to_remark(field, textured, ctx, skip, views):
    program = (
        "require(process.argv[1]).validateBytes(new Uint8Array(require('fs').readFileSync(0)))"
        ".then(report => console.log(JSON.stringify(report.issues)))"
    )
    asset = run(field, None, None if skip else textured, views, config=ExportConfig(), ctx=ctx)
    report = subprocess.run(
        ["node", "-e", program, os.environ["GLTF_VALIDATOR"]],
        input=asset.files["asset.glb"],
        stdout=subprocess.PIPE,
        check=True,
    )
    issues = json.loads(report.stdout)
    assert issues["numErrors"] == issues["numWarnings"] == 0, issues["messages"]


def test_inputs_match_the_pipeline():
    assert list(EXPORT.inputs) == ["field", "surface", "textured", "views"]
    assert EXPORT.output is ExportedAsset
