import io
import json
import os
import struct
import subprocess
from pathlib import Path

import numpy as np
import pygltflib
import pytest
import torch
import trimesh
from PIL import Image

from svim3d.io.glb import glb_bytes, read_mesh, reopen_glb

VALIDATE = """
const validator = require(process.argv[1]);
const bytes = new Uint8Array(require('fs').readFileSync(0));
validator.validateBytes(bytes).then(report => console.log(JSON.stringify(report.issues)));
"""


def quad(size=8):
    """A square in the xy plane with textures that differ in every channel and corner."""
    generator = torch.Generator().manual_seed(0)
    steps = torch.randint(0, 256, (2, size, size, 3), generator=generator).float() / 255
    normal = torch.nn.functional.normalize(
        torch.rand(size, size, 3, generator=generator) - torch.tensor([0.5, 0.5, -0.5]), dim=-1
    )
    return {
        "vertices": torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]),
        "faces": torch.tensor([[0, 1, 2], [0, 2, 3]], dtype=torch.int32),
        "normals": torch.tensor([[0.0, 0, 1]]).repeat(4, 1),
        "uv": torch.tensor([[0.0, 1], [1, 1], [1, 0], [0, 0]]),
        "tangents": torch.tensor([[1.0, 0, 0, 1]]).repeat(4, 1),
        "basecolor": steps[0],
        "orm": steps[1],
        "normal_tangent": normal,
    }


def painted():
    asset = quad()
    for name in ("uv", "tangents", "normal_tangent"):
        del asset[name]
    generator = torch.Generator().manual_seed(1)
    asset["basecolor"] = torch.rand(4, 3, generator=generator)
    asset["orm"] = torch.rand(4, 3, generator=generator)
    return asset


def document_of(content):
    length = struct.unpack_from("<I", content, 12)[0]
    return json.loads(content[20 : 20 + length]), content[28 + length :]


def test_trimesh_reads_back_what_was_written():
    asset = quad()
    found = reopen_glb(glb_bytes(**asset))
    assert torch.equal(found.vertices, asset["vertices"])
    assert torch.equal(found.faces, asset["faces"].long())
    assert torch.allclose(found.uv, asset["uv"], atol=1e-6)
    assert torch.allclose(found.orm, asset["orm"], atol=1e-6)
    assert (found.normal_tangent - asset["normal_tangent"]).abs().max() <= 1.01 / 255


def test_basecolor_is_stored_with_the_srgb_curve_and_orm_without():
    asset = quad(2)
    asset["basecolor"] = torch.full((2, 2, 3), 0.215861)  # IEC 61966-2-1: 128/255 encoded
    asset["orm"] = torch.tensor([1.0, 0.25, 0.75]).expand(2, 2, 3)
    scene = trimesh.load(io.BytesIO(glb_bytes(**asset)), file_type="glb", force="scene")
    (mesh,) = scene.geometry.values()
    colors = np.asarray(mesh.visual.material.baseColorTexture)
    assert set(colors[..., :3].reshape(-1)) == {128}
    orm = np.asarray(mesh.visual.material.metallicRoughnessTexture)[0, 0, :3]
    assert orm.tolist() == [255, 64, 191]  # occlusion, roughness, metallic


def test_pygltflib_finds_attributes_materials_and_sampler():
    asset = quad()
    document = pygltflib.GLTF2.load_from_bytes(glb_bytes(**asset))
    primitive = document.meshes[0].primitives[0]
    accessor = document.accessors[primitive.attributes.TANGENT]
    view = document.bufferViews[accessor.bufferView]
    stored = document.binary_blob()[view.byteOffset : view.byteOffset + view.byteLength]
    assert np.frombuffer(stored, "<f4").reshape(-1, 4).tolist() == asset["tangents"].tolist()
    material = document.materials[0]
    shading = material.pbrMetallicRoughness
    assert shading.metallicRoughnessTexture.index == material.occlusionTexture.index
    assert shading.baseColorTexture.index != material.normalTexture.index
    assert document.asset.generator == "svim3d"


def test_own_reader_returns_the_same_materials(tmp_path):
    asset = quad()
    file = tmp_path / "asset.glb"
    file.write_bytes(glb_bytes(**asset))
    mesh = read_mesh(file)
    material = mesh.materials[0]
    assert torch.equal(mesh.vertices, asset["vertices"])
    assert torch.equal(mesh.tangents, asset["tangents"])
    assert torch.equal(mesh.uv, asset["uv"])
    step = np.diff(np.linspace(0, 1, 256)).max()  # one step of the curve is widest near white
    assert (material.basecolor - asset["basecolor"]).abs().max() < 1.2 * step
    assert torch.allclose(material.roughness_metallic, asset["orm"][..., 1:], atol=1e-6)
    assert torch.nn.functional.cosine_similarity(
        material.normal_tangent, asset["normal_tangent"], dim=-1
    ).min() > np.cos(0.01)


def test_vertex_colours_stay_linear_and_factors_are_means():
    asset = painted()
    content = glb_bytes(**asset)
    assert torch.equal(reopen_glb(content).basecolor, asset["basecolor"])
    shading = document_of(content)[0]["materials"][0]["pbrMetallicRoughness"]
    assert shading["roughnessFactor"] == pytest.approx(float(asset["orm"][:, 1].mean()))
    assert shading["metallicFactor"] == pytest.approx(float(asset["orm"][:, 2].mean()))


def test_equal_input_gives_equal_bytes_and_no_occlusion_is_named_where_there_is_none():
    asset = quad()
    assert glb_bytes(**asset) == glb_bytes(**asset)
    asset["orm"][..., 0] = 1.0
    assert "occlusionTexture" not in document_of(glb_bytes(**asset))[0]["materials"][0]


def test_many_vertices_take_wide_indices():
    asset = painted()
    asset |= {name: asset[name].repeat(20_000, 1) for name in ("vertices", "normals")}
    asset |= {name: asset[name].repeat(20_000, 1) for name in ("basecolor", "orm")}
    asset["faces"] = torch.tensor([[79_997, 79_998, 79_999]])
    assert torch.equal(reopen_glb(glb_bytes(**asset)).faces, asset["faces"])


def test_a_normal_map_without_tangents_is_refused():
    asset = quad() | {"tangents": None}
    with pytest.raises(ValueError, match="go together"):
        glb_bytes(**asset)


def constant():
    """A square of one material, without texture coordinates."""
    asset = painted()
    asset["basecolor"] = torch.tensor([0.8, 0.4, 0.123456])
    asset["orm"] = torch.tensor([1.0, 0.31, 0.75])
    return asset


def sparse():
    """A palette for the colour, factors for what does not vary, no normal map."""
    asset = quad()
    del asset["tangents"], asset["normal_tangent"]
    columns = torch.arange(8) < 3
    asset["basecolor"] = torch.where(columns[None, :, None], 0.2, torch.tensor([0.9, 0.5, 0.1]))
    asset["basecolor"] = asset["basecolor"].expand(8, 8, 3).contiguous()
    asset["orm"] = torch.ones(4, 4, 3)
    asset["orm"][:2, :, 2] = 0.0
    asset["orm_factor"] = torch.tensor([1.0, 0.4567, 1.0])
    return asset


def test_one_value_becomes_factors_and_no_texture():
    asset = constant()
    content = glb_bytes(**asset)
    document = document_of(content)[0]
    assert not {"textures", "images", "samplers"} & set(document)
    assert set(document["meshes"][0]["primitives"][0]["attributes"]) == {"POSITION", "NORMAL"}
    shading = document["materials"][0]["pbrMetallicRoughness"]
    assert shading["baseColorFactor"] == [*asset["basecolor"].tolist(), 1.0]
    assert shading["roughnessFactor"] == pytest.approx(0.31)
    assert shading["metallicFactor"] == 0.75
    found = reopen_glb(content)
    assert found.uv is None
    assert (found.basecolor - asset["basecolor"]).abs().max() <= 0.51 / 255  # trimesh rounds
    assert torch.allclose(found.orm, asset["orm"])


def test_factors_stand_beside_textures_of_what_varies(tmp_path):
    asset = sparse()
    content = glb_bytes(**asset)
    shading = document_of(content)[0]["materials"][0]["pbrMetallicRoughness"]
    assert shading["roughnessFactor"] == pytest.approx(0.4567)
    assert "metallicFactor" not in shading  # 1, beside its texture
    assert "baseColorFactor" not in shading
    assert "occlusionTexture" not in document_of(content)[0]["materials"][0]
    assert torch.allclose(reopen_glb(content).orm, asset["orm"] * asset["orm_factor"])
    (tmp_path / "asset.glb").write_bytes(content)
    material = read_mesh(tmp_path / "asset.glb").materials[0]
    assert material.roughness_factor == pytest.approx(0.4567)
    assert torch.equal(material.roughness_metallic, asset["orm"][..., 1:])
    assert (material.basecolor - asset["basecolor"]).abs().max() < 0.01


def test_few_colours_are_stored_as_indices():
    noisy, few = quad(64), quad(64)
    for asset in (noisy, few):
        asset["orm_factor"] = torch.ones(3)
    few["basecolor"] = (few["basecolor"] > 0.5).float()
    content = glb_bytes(**few)
    document, binary = document_of(content)
    stored = {}
    for image in document["images"]:
        view = document["bufferViews"][image["bufferView"]]
        start = view["byteOffset"]
        stored[image["name"]] = Image.open(io.BytesIO(binary[start : start + view["byteLength"]]))
    assert stored["basecolor"].mode == "P"
    assert stored["orm"].mode == "RGB"
    assert torch.equal(reopen_glb(content).basecolor, few["basecolor"])
    assert glb_bytes(**few) == content
    assert len(content) < len(glb_bytes(**noisy)) - 9000  # 3 of 8 x 3 bits of 4096 texels


def test_what_no_material_can_mean_is_refused():
    with pytest.raises(ValueError, match="give both or neither"):
        glb_bytes(**constant() | {"uv": quad()["uv"]})
    textured = {name: quad()[name] for name in ("basecolor", "orm")}
    with pytest.raises(ValueError, match="give both or neither"):
        glb_bytes(**constant() | textured)
    with pytest.raises(ValueError, match="occlusion needs a texture"):
        glb_bytes(**constant() | {"orm": torch.tensor([0.5, 0.5, 0.5])})


@pytest.mark.parametrize(
    "asset",
    [quad(), painted(), constant(), sparse()],
    ids=["textured", "painted", "constant", "sparse"],
)
@pytest.mark.skipif("GLTF_VALIDATOR" not in os.environ, reason="path of the node module not set")
def test_khronos_validator_has_nothing_to_remark(asset):
    report = subprocess.run(
        ["node", "-e", VALIDATE, os.environ["GLTF_VALIDATOR"]],
        input=glb_bytes(**asset),
        stdout=subprocess.PIPE,
        check=True,
    )
    issues = json.loads(report.stdout)
    assert issues["numErrors"] == issues["numWarnings"] == 0, issues["messages"]


def test_unreadable_meshes_are_named(tmp_path):
    with pytest.raises(ValueError, match="no mesh file"):
        read_mesh(tmp_path / "absent.glb")
    with pytest.raises(ValueError, match="wanted one of"):
        read_mesh(tmp_path / "photo.png")
    cut = tmp_path / "cut.glb"
    cut.write_bytes(glb_bytes(**quad())[:-100])
    with pytest.raises(ValueError, match="cut short"):
        read_mesh(cut)
    broken = quad()
    broken["vertices"][1, 1] = torch.nan
    nan = tmp_path / "nan.glb"
    nan.write_bytes(glb_bytes(**broken).replace(b'"min":[0.0,NaN', b'"min":[0.0,0.0'))
    with pytest.raises(ValueError, match="NaN or infinite"):
        read_mesh(nan)


@pytest.mark.skipif("SVIM3D_DATA" not in os.environ, reason="real assets are not part of the tests")
@pytest.mark.parametrize("name", ["BoomBox_2k", "EgyptianCat_1k", "ExplodingBarrel_1k"])
def test_real_assets_survive_the_round_trip(name):
    mesh = read_mesh(Path(os.environ["SVIM3D_DATA"]) / "glb" / f"{name}.glb")
    material = mesh.materials[0]
    orm = torch.nn.functional.pad(material.roughness_metallic, (1, 0), value=1.0)
    found = reopen_glb(
        glb_bytes(
            vertices=mesh.vertices,
            faces=mesh.faces,
            normals=mesh.normals,
            uv=mesh.uv,
            tangents=mesh.tangents,
            basecolor=material.basecolor,
            orm=orm,
            normal_tangent=material.normal_tangent,
        )
    )
    assert torch.equal(found.vertices, mesh.vertices)
    assert torch.equal(found.basecolor, material.basecolor)
    assert torch.equal(found.orm, orm)
