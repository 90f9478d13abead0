import base64
import json

import numpy as np
import pytest
import torch

from svim3d.io.glb import read_mesh
from svim3d.io.image import encode_png
from svim3d.numerics import normalize

CORNERS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "<f4")


def uri(content):
    return "data:application/octet-stream;base64," + base64.b64encode(content).decode()


def document(arrays, *, attributes=None, indices=None, **extra):
    """A glTF with one primitive; arrays are (values, component type, type, more) per accessor."""
    accessors, views, buffers = [], [], []
    for index, (values, component, kind, more) in enumerate(arrays):
        content = values.tobytes()
        buffers.append({"uri": uri(content), "byteLength": len(content)})
        views.append({"buffer": index, "byteLength": len(content)})
        entry = {"bufferView": index, "componentType": component, "count": len(values)}
        accessors.append(entry | {"type": kind} | more)
    primitive = {"attributes": attributes or {"POSITION": 0}}
    if indices is not None:
        primitive["indices"] = indices
    primitive |= extra.pop("primitive", {})
    return {
        "asset": {"version": "2.0"},
        "buffers": buffers,
        "bufferViews": views,
        "accessors": accessors,
        "meshes": [{"primitives": [primitive]}],
        "nodes": [{"mesh": 0}],
        "scenes": [{"nodes": [0]}],
    } | extra


def load(tmp_path, content):
    file = tmp_path / "mesh.gltf"
    file.write_text(json.dumps(content))
    return read_mesh(file)


TRIANGLE = [(CORNERS, 5126, "VEC3", {})]


def test_transforms_of_all_ancestors_apply(tmp_path):
    half = np.sqrt(0.5)
    nodes = [
        {"children": [1], "translation": [10, 0, 0]},
        {"children": [2], "rotation": [0, 0, half, half]},  # a quarter turn about z
        {"mesh": 0, "scale": [2, 3, 1]},
    ]
    mesh = load(tmp_path, document(TRIANGLE, nodes=nodes))
    expected = torch.tensor([[10.0, 0, 0], [10, 2, 0], [7, 0, 0]])
    assert torch.allclose(mesh.vertices, expected, atol=1e-6)
    matrix = [0, 2, 0, 0, -3, 0, 0, 0, 0, 0, 1, 0, 10, 0, 0, 1]  # the same, column by column
    direct = load(tmp_path, document(TRIANGLE, nodes=[{"mesh": 0, "matrix": matrix}]))
    assert torch.allclose(direct.vertices, mesh.vertices, atol=1e-6)


def test_a_mirroring_node_keeps_faces_and_normals_outward(tmp_path):
    normals = np.array([[0.6, 0, 0.8]] * 3, "<f4")
    content = document(
        [*TRIANGLE, (normals, 5126, "VEC3", {})], attributes={"POSITION": 0, "NORMAL": 1}
    )
    content["nodes"] = [{"mesh": 0, "scale": [-1, 1, 1]}]
    mesh = load(tmp_path, content)
    assert torch.allclose(mesh.normals, torch.tensor([-0.6, 0, 0.8]))
    corner = mesh.vertices[mesh.faces[0].long()]
    assert torch.linalg.cross(corner[1] - corner[0], corner[2] - corner[0])[2] > 0


def test_normals_turn_with_the_inverse_transpose(tmp_path):
    normals = np.array([[np.sqrt(0.5), np.sqrt(0.5), 0]] * 3, "<f4")
    content = document(
        [*TRIANGLE, (normals, 5126, "VEC3", {})], attributes={"POSITION": 0, "NORMAL": 1}
    )
    content["nodes"] = [{"mesh": 0, "scale": [2, 1, 1]}]
    expected = normalize(torch.tensor([[0.5, 1.0, 0.0]]))
    assert torch.allclose(load(tmp_path, content).normals, expected.expand(3, 3), atol=1e-6)


def test_missing_normals_are_smooth_across_split_vertices(tmp_path):
    # Two triangles folded along the y axis, each with vertices of its own.
    positions = np.array([[0, 0, 0], [1, 0, 1], [0, 1, 0], [0, 0, 0], [0, 1, 0], [-1, 0, 1]], "<f4")
    mesh = load(tmp_path, document([(positions, 5126, "VEC3", {})]))
    assert torch.allclose(mesh.normals[0], torch.tensor([0.0, 0, 1]), atol=1e-6)
    assert torch.equal(mesh.normals[0], mesh.normals[3])


def test_strips_and_fans_wind_like_lists(tmp_path):
    positions = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], "<f4")
    for mode, order in ((5, [0, 1, 2, 3]), (6, [0, 1, 3, 2])):
        arrays = [
            (positions, 5126, "VEC3", {}),
            (np.array(order, "<u2"), 5123, "SCALAR", {}),
        ]
        mesh = load(tmp_path, document(arrays, indices=1, primitive={"mode": mode}))
        assert len(mesh.faces) == 2
        assert torch.allclose(mesh.normals, torch.tensor([0.0, 0, 1]).expand(4, 3))


def test_normalised_strided_and_sparse_accessors(tmp_path):
    packed = np.zeros(3, [("uv", "<u2", 2), ("pad", "<u4")])
    packed["uv"] = [[0, 0], [65535, 0], [0, 32768]]
    uv = (packed, 5123, "VEC2", {"normalized": True})
    content = document([*TRIANGLE, uv], attributes={"POSITION": 0, "TEXCOORD_0": 1})
    content["bufferViews"][1]["byteStride"] = 8
    rows, values = np.array([1], "<u2").tobytes(), np.array([[5, 0, 0]], "<f4").tobytes()
    content["buffers"] += [{"uri": uri(rows)}, {"uri": uri(values)}]
    content["bufferViews"] += [
        {"buffer": 2, "byteLength": len(rows)},
        {"buffer": 3, "byteLength": len(values)},
    ]
    content["accessors"][0]["sparse"] = {
        "count": 1,
        "indices": {"bufferView": 2, "componentType": 5123},
        "values": {"bufferView": 3},
    }
    mesh = load(tmp_path, content)
    assert torch.allclose(mesh.uv, torch.tensor([[0, 0], [1, 0], [0, 32768 / 65535]]))
    assert mesh.vertices[1].tolist() == [5, 0, 0]


def textured(tmp_path, *, transform=None):
    (tmp_path / "t.png").write_bytes(encode_png(torch.tensor([[[0.5, 0.5, 1.0]]]).expand(2, 2, 3)))
    uv = (np.array([[0, 0], [1, 0], [0, 1]], "<f4"), 5126, "VEC2", {})
    texture = {"index": 0}
    if transform:
        texture["extensions"] = {"KHR_texture_transform": transform}
    content = document(
        [*TRIANGLE, uv],
        attributes={"POSITION": 0, "TEXCOORD_0": 1},
        primitive={"material": 0},
        images=[{"uri": "t.png"}],
        textures=[{"source": 0}],
        materials=[
            {
                "pbrMetallicRoughness": {
                    "baseColorTexture": texture,
                    "baseColorFactor": [0.5, 0.25, 1, 1],
                    "roughnessFactor": 0.3,
                },
                "normalTexture": dict(texture, scale=0.5),
            }
        ],
    )
    return content


def test_textures_beside_the_file_decode_to_linear_and_unit_normals(tmp_path):
    material = load(tmp_path, textured(tmp_path)).materials[0]
    assert material.basecolor_factor == (0.5, 0.25, 1.0)
    assert (material.roughness_factor, material.metallic_factor) == (0.3, 1.0)
    encoded = 128 / 255
    assert float(material.basecolor[0, 0, 0]) == pytest.approx(((encoded + 0.055) / 1.055) ** 2.4)
    tilt = 0.5 * (2 * encoded - 1)  # the scale shrinks x and y before normalisation
    expected = normalize(torch.tensor([[tilt, tilt, 1.0]]))[0]
    assert torch.allclose(material.normal_tangent[0, 0], expected, atol=1e-6)


def test_a_normal_map_brings_tangents(tmp_path):
    tangents = load(tmp_path, textured(tmp_path)).tangents
    # u grows along +x; v, down in the picture, along +y: so "up" is -y, and y = w cross(z, x).
    assert torch.allclose(tangents, torch.tensor([[1.0, 0, 0, -1]]).expand(3, 4))


def test_texture_transforms_move_uv_and_must_agree(tmp_path):
    transform = {"offset": [0.5, 0], "rotation": np.pi / 2, "scale": [2, 1]}
    mesh = load(tmp_path, textured(tmp_path, transform=transform))
    # Source: the extension's example, u' = s_u u cos + s_v v sin + o, v' = -s_u u sin + s_v v cos.
    assert torch.allclose(mesh.uv, torch.tensor([[0.5, 0], [0.5, -2], [1.5, 0]]), atol=1e-6)
    content = textured(tmp_path)
    content["materials"][0]["normalTexture"]["texCoord"] = 1
    with pytest.raises(ValueError, match="maps its textures differently"):
        load(tmp_path, content)


def test_primitives_of_several_materials_share_one_index_space(tmp_path):
    content = document(TRIANGLE, materials=[{"pbrMetallicRoughness": {"metallicFactor": 0.0}}])
    primitives = content["meshes"][0]["primitives"]
    primitives.append(dict(primitives[0], material=0))
    mesh = load(tmp_path, content)
    assert mesh.faces.tolist() == [[0, 1, 2], [3, 4, 5]]
    chosen = [mesh.materials[i].metallic_factor for i in mesh.face_material.tolist()]
    assert chosen == [1.0, 0.0]  # the first has glTF's default material


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"extensionsRequired": ["KHR_draco_mesh_compression"]}, "KHR_draco_mesh_compression"),
        ({"nodes": [{}]}, "no triangles"),
        ({"accessors": []}, "no valid glTF"),
    ],
)
def test_what_cannot_be_read_is_named(tmp_path, change, message):
    with pytest.raises(ValueError, match=message):
        load(tmp_path, document(TRIANGLE) | change)


def test_reads_beyond_a_buffer_are_refused(tmp_path):
    content = document(TRIANGLE)
    content["accessors"][0]["count"] = 1000
    with pytest.raises(ValueError, match="beyond its buffer"):
        load(tmp_path, content)
    file = tmp_path / "text.gltf"
    file.write_text("no mesh")
    with pytest.raises(ValueError, match="neither a GLB nor glTF"):
        read_mesh(file)
