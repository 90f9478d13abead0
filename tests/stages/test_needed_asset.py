"""No more asset than the scene needs: from views to files, with every choice left to evidence."""

import json
import math
import os
import subprocess
from dataclasses import replace

import pytest
import torch
from sphere_views import (
    GOLD,
    HALF,
    RADIUS,
    RED_PLASTIC,
    grey_sphere,
    of_one_material,
    of_two_materials,
    sphere_views,
    with_a_pattern,
)

from stages import export, uv_bake
from stages.artifacts import TexturedMesh
from stages.base import Context
from stages.edit import edit_asset
from stages.finished_views import ViewFolder
from stages.preview import run as preview
from stages.relight import run as relight
from stages.settings.export import ExportConfig
from stages.settings.preview import PreviewConfig
from stages.settings.relight import RelightConfig
from stages.settings.uv_bake import UvBakeConfig
from svim3d.cameras import orbit_cameras
from svim3d.fields.sdf_grid import node_positions
from svim3d.io.glb import glb_bytes, read_mesh, reopen_glb
from svim3d.mesh.lathe import revolve
from svim3d.mesh.mesh import vertex_normals
from svim3d.metrics import psnr
from svim3d.numerics import normalize
from svim3d.render import material_maps
from svim3d.render.deferred import environment_shader
from svim3d.render.face_budget import COARSER, ShapePictures
from svim3d.render.pictures import render_pictures
from svim3d.shading.prefilter import PyramidOperator
from svim3d.shading.tonemap import agx

FIXED = UvBakeConfig(
    texture_size=128, max_faces=4000, occlusion_rays=16, fit_iterations=12, atlas_timeout_s=0.0
)
NEEDED = FIXED.model_copy(
    update={"faces": "evidence", "materials": "nested", "texture_sizes": "evidence"}
)
SMALL = 100_000  # bytes
LEVEL = 1.0 / 255.0
NOISE = {"noise": 0.03, "blur_px": 1.5}
VIEWS = {"views": 8, "size": 64}


class Made:
    """One object's way through the stages, with what they told."""

    def __init__(self, folder, paint, config, field=None, lods=0, **kinds):
        self.views = sphere_views(paint, **VIEWS, **kinds)
        self.field = field or grey_sphere()
        self.events = {}
        context = self._context(folder, "uv_bake")
        self.mesh = uv_bake.run(self.views, self.field, None, config=config, ctx=context)
        self._note(context)
        context = self._context(folder, "export")
        settings = ExportConfig(formats=("glb", "obj"), lods=lods)
        # Nothing is asked of the views' folder.
        self.asset = export.run(
            self.field, None, self.mesh, ViewFolder(folder), config=settings, ctx=context
        )
        self._note(context)
        self.glb = self.asset.files["asset.glb"]
        self.file = folder / "asset.glb"
        for name, content in self.asset.files.items():
            (folder / name).write_bytes(content)

    def _context(self, folder, stage):
        work = folder / stage / str(len(list(folder.iterdir())))
        return Context(stage, torch.device("cpu"), 0, work, folder / "shared")

    def _note(self, context):
        for event in context.events:
            kind = self.events.setdefault(event["kind"], [])
            kind.append(event["message"])

    @property
    def material(self):
        return read_mesh(self.file).materials[0]


@pytest.fixture(scope="module")
def one(tmp_path_factory):
    return Made(tmp_path_factory.mktemp("one"), of_one_material, NEEDED, lods=2, **NOISE)


@pytest.fixture(scope="module")
def one_as_textures(tmp_path_factory):
    return Made(tmp_path_factory.mktemp("textures"), of_one_material, FIXED, **NOISE)


@pytest.fixture(scope="module")
def two(tmp_path_factory):
    return Made(tmp_path_factory.mktemp("two"), of_two_materials, NEEDED)


@pytest.fixture(scope="module")
def pattern(tmp_path_factory):
    return Made(tmp_path_factory.mktemp("pattern"), with_a_pattern, NEEDED)


@pytest.fixture(scope="module")
def pattern_as_textures(tmp_path_factory):
    return Made(tmp_path_factory.mktemp("patterned"), with_a_pattern, FIXED)


def picture(mesh_file):
    """Displayed pictures under a sky that is brighter above, and their coverage."""
    light = 0.3 + 0.6 * torch.rand(16, 16, 3, generator=torch.Generator().manual_seed(0))
    shader = environment_shader(PyramidOperator.build(16)(light))
    cameras = orbit_cameras([(0.0, 0.0), (20.0, 120.0)], radius=2.2, fov_y_deg=33.8, size=64)
    images = render_pictures(read_mesh(mesh_file), cameras, shader, supersample=3)
    return agx(images["radiance"]), images["mask"] > 0.5


def true_sphere(folder):
    """A finely cut sphere of the one material."""
    angle = torch.linspace(-math.pi / 2, math.pi / 2, 97)
    profile = torch.stack([angle.cos(), angle.sin()], 1)
    profile[[0, -1], 0] = 0.0
    body = revolve(profile * RADIUS, rounds=0, segments=192)
    file = folder / "truth.glb"
    file.write_bytes(
        glb_bytes(
            vertices=body.vertices,
            faces=body.faces,
            normals=body.normals,
            basecolor=torch.tensor(GOLD[:3]),
            orm=torch.tensor([1.0, *GOLD[3:]]),
        )
    )
    return file


def test_one_material_is_a_small_file_without_textures(one):
    assert len(one.glb) < SMALL
    assert one.mesh.textures == {}
    found = reopen_glb(one.glb)
    assert found.uv is None
    # The mean of what noise clipped at one has left.
    assert (found.basecolor - torch.tensor(GOLD[:3])).abs().max() < 0.02
    assert (found.orm - torch.tensor([1.0, *GOLD[3:]])).abs().max() < 0.02
    assert one.asset.summary["materials"] == "constant"
    assert one.asset.summary["watertight"] is True
    assert "PNG" not in str(one.glb[:2000])
    assert not [name for name in one.asset.files if name.endswith(".png")]


def test_it_renders_as_the_textured_one_does(one, one_as_textures, tmp_path):
    truth, mask = picture(true_sphere(tmp_path))
    needed, textured = (psnr(picture(m.file)[0], truth, mask) for m in (one, one_as_textures))
    assert needed > textured - 0.2
    assert needed > 30.0
    assert len(one_as_textures.glb) > 2 * len(one.glb)


def test_each_choice_is_told_in_numbers(one, pattern):
    told = {message.split(":")[0]: message for message in one.events["material"]}
    assert set(told) == {"basecolor", "roughness", "metallic", "occlusion", "normal"}
    for name in ("basecolor", "roughness", "metallic"):
        assert told[name].startswith(f"{name}: constant by ")
        assert "texture" in told[name]  # what it was chosen over
        assert "dB, cost" in told[name]
    assert "deg" in told["normal"]
    (faces,) = one.events["faces"]
    assert faces.startswith(f"{len(one.mesh.faces)} of at most 4000 faces")
    sizes = [message for message in pattern.events["material"] if "size" in message]
    assert any(message.startswith("basecolor size: ") for message in sizes)


def test_two_materials_are_a_palette_of_two(two):
    for name in ("basecolor", "roughness", "metallic"):
        assert two.asset.summary[f"{name}_map"] == "palette of 2"
    material = two.material
    colours = torch.unique(material.basecolor.reshape(-1, 3), dim=0)
    wanted = torch.tensor([RED_PLASTIC[:3], GOLD[:3]])
    assert (colours - wanted).abs().max() < 0.03
    pairs = torch.unique(material.roughness_metallic.reshape(-1, 2), dim=0)
    assert len(pairs) <= 4  # the two maps' borders differ by some texels
    assert sorted({round(m) for m in pairs[:, 1].tolist()}) == [0, 1]
    assert torch.equal(reopen_glb(two.glb).basecolor, material.basecolor)
    assert len(two.glb) < SMALL


def test_a_pattern_stays_a_texture(pattern, pattern_as_textures):
    for name in ("basecolor", "roughness", "metallic"):
        assert pattern.asset.summary[f"{name}_map"].startswith("texture of")
    needed, textured = previewed(pattern), previewed(pattern_as_textures)
    for name in ("basecolor", "roughness", "metallic", "radiance"):
        assert needed[f"{name}_psnr_db"] > textured[f"{name}_psnr_db"] - 0.2
    assert len(pattern.glb) < 0.5 * len(pattern_as_textures.glb)


def previewed(made):
    """The figures of the preview stage."""
    folder = made.file.parent / "preview"
    context = Context("preview", torch.device("cpu"), 0, folder, folder)
    config = PreviewConfig(views=3, cell=64, supersample=2)
    return preview(made.views, made.field, made.asset, config=config, ctx=context).figures


def test_preview_relight_and_edit_read_an_asset_without_textures(one, tmp_path):
    figures = previewed(one)
    assert figures["mask_iou"] > 0.94  # of pixels that are more than half covered
    assert figures["roughness_psnr_db"] > 28.0  # the views' noise of 0.03 is 30.5 dB
    context = Context("relight", torch.device("cpu"), 0, tmp_path / "work", tmp_path)
    still = RelightConfig(size=32, orbit_views=2, supersample=1, turntable="none")
    assert len(relight(one.file, config=still, ctx=context).files) == 5
    recoloured = still.model_copy(update={"edits": ("basecolor=#00ff00",)})
    relit = relight(one.file, config=recoloured, ctx=context)
    (tmp_path / "edits.json").write_bytes(relit.files["edits.json"])
    content, _ = edit_asset(one.file, ["roughness=0.25"], record=tmp_path / "edits.json")
    (tmp_path / "edited.glb").write_bytes(content)
    edited = read_mesh(tmp_path / "edited.glb").materials[0]
    assert edited.basecolor is None
    assert edited.basecolor_factor == pytest.approx((0.0, 1.0, 0.0), abs=1e-6)
    assert edited.roughness_factor == 0.25
    assert edited.metallic_factor == pytest.approx(one.material.metallic_factor)


def test_palettes_are_edited_as_textures_are(two, tmp_path):
    content, _ = edit_asset(two.file, ["roughness*0.5"])
    (tmp_path / "edited.glb").write_bytes(content)
    edited = read_mesh(tmp_path / "edited.glb").materials[0]
    factors = edited.roughness_factor / two.material.roughness_factor
    assert factors == pytest.approx(0.5)
    assert torch.equal(edited.roughness_metallic, two.material.roughness_metallic)


def test_obj_holds_the_same_materials(one, two):
    for made in (one, two):
        obj = read_mesh(made.file.with_suffix(".obj"))
        glb = made.material
        other = obj.materials[0]
        assert len(obj.faces) == len(made.mesh.faces)
        assert other.basecolor_factor == pytest.approx(glb.basecolor_factor, abs=1e-5)
        assert other.roughness_factor == pytest.approx(glb.roughness_factor, abs=1e-5)
        if glb.basecolor is not None:
            assert torch.equal(other.basecolor, glb.basecolor)
            assert torch.equal(other.roughness_metallic, glb.roughness_metallic)


def test_levels_of_detail_have_fewer_faces_each_and_the_same_material(one):
    counts = [len(one.mesh.faces)]
    for level in (1, 2):
        content = one.asset.files[f"asset_lod{level}.glb"]
        found = reopen_glb(content)
        assert torch.allclose(found.orm, reopen_glb(one.glb).orm)
        assert len(found.faces) == one.asset.summary[f"lod{level}_faces"]
        assert len(content) < len(one.glb)
        counts.append(len(found.faces))
    assert counts[0] > counts[1] > counts[2]
    assert "asset_lod3.glb" not in one.asset.files


def test_levels_of_detail_are_held_against_the_asset_not_each_other(one):
    surface = _knurled_sphere()
    faces, vertices = surface.faces, surface.vertices
    normals = vertex_normals(vertices, faces)
    knurled = replace(one.mesh, vertices=vertices, faces=faces, normals=normals)
    cameras = orbit_cameras([(0.0, 0.0), (20.0, 120.0)], radius=2.2, fov_y_deg=33.8, size=128)
    whole = ShapePictures.of_surface(vertices, faces, cameras)
    levels = [mesh for mesh, _ in export._coarser(knurled, 3)]
    assert len(levels) == 3
    for mesh, most in zip(levels, COARSER, strict=True):
        error = whole.error(mesh.vertices, mesh.faces)
        assert error.normal_deg < 1.1 * most.normal_deg
        assert error.silhouette < 1.1 * most.silhouette


def test_textures_of_levels_are_halved(pattern_as_textures):
    mesh = pattern_as_textures.mesh
    levels = [level for level, _ in export._coarser(mesh, 2)]
    for count, level in enumerate(levels, 1):
        sizes = {name: len(image) for name, image in level.textures.items()}
        assert sizes == {name: len(i) // 2**count for name, i in mesh.textures.items()}
    assert len(levels) == 2


@pytest.mark.parametrize("gain_db", [0.1, 0.9])
def test_a_finer_texture_is_kept_where_unseen_views_gain(pattern, gain_db, monkeypatch):
    asked = []

    def errors(pixels, start, groups, **_):
        asked.append(pixels.texture_size)
        factor = 1.0 if len(asked) == 1 else 10.0 ** (-gain_db / 10.0)
        return {group.name: 1e-3 * factor for group in groups}

    monkeypatch.setattr(material_maps, "unseen_errors", errors)
    config = NEEDED.model_copy(update={"texture_size": 256})
    context = pattern._context(pattern.file.parent, f"gain {gain_db}")
    mesh = uv_bake.run(pattern.views, pattern.field, None, config=config, ctx=context)
    assert asked == [128, 256]
    assert len(mesh.basecolor) == (256 if gain_db > material_maps.FINER_PAYS_DB else 128)
    told = [event["message"] for event in context.events if " detail: " in event["message"]]
    assert len(told) == 3 and all(f"{gain_db:+.2f} dB better" in message for message in told)
    unfitted = config.model_copy(update={"fit_iterations": 0})
    uv_bake.run(pattern.views, pattern.field, None, config=unfitted, ctx=context)
    assert asked == [128, 256]


def _knurled_sphere():
    x, y, z = node_positions(48, HALF, like=torch.zeros(1)).unbind(-1)
    knobs = 0.02 * torch.cos(12 * torch.atan2(x, z)) * torch.cos(30 * y)
    radius = torch.stack([x, y, z]).norm(dim=0)
    return replace(grey_sphere(48), sdf=RADIUS + knobs - radius).own_surface()


def test_a_knurled_object_keeps_more_faces(one):
    surface = _knurled_sphere()
    views = sphere_views(of_one_material, **VIEWS)
    shown = uv_bake.ShapePictures.of_surface(surface.vertices, surface.faces, views.cameras)
    seen = replace(views, mask=shown.covered, normal_world=normalize(shown.normals))
    context = one._context(one.file.parent, "knurled")
    fine = uv_bake.CleanMesh(surface.vertices, surface.faces)
    kept = uv_bake._decimated(fine, seen, NEEDED, context)
    assert len(kept.faces) > 1.5 * len(one.mesh.faces)


def test_an_asset_of_constants_survives_saving(one, two, tmp_path):
    for made in (one, two):
        folder = tmp_path / str(len(made.mesh.textures))
        folder.mkdir()
        made.mesh.save(folder)
        loaded = TexturedMesh.load(folder)
        assert loaded.headline() == made.mesh.headline()
        assert torch.equal(loaded.vertices, made.mesh.vertices)
        assert torch.equal(loaded.orm_factor, made.mesh.orm_factor)
        assert (loaded.basecolor - made.mesh.basecolor).abs().max() < 1.2 * LEVEL
        assert (loaded.orm - made.mesh.orm).abs().max() < 0.51 * LEVEL
        assert loaded.normal_tangent is None
        assert (loaded.uv is None) == (made.mesh.uv is None)


@pytest.mark.skipif("GLTF_VALIDATOR" not in os.environ, reason="path of the node module not set")
def test_khronos_validator_has_nothing_to_remark(one, two, pattern):
    program = (
        "require(process.argv[1]).validateBytes(new Uint8Array(require('fs').readFileSync(0)))"
        ".then(report => console.log(JSON.stringify(report.issues)))"
    )
    for made in (one, two, pattern):
        for name in (n for n in made.asset.files if n.endswith(".glb")):
            report = subprocess.run(
                ["node", "-e", program, os.environ["GLTF_VALIDATOR"]],
                input=made.asset.files[name],
                stdout=subprocess.PIPE,
                check=True,
            )
            issues = json.loads(report.stdout)
            assert issues["numErrors"] == issues["numWarnings"] == 0, issues["messages"]
