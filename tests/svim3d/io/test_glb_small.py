import io
import json
import os
import subprocess

import numpy as np
import pytest
import torch
import trimesh
from painted_meshes import KINDS, painted_mesh, textured_mesh

from svim3d.io import draco
from svim3d.io.glb import glb_bytes
from svim3d.io.glb_small import POSITION_STEP, UV_STEP, small_glb_bytes
from svim3d.io.gltf import parse_glb
from svim3d.io.gltf_document import GlbDocument
from svim3d.io.image import decode_image, encode_png, encode_small_png, encode_smallest
from svim3d.mesh.lathe import revolve
from svim3d.mesh.painted_mesh import PaintedMesh

VALIDATE = (
    "require(process.argv[1]).validateBytes(new Uint8Array(require('fs').readFileSync(0)))"
    ".then(report => console.log(JSON.stringify(report.issues)))"
)


@pytest.fixture(scope="module")
def vase():
    """Thousands of vertices, no maps."""
    body = revolve(
        torch.tensor([[0.0, -0.5], [0.3, -0.4], [0.1, 0.1], [0.0, 0.5]]), rounds=2, segments=48
    )
    return PaintedMesh(
        vertices=body.vertices,
        faces=body.faces,
        normals=body.normals,
        uv=None,
        tangents=None,
        basecolor=torch.tensor([0.5, 0.4, 0.3]),
        orm=torch.tensor([1.0, 0.4, 0.0]),
        normal_tangent=None,
    )


def parts(mesh):
    return {name: getattr(mesh, name) for name in mesh.__dataclass_fields__}


@pytest.mark.parametrize("kind", KINDS)
def test_quantised_vertices_keep_within_their_step(kind):
    mesh = KINDS[kind]()
    content = small_glb_bytes(mesh, "quantised")
    assert content == small_glb_bytes(mesh, "quantised")
    found = parse_glb(content)
    side = float((mesh.vertices.amax(0) - mesh.vertices.amin(0)).max())
    assert (found.vertices - mesh.vertices).abs().max() <= side * POSITION_STEP
    assert (found.normals - mesh.normals).abs().max() <= 1 / 32767
    if mesh.uv is not None:
        assert (found.uv - mesh.uv).abs().max() <= UV_STEP
        assert (found.tangents - mesh.tangents).abs().max() <= 1 / 127
        assert (found.tangents[:, 3] == mesh.tangents[:, 3]).all()
    if kind == "painted":
        assert (found.colors - mesh.basecolor).abs().max() <= 0.51 / 65535
    (other,) = trimesh.load(io.BytesIO(content), file_type="glb", force="scene").geometry.values()
    assert len(other.faces) == len(mesh.faces)


@pytest.mark.parametrize("kind", KINDS)
def test_draco_keeps_surface_and_attributes(kind):
    library = pytest.importorskip("DracoPy")
    mesh = KINDS[kind]()
    content = small_glb_bytes(mesh, "draco")
    assert content == small_glb_bytes(mesh, "draco")
    document = GlbDocument(content)
    (primitive,) = document.primitives()
    told = primitive["extensions"]["KHR_draco_mesh_compression"]
    decoded = library.decode(document._views[told["bufferView"]])
    by_id = {a["unique_id"]: a["data"] for a in decoded.attributes}
    values = {name: by_id[i] for name, i in told["attributes"].items()}
    for name, index in primitive["attributes"].items():
        assert document.json["accessors"][index]["count"] == len(values[name])
    assert document.json["accessors"][primitive["indices"]]["count"] == 3 * len(mesh.faces)
    # Vertices come in another order: each is laid beside the one nearest in all attributes.
    side = float((mesh.vertices.amax(0) - mesh.vertices.amin(0)).max())
    wanted = {"POSITION": (mesh.vertices, side / 2**14), "NORMAL": (mesh.normals, 0.01)}
    if mesh.uv is not None:
        wanted["TEXCOORD_0"] = (mesh.uv, 1 / 2**14)
    if kind == "painted":
        wanted["COLOR_0"] = (mesh.basecolor * 65535, 0.51)
    assert set(values) == set(wanted)
    distance = sum(
        torch.cdist(torch.from_numpy(values[name].astype(np.float32)), truth) / tolerance
        for name, (truth, tolerance) in wanted.items()
    )
    # Equal vertices may have become one: there is one for each of ours, and none besides.
    for name, (truth, tolerance) in wanted.items():
        got = torch.from_numpy(values[name].astype(np.float32))
        assert (got - truth[distance.argmin(1)]).abs().max() <= tolerance, name
        assert (got[distance.argmin(0)] - truth).abs().max() <= tolerance, name


def test_each_step_is_smaller(vase):
    pytest.importorskip("DracoPy")
    whole = len(glb_bytes(**parts(vase)))
    quantised, compressed = (len(small_glb_bytes(vase, k)) for k in ("quantised", "draco"))
    assert compressed < 0.25 * whole
    assert quantised < 0.8 * whole


def test_a_missing_library_is_told(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "DracoPy", None)
    with pytest.raises(ValueError, match=r"pip install 'svim3d\[draco\]'"):
        small_glb_bytes(textured_mesh(), "draco")
    assert draco.MISSING


def test_pictures_lose_little_and_colour_channels_stay_apart():
    mesh = textured_mesh(size=128)
    fine = (torch.arange(128) % 2)[:, None].expand(128, 128).float()
    orm = torch.stack([torch.ones(128, 128), 0.5 + 0.25 * fine, mesh.orm[..., 2]], -1)
    found = decode_image(encode_smallest(orm))
    assert ((found - orm) ** 2).mean() ** 0.5 < 0.01
    few = torch.full((64, 64, 3), 0.25)
    assert encode_smallest(few) == encode_small_png(few)  # a palette is shorter than a JPEG


def test_palettes_hold_the_same_pixels():
    generator = torch.Generator().manual_seed(0)
    colours = torch.randint(0, 256, (9, 3), generator=generator) / 255.0
    picture = colours[torch.randint(0, 9, (16, 16), generator=generator)]
    small = encode_small_png(picture)
    assert torch.equal(decode_image(small), decode_image(encode_png(picture)))
    assert len(small) < len(encode_png(picture))


@pytest.mark.skipif("GLTF_VALIDATOR" not in os.environ, reason="path of the node module not set")
@pytest.mark.parametrize("kind", KINDS)
def test_khronos_validator_has_nothing_to_remark(kind):
    report = subprocess.run(
        ["node", "-e", VALIDATE, os.environ["GLTF_VALIDATOR"]],
        input=small_glb_bytes(KINDS[kind](), "quantised"),
        stdout=subprocess.PIPE,
        check=True,
    )
    issues = json.loads(report.stdout)
    assert issues["numErrors"] == issues["numWarnings"] == 0, issues["messages"]


def test_colours_of_vertices_are_fine_grained():
    mesh = painted_mesh()
    found = parse_glb(small_glb_bytes(mesh, "quantised"))
    assert len(torch.unique(found.colors, dim=0)) == len(mesh.vertices)
