import dataclasses

import pytest
import torch
from spoilt_views import spoilt, trusted, warned

from stages.artifacts import FittedField, MaterialViews, TexturedMesh
from stages.base import Context
from stages.errors import InputError
from stages.settings.uv_bake import UvBakeConfig
from stages.uv_bake import UV_BAKE, run
from svim3d.cameras import orbit_angles, orbit_cameras
from svim3d.color import srgb_from_linear
from svim3d.fields.material_field import MaterialField, MaterialFieldSpec
from svim3d.fields.sdf_grid import node_positions
from svim3d.mesh.cleanup import is_closed
from svim3d.mesh.frames import bitangents, world_from_tangent
from svim3d.mesh.mesh import face_normals_scaled
from svim3d.numerics import dot, normalize
from svim3d.raster.texture import sample_texture
from svim3d.render.view_warps import ViewCorrections, inverse_shifts, read_through

RADIUS, HALF = 0.4, 0.55
SPEC = MaterialFieldSpec(levels=3, log2_entries=12, coarsest=4, finest=12, hidden=8)
TINY = UvBakeConfig(texture_size=128, max_faces=400, occlusion_rays=0, fit_iterations=0)


def sphere_field(bump=0.75):
    """A sphere whose materials and relief vary smoothly with position, by a random field."""
    generator = torch.Generator().manual_seed(0)
    field = MaterialField(SPEC)
    field.reset(generator)
    state = field.state_dict()
    for name, value in state.items():
        if "encoding" in name:
            state[name] = torch.randn(value.shape, generator=generator) * 0.5
    state["network.second.weight"] = torch.randn(8, SPEC.hidden, generator=generator) * 0.2
    state["network.second.weight"][5:] *= bump
    sdf = RADIUS - node_positions(32, HALF, like=torch.zeros(1)).norm(dim=-1)
    return FittedField(sdf, HALF, SPEC, state, torch.ones(8, 8, 3))


def striped_views(size=64):
    """The sphere painted in fine stripes along y, seen from five sides."""
    cameras = orbit_cameras(orbit_angles(5, 0.0, 20.0), radius=2.2, fov_y_deg=33.8, size=size)
    samples = 4
    images = []
    for view in range(len(cameras)):
        origin, ray = cameras.resized(size * samples, size * samples).rays(view)
        along = -dot(origin, ray)
        gap = RADIUS**2 - (dot(origin, origin) - along**2)
        hit = (gap > 0).float()
        point = origin + (along - gap.clamp_min(0).sqrt()) * ray
        stripes = 0.5 + 0.4 * torch.sin(60.0 * point[:, 1:2])
        image = torch.cat([hit * stripes, hit], 1).view(size, samples, size, samples, 2)
        images.append(image.mean((1, 3)))
    value, mask = torch.stack(images).split(1, -1)
    straight = value / mask.clamp_min(1e-3)
    return MaterialViews(
        cameras=cameras,
        radiance=value.expand(-1, -1, -1, 3),
        mask=mask,
        basecolor=straight.expand(-1, -1, -1, 3),
        roughness=straight,
        metallic=straight,
        normal_world=torch.zeros(5, size, size, 3),
        reference=4,
    )


VIEWS = striped_views()


@pytest.fixture
def ctx(tmp_path):
    return Context("uv_bake", torch.device("cpu"), 0, tmp_path / "work", tmp_path / "shared")


@pytest.fixture(scope="module")
def baked(tmp_path_factory):
    folder = tmp_path_factory.mktemp("baked")
    ctx = Context("uv_bake", torch.device("cpu"), 0, folder / "work", folder / "shared")
    field = sphere_field()
    return field, run(VIEWS, field, None, config=TINY, ctx=ctx)


def surface_samples(mesh, count=4000):
    """Random points on the mesh: how to interpolate any vertex attribute there."""
    generator = torch.Generator().manual_seed(1)
    area = face_normals_scaled(mesh.vertices, mesh.faces).norm(dim=1)
    corners = mesh.faces[torch.multinomial(area, count, True, generator=generator)].long()
    weights = -torch.rand(count, 3, generator=generator).log()
    weights = (weights / weights.sum(1, keepdim=True))[..., None]
    return lambda attribute: (attribute[corners] * weights).sum(1)


def angle_deg(a, b):
    return torch.rad2deg(torch.atan2(torch.linalg.cross(a, b).norm(dim=1), (a * b).sum(1)))


def test_textures_hold_the_field_at_the_surface(baked):
    field, mesh = baked
    at = surface_samples(mesh)
    direction = normalize(at(mesh.vertices))
    truth = field.own_surface().material_field(torch.device("cpu"))(RADIUS * direction)
    basecolor = srgb_from_linear(sample_texture(mesh.basecolor, at(mesh.uv)))
    error = (basecolor - srgb_from_linear(truth.basecolor)).abs()
    assert truth.basecolor.std() > 0.05
    assert error.mean() < 0.004
    assert error.max() < 0.08  # one sample of thousands; its place moves with rounding
    orm = sample_texture(mesh.orm, at(mesh.uv))
    assert (orm[:, 0] - 1).abs().max() < 1e-6
    assert (orm[:, 1:2] - truth.roughness).abs().mean() < 0.004
    assert (orm[:, 2:3] - truth.metallic).abs().mean() < 0.004


def test_normal_map_restores_the_shading_normals_of_the_field(baked):
    field, mesh = baked
    at = surface_samples(mesh)
    normal, tangent = at(mesh.normals), at(mesh.tangents[:, :3])
    direction = normalize(at(mesh.vertices))
    bump = field.own_surface().material_field(torch.device("cpu"))(RADIUS * direction).bump
    truth = normalize(direction + bump)
    local = sample_texture(mesh.normal_tangent, at(mesh.uv))
    restored = world_from_tangent(
        local, normal, tangent, at(bitangents(mesh.normals, mesh.tangents))
    )
    error = angle_deg(restored, truth)
    assert angle_deg(normalize(normal), truth).mean() > 5  # without the map
    assert error.mean() < 1.0
    assert error.quantile(0.99) < 4.0


def test_baked_normals_are_unit_and_leave_the_surface(baked):
    _, mesh = baked
    assert torch.allclose(mesh.normal_tangent.norm(dim=-1), torch.ones(128, 128), atol=1e-5)
    assert mesh.normal_tangent[..., 2].min() > 0
    assert mesh.normals.shape == mesh.vertices.shape
    welded = torch.unique(mesh.vertices, dim=0, return_inverse=True)[1]
    assert is_closed(welded[mesh.faces.long()])


def test_equal_inputs_give_equal_results_and_survive_saving(baked, ctx, tmp_path):
    field, mesh = baked
    again = run(VIEWS, field, None, config=TINY, ctx=ctx)
    for entry in dataclasses.fields(TexturedMesh):
        first, second = (getattr(m, entry.name) for m in (mesh, again))
        assert first is second is None or torch.equal(first, second), entry.name
    folder = tmp_path / "saved"
    folder.mkdir()
    mesh.save(folder)
    loaded = TexturedMesh.load(folder)
    assert torch.equal(loaded.tangents, mesh.tangents)
    assert (srgb_from_linear(loaded.basecolor) - srgb_from_linear(mesh.basecolor)).abs().max() < (
        0.51 / 255
    )


def test_the_refined_surface_is_preferred_and_fallback_and_occlusion_are_told(ctx):
    field = sphere_field(bump=0.0)
    surface = field.own_surface()
    shifted = dataclasses.replace(surface, vertices=surface.vertices * 0.5)
    config = TINY.model_copy(
        update={"atlas_timeout_s": 0.0, "occlusion_rays": 16, "supersample": 2, "texture_size": 64}
    )
    mesh = run(VIEWS, field, shifted, config=config, ctx=ctx)
    assert float(mesh.vertices.norm(dim=1).max()) == pytest.approx(RADIUS / 2, rel=0.05)
    assert mesh.basecolor.shape == (64, 64, 3)
    assert [e["kind"] for e in ctx.events] == ["atlas"]
    assert (mesh.orm[..., 0] == 0).all()  # the shrunken surface lies inside the field's


def test_textures_are_sharpened_against_the_views(ctx):
    field = sphere_field(bump=0.0)
    config = TINY.model_copy(update={"fit_iterations": 20, "texture_size": 256})
    mesh = run(VIEWS, field, None, config=config, ctx=ctx)
    at = surface_samples(mesh)
    height = at(mesh.vertices)[:, 1:2]
    truth = 0.5 + 0.4 * torch.sin(60.0 * height)
    seen = height.abs() < 0.25  # no camera looks along the poles
    for texture, channel in ((mesh.basecolor, 0), (mesh.orm, 1), (mesh.orm, 2)):
        error = (sample_texture(texture, at(mesh.uv))[:, channel, None] - truth).abs()[seen]
        assert error.mean() < 0.1  # the field knows nothing of stripes: 0.27


def test_textures_are_sharpened_by_what_can_be_trusted(ctx):
    config = TINY.model_copy(update={"fit_iterations": 3})

    def textures(views):
        mesh = run(views, sphere_field(bump=0.0), None, config=config, ctx=ctx)
        return torch.cat([mesh.basecolor, mesh.orm], -1)

    plain = textures(VIEWS)
    assert torch.equal(textures(trusted(VIEWS)), plain)
    hidden = textures(spoilt(VIEWS))
    assert torch.equal(hidden, textures(warned(VIEWS)))
    assert not torch.equal(hidden, plain)


def moved(views, shifts):
    """Views whose content lies where the warps put it."""
    size = views.cameras.height
    pixels = torch.arange(views.mask.numel())
    back = ViewCorrections(inverse_shifts(shifts), torch.ones(len(shifts)))
    images = {
        n: getattr(views, n) for n in ("radiance", "mask", "basecolor", "roughness", "metallic")
    }
    return dataclasses.replace(
        views,
        **{
            name: read_through(back, image.flatten(0, 2), pixels, size, size)[0].view(image.shape)
            for name, image in images.items()
        },
    )


def test_views_are_read_through_their_warps(ctx):
    """Stripes of moved views are sharp only where the warps are undone."""
    config = TINY.model_copy(update={"fit_iterations": 20, "texture_size": 256})
    shifts = 0.06 * torch.randn(5, 4, 2, generator=torch.Generator().manual_seed(0))
    views = moved(VIEWS, shifts)
    field = dataclasses.replace(
        sphere_field(bump=0.0), corrections=ViewCorrections(shifts, torch.ones(5))
    )

    def error(config):
        mesh = run(views, field, None, config=config, ctx=ctx)
        at = surface_samples(mesh)
        height = at(mesh.vertices)[:, 1:2]
        found = sample_texture(mesh.basecolor, at(mesh.uv))[:, :1]
        truth = 0.5 + 0.4 * torch.sin(60.0 * height)
        return float((found - truth).abs()[height.abs() < 0.25].mean())

    assert error(config) < 0.12
    assert error(config.model_copy(update={"correct_views": False})) > 0.2


def test_a_view_without_weight_paints_nothing(ctx):
    config = TINY.model_copy(update={"fit_iterations": 3})
    wrong = dataclasses.replace(VIEWS, basecolor=VIEWS.basecolor.clone())
    wrong.basecolor[1] = 1.0 - wrong.basecolor[1]
    weights = torch.ones(5)
    weights[1] = 0.0
    corrections = ViewCorrections(torch.zeros(5, 4, 2), weights)
    field = dataclasses.replace(sphere_field(bump=0.0), corrections=corrections)
    right = run(VIEWS, field, None, config=config, ctx=ctx)
    assert torch.equal(run(wrong, field, None, config=config, ctx=ctx).basecolor, right.basecolor)


def test_an_empty_surface_is_an_input_error(ctx):
    field = sphere_field()
    empty = dataclasses.replace(field, sdf=-torch.ones(8, 8, 8))
    with pytest.raises(InputError, match="wanted a surface to bake"):
        run(VIEWS, empty, None, config=TINY, ctx=ctx)


def test_inputs_match_the_pipeline():
    assert list(UV_BAKE.inputs) == ["views", "field", "surface", "plan"]
    assert UV_BAKE.output is TexturedMesh
