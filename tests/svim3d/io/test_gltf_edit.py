import io
import json
import struct

import pygltflib
import pytest
import torch
import trimesh

from svim3d.io.glb import glb_bytes, read_mesh
from svim3d.io.gltf_edit import edit_glb
from svim3d.shading.material_edits import Edit, apply_edits

QUAD = torch.tensor([[-0.5, -0.5, 0.0], [0.5, -0.5, 0], [0.5, 0.5, 0], [-0.5, 0.5, 0]])
FACES = torch.tensor([[0, 1, 2], [0, 2, 3]])
UV = torch.tensor([[0.0, 1.0], [1, 1], [1, 0], [0, 0]])
LEVEL = 1.0 / 255.0


def textured() -> bytes:
    generator = torch.Generator().manual_seed(0)
    return glb_bytes(
        vertices=QUAD,
        faces=FACES,
        normals=torch.tensor([0.0, 0, 1]).expand(4, 3),
        uv=UV,
        basecolor=torch.rand(8, 8, 3, generator=generator) * 0.5 + 0.2,
        orm=torch.rand(8, 8, 3, generator=generator) * 0.5 + 0.2,
    )


def plain() -> bytes:
    """A quad whose material is factors alone."""
    document, binary = split(
        glb_bytes(
            vertices=QUAD,
            faces=FACES,
            normals=torch.tensor([0.0, 0, 1]).expand(4, 3),
            basecolor=torch.ones(4, 3),
            orm=torch.tensor([1.0, 0.5, 0.25]).expand(4, 3),
        )
    )
    document["materials"][0]["pbrMetallicRoughness"]["baseColorFactor"] = [0.4, 0.3, 0.2, 0.7]
    return join(document, binary)


def split(content: bytes) -> tuple[dict, bytes]:
    length = struct.unpack_from("<I", content, 12)[0]
    return json.loads(content[20 : 20 + length]), content[28 + length :]


def join(document: dict, binary: bytes) -> bytes:
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    body = struct.pack("<I4s", len(text), b"JSON") + text
    body += struct.pack("<I4s", len(binary), b"BIN\0") + binary
    return b"glTF" + struct.pack("<II", 2, 12 + len(body)) + body


def material(content: bytes, tmp_path):
    file = tmp_path / "asset.glb"
    file.write_bytes(content)
    return read_mesh(file).materials[0]


def images(content: bytes, tmp_path) -> dict[str, torch.Tensor]:
    read = material(content, tmp_path)
    roughness, metallic = read.roughness_metallic.split(1, -1)
    return {
        "basecolor": read.basecolor * torch.tensor(read.basecolor_factor),
        "roughness": roughness * read.roughness_factor,
        "metallic": metallic * read.metallic_factor,
    }


@pytest.mark.parametrize(
    "texts",
    [["roughness*0.5"], ["roughness*1.5", "metallic*0.5"], ["basecolor=#aa3311", "metallic=1"]],
)
def test_textures_show_what_the_edits_say(tmp_path, texts):
    edits = [Edit.parse(text) for text in texts]
    wanted, _ = apply_edits(images(textured(), tmp_path), edits)
    found = images(edit_glb(textured(), edits)[0], tmp_path)
    torch.testing.assert_close(found["roughness"], wanted["roughness"], rtol=0, atol=LEVEL)
    torch.testing.assert_close(found["metallic"], wanted["metallic"], rtol=0, atol=LEVEL)
    # Eight bits of sRGB are at most 0.0046 of linear light apart.
    torch.testing.assert_close(found["basecolor"], wanted["basecolor"], rtol=0, atol=0.005)


def test_geometry_and_untouched_textures_keep_their_bytes():
    before, binary = split(textured())
    after, edited = split(edit_glb(textured(), [Edit.parse("roughness=0.1")])[0])
    assert after["accessors"] == before["accessors"] and after["meshes"] == before["meshes"]

    def content(document, blob, index):
        view = document["bufferViews"][index]
        return blob[view["byteOffset"] :][: view["byteLength"]]

    for accessor in before["accessors"]:
        index = accessor["bufferView"]
        assert content(before, binary, index) == content(after, edited, index)
    colours = [
        content(document, blob, document["images"][
            document["textures"][
                document["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]["index"]
            ]["source"]
        ]["bufferView"])
        for document, blob in ((before, binary), (after, edited))
    ]  # fmt: skip
    assert colours[0] == colours[1]


def test_replaced_images_leave_and_shared_occlusion_stays():
    after, _ = split(edit_glb(textured(), [Edit.parse("roughness=0.1")])[0])
    # The old roughness texture is still the occlusion's.
    occlusion = after["materials"][0]["occlusionTexture"]["index"]
    rough = after["materials"][0]["pbrMetallicRoughness"]["metallicRoughnessTexture"]["index"]
    assert occlusion != rough and len(after["images"]) == 3
    after, _ = split(edit_glb(textured(), [Edit.parse("basecolor+0.1")])[0])
    assert len(after["images"]) == 2
    assert all(view["byteLength"] > 0 for view in after["bufferViews"])


def test_pure_scales_change_factors_and_no_picture():
    before, binary = split(textured())
    edits = [
        Edit.parse("basecolor*#8080ff"),
        Edit.parse("roughness/2"),
        Edit.parse("roughness*0.5"),
    ]
    after, edited = split(edit_glb(textured(), edits)[0])
    assert edited == binary and after["images"] == before["images"]
    assert after["materials"][0]["pbrMetallicRoughness"]["roughnessFactor"] == 0.25
    # Half of it scales, half cannot: the picture is painted once.
    after, _ = split(
        edit_glb(textured(), [Edit.parse("roughness*2"), Edit.parse("metallic*0.5")])[0]
    )
    assert len(after["images"]) == 3


def test_factors_alone_stay_factors(tmp_path):
    edited, _ = edit_glb(plain(), [Edit.parse("basecolor*0.5"), Edit.parse("metallic=1")])
    shading = split(edited)[0]["materials"][0]["pbrMetallicRoughness"]
    assert shading["baseColorFactor"] == pytest.approx([0.2, 0.15, 0.1, 0.7])
    assert shading["roughnessFactor"] == pytest.approx(0.5)
    assert shading["metallicFactor"] == 1.0
    assert "baseColorTexture" not in shading


def test_regions_in_texture_space(tmp_path):
    before = images(textured(), tmp_path)
    region = torch.zeros(8, 8, 1)
    region[:4] = 1.0
    edited, _ = edit_glb(textured(), [Edit.parse("roughness=1")], lambda *_: region)
    found = images(edited, tmp_path)["roughness"]
    assert torch.equal(found[:4], torch.ones(4, 8, 1))
    torch.testing.assert_close(found[4:], before["roughness"][4:], rtol=0, atol=LEVEL)
    untouched, notices = edit_glb(textured(), [Edit.parse("roughness=1")], lambda *_: None)
    torch.testing.assert_close(images(untouched, tmp_path)["roughness"], before["roughness"])
    assert notices == []


def test_other_readers_open_the_result():
    edited, _ = edit_glb(textured(), [Edit.parse("basecolor=#102030"), Edit.parse("roughness*2")])
    scene = trimesh.load(io.BytesIO(edited), file_type="glb", force="scene")
    (mesh,) = scene.geometry.values()
    assert mesh.visual.material.baseColorTexture.convert("RGB").getpixel((3, 3)) == (16, 32, 48)
    assert len(pygltflib.GLTF2.load_from_bytes(edited).images) == 3


def test_messages_name_the_material():
    _, notices = edit_glb(textured(), [Edit.parse("roughness*10")])
    assert notices == ["asset: roughness*10: 64 pixels clamped to [0, 1]"]
    coloured, _ = split(plain())
    assert "COLOR_0" in coloured["meshes"][0]["primitives"][0]["attributes"]
    _, notices = edit_glb(plain(), [Edit.parse("basecolor=0.5")])
    assert notices[-1] == "vertex colours go on tinting the edited basecolor"


@pytest.mark.parametrize("content", [b"", b"{}", b"glTF" + bytes(20), textured()[:300]])
def test_no_glb_is_refused(content):
    with pytest.raises(ValueError, match=r"wanted a \.glb file|cut short"):
        edit_glb(content, [Edit.parse("metallic=1")])
