import base64
import io
import json
import os
import struct
import subprocess

import pygltflib
import pytest
import torch
import trimesh

from svim3d.io.glb import glb_bytes, read_mesh
from svim3d.io.gltf_edit import edit_glb
from svim3d.io.image import decode_image, encode_png
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
    ones = torch.ones(8, 8, 3)
    stored = ones[..., :2] if read.roughness_metallic is None else read.roughness_metallic
    roughness, metallic = stored.split(1, -1)
    colour = ones if read.basecolor is None else read.basecolor
    return {
        "basecolor": colour * torch.tensor(read.basecolor_factor),
        "roughness": roughness * read.roughness_factor,
        "metallic": metallic * read.metallic_factor,
    }


@pytest.mark.parametrize(
    "texts",
    [
        ["roughness*0.5"],
        ["roughness*1.5", "metallic*0.5"],
        ["basecolor=#aa3311", "metallic=1"],
        ["roughness=0.3", "metallic=0"],
        ["roughness=0.3", "metallic+0.1"],
        ["basecolor*#ff8040", "basecolor-0.01"],
    ],
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
    assert after["meshes"] == before["meshes"] and after["nodes"] == before["nodes"]

    def content(document, blob, index):
        view = document["bufferViews"][index]
        return blob[view["byteOffset"] :][: view["byteLength"]]

    for old, new in zip(before["accessors"], after["accessors"], strict=True):
        views = old.pop("bufferView"), new.pop("bufferView")
        assert old == new
        assert content(before, binary, views[0]) == content(after, edited, views[1])
    colours = [
        content(document, blob, document["images"][
            document["textures"][
                document["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]["index"]
            ]["source"]
        ]["bufferView"])
        for document, blob in ((before, binary), (after, edited))
    ]  # fmt: skip
    assert colours[0] == colours[1]


def stored_orm(content: bytes, slot: str) -> torch.Tensor:
    """Occlusion, roughness and metallic as a slot of the material stores them."""
    document, blob = split(content)
    material = document["materials"][0]
    holder = material["pbrMetallicRoughness"] if slot.startswith("metallic") else material
    source = document["textures"][holder[slot]["index"]]["source"]
    view = document["bufferViews"][document["images"][source]["bufferView"]]
    return decode_image(blob[view["byteOffset"] :][: view["byteLength"]])


def test_replaced_images_leave_and_occlusion_moves_to_the_new_one():
    edited, _ = edit_glb(textured(), [Edit.parse("roughness+0.1")])
    after, _ = split(edited)
    assert len(after["images"]) == len(after["textures"]) == 2
    old = stored_orm(textured(), "occlusionTexture")
    assert torch.equal(stored_orm(edited, "occlusionTexture")[..., 0], old[..., 0])
    assert torch.equal(stored_orm(edited, "metallicRoughnessTexture")[..., 2], old[..., 2])
    assert all(view["byteLength"] > 0 for view in after["bufferViews"])


def test_constants_become_factors_and_occlusion_keeps_its_texture():
    edits = [Edit.parse(text) for text in ("roughness=0.1", "metallic=1", "basecolor=#aa3311")]
    edited, _ = edit_glb(textured(), edits)
    document, _ = split(edited)
    shading = document["materials"][0]["pbrMetallicRoughness"]
    assert set(shading) == {"baseColorFactor", "roughnessFactor", "metallicFactor"}
    assert len(document["images"]) == 1
    old = stored_orm(textured(), "occlusionTexture")
    assert torch.equal(stored_orm(edited, "occlusionTexture"), old)


def test_opacity_that_shows_keeps_its_texture():
    document, binary = split(textured())
    png = encode_png(torch.rand(8, 8, 4, generator=torch.Generator().manual_seed(3)), srgb=True)
    document["images"][0] = {"uri": f"data:image/png;base64,{base64.b64encode(png).decode()}"}
    opaque, _ = split(edit_glb(join(document, binary), [Edit.parse("basecolor=0.5")])[0])
    assert "baseColorTexture" not in opaque["materials"][0]["pbrMetallicRoughness"]
    document["materials"][0]["alphaMode"] = "BLEND"
    after, blob = split(edit_glb(join(document, binary), [Edit.parse("basecolor=0.5")])[0])
    shading = after["materials"][0]["pbrMetallicRoughness"]
    view = after["bufferViews"][
        after["images"][after["textures"][shading["baseColorTexture"]["index"]]["source"]][
            "bufferView"
        ]
    ]
    painted = decode_image(blob[view["byteOffset"] :][: view["byteLength"]])
    assert torch.equal(painted[..., 3], decode_image(png)[..., 3])
    assert shading["baseColorFactor"] == [0.5, 0.5, 0.5, 1.0]


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
    assert len(after["images"]) == 2


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
    assert torch.equal(found[4:], before["roughness"][4:])
    with pytest.raises(ValueError, match="meets no texel"):
        edit_glb(textured(), [Edit.parse("roughness=1")], lambda *_: None)


def test_other_readers_open_the_result():
    edited, _ = edit_glb(textured(), [Edit.parse("basecolor+0.1"), Edit.parse("roughness*2")])
    scene = trimesh.load(io.BytesIO(edited), file_type="glb", force="scene")
    (mesh,) = scene.geometry.values()
    assert mesh.visual.material.baseColorTexture.size == (8, 8)
    assert len(pygltflib.GLTF2.load_from_bytes(edited).images) == 2
    constant, _ = edit_glb(textured(), [Edit.parse("basecolor=0.25")])
    (mesh,) = trimesh.load(io.BytesIO(constant), file_type="glb", force="scene").geometry.values()
    assert mesh.visual.material.baseColorFactor[:3].tolist() == [64, 64, 64]


def test_textures_keep_their_own_sizes(tmp_path):
    fine, binary = split(textured())
    png = encode_png(torch.rand(2, 16, 3, generator=torch.Generator().manual_seed(4)))
    fine["images"][1] = {"uri": f"data:image/png;base64,{base64.b64encode(png).decode()}"}
    edits = [Edit.parse("roughness+0.1"), Edit.parse("basecolor+0.1"), Edit.parse("metallic=1")]
    sizes = []

    def mask_of(_, height, width):
        sizes.append((height, width))
        return torch.ones(height, width, 1)

    edited = material(edit_glb(join(fine, binary), edits, mask_of)[0], tmp_path)
    assert sorted(sizes) == [(2, 16), (8, 8)]
    assert edited.basecolor.shape == (8, 8, 3)
    assert edited.roughness_metallic.shape == (2, 16, 2)
    wanted = (decode_image(png)[..., 1] + 0.1).clamp(max=1.0)
    torch.testing.assert_close(edited.roughness_metallic[..., 0], wanted, rtol=0, atol=LEVEL)


def test_factors_stay_beside_painted_regions_and_other_texels_keep_their_bits(tmp_path):
    document, binary = split(textured())
    shading = document["materials"][0]["pbrMetallicRoughness"]
    shading |= {"roughnessFactor": 0.37, "baseColorFactor": [0.9, 0.8, 0.7, 1.0]}
    given = join(document, binary)
    region = torch.zeros(8, 8, 1)
    region[:4] = 1.0
    edits = [Edit.parse("roughness*0.5"), Edit.parse("basecolor*#ff8080")]
    edited, _ = edit_glb(given, edits, lambda *_: region)
    before, after = material(given, tmp_path), material(edited, tmp_path)
    assert after.roughness_factor == pytest.approx(0.37)
    assert after.basecolor_factor == pytest.approx((0.9, 0.8, 0.7))
    assert torch.equal(after.basecolor[4:], before.basecolor[4:])
    assert torch.equal(after.roughness_metallic[4:], before.roughness_metallic[4:])
    assert (after.roughness_metallic[:4] < before.roughness_metallic[:4])[..., 0].all()


def test_new_textures_share_the_coordinates_of_the_others(tmp_path):
    document, binary = split(textured())
    shading = document["materials"][0]["pbrMetallicRoughness"]
    transform = {"extensions": {"KHR_texture_transform": {"scale": [2.0, 2.0]}}}
    shading["baseColorTexture"] |= transform
    del shading["metallicRoughnessTexture"], document["materials"][0]["occlusionTexture"]
    edited, _ = edit_glb(
        join(document, binary), [Edit.parse("roughness=0.5")], lambda _, h, w: torch.ones(h, w, 1)
    )
    # The reader refuses materials whose textures are mapped differently.
    painted = material(edited, tmp_path).roughness_metallic
    assert painted.shape == (8, 8, 2)
    assert torch.equal(painted[..., 0], torch.full((8, 8), 128 / 255))


def test_what_has_no_material_gets_one(tmp_path):
    document, binary = split(textured())
    del document["meshes"][0]["primitives"][0]["material"]
    edits = [Edit.parse("metallic=0"), Edit.parse("roughness=0.25")]
    edited, _ = edit_glb(join(document, binary), edits)
    file = tmp_path / "bare.glb"
    file.write_bytes(edited)
    mesh = read_mesh(file)
    shown = mesh.materials[int(mesh.face_material[0])]
    assert (shown.metallic_factor, shown.roughness_factor) == (0.0, 0.25)


def test_extras_and_foreign_material_models_are_left_alone():
    document, binary = split(textured())
    document["nodes"][0]["extras"] = {"bufferView": 77, "aTexture": {"index": 99}}
    document["materials"][0]["extras"] = {"aTexture": {"index": 99}}
    after, _ = split(edit_glb(join(document, binary), [Edit.parse("roughness+0.1")])[0])
    assert after["nodes"][0]["extras"] == document["nodes"][0]["extras"]
    assert after["materials"][0]["extras"] == document["materials"][0]["extras"]
    document["materials"][0]["extensions"] = {"KHR_materials_pbrSpecularGlossiness": {}}
    edited, notices = edit_glb(join(document, binary), [Edit.parse("roughness+0.1")])
    assert split(edited)[0]["materials"] == document["materials"]
    assert "specular-glossiness" in notices[0]


def test_files_that_cannot_be_changed_safely_are_refused():
    document, binary = split(textured())
    document["bufferViews"][0]["extensions"] = {"EXT_meshopt_compression": {"byteOffset": 0}}
    with pytest.raises(ValueError, match="export it without compression"):
        edit_glb(join(document, binary), [Edit.parse("roughness+0.1")])
    # A factor moves no bytes.
    assert split(edit_glb(join(document, binary), [Edit.parse("roughness*0.5")])[0])[1] == binary
    document, binary = split(textured())
    document["buffers"][0]["uri"] = "asset.bin"
    with pytest.raises(ValueError, match="names another file"):
        edit_glb(join(document, binary), [Edit.parse("roughness*0.5")])
    document, binary = split(textured())
    del document["textures"][0]
    with pytest.raises(ValueError, match=r"no valid glTF 2\.0"):
        edit_glb(join(document, binary), [Edit.parse("roughness+0.1")])


@pytest.mark.skipif("GLTF_VALIDATOR" not in os.environ, reason="path of the node module not set")
@pytest.mark.parametrize(
    "text", ["roughness+0.1", "roughness*0.5", "basecolor=#aa3311", "metallic=1"]
)
def test_khronos_validator_finds_no_error(text):
    script = (
        "const v = require(process.argv[1]);"
        "v.validateBytes(new Uint8Array(require('fs').readFileSync(0)))"
        ".then(r => console.log(r.issues.numErrors))"
    )
    report = subprocess.run(
        ["node", "-e", script, os.environ["GLTF_VALIDATOR"]],
        input=edit_glb(textured(), [Edit.parse(text)])[0],
        stdout=subprocess.PIPE,
        check=True,
    )
    assert report.stdout.strip() == b"0"


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
