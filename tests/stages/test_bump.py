"""The bump field: fitted from half of phase 1 on, and found again in the baked normal map."""

import pytest
import torch
from sphere_orbit import RADIUS, sphere_cameras, sphere_images

from stages.artifacts import MaterialViews
from stages.nerf import run as fit
from stages.settings.nerf import NerfConfig
from stages.settings.uv_bake import UvBakeConfig
from stages.uv_bake import run as bake
from svim3d.fields.material_field import MaterialField
from svim3d.mesh.frames import bitangents, world_from_tangent
from svim3d.mesh.mesh import face_normals_scaled
from svim3d.numerics import dot, normalize
from svim3d.raster.texture import sample_texture

CONFIG = NerfConfig(
    steps=240,
    rays_per_step=1024,
    grid_nodes=(16,),
    grid_shares=(0.0,),
    coarse_nodes=(8,),
    hash_levels=5,
    hash_log2_entries=13,
    hash_finest=64,
    hidden=32,
    network_rate=0.03,
    final_rate=0.3,
    environment_size=16,
    warp_start=1.0,
)
BAKE = UvBakeConfig(texture_size=128, max_faces=600, occlusion_rays=0, fit_iterations=0)
RIPPLE, STEEPNESS = 50.0, 0.5  # per world unit: waves of two cells, too short for the surface


def rippled(direction):
    """Shading normals of a sphere with relief in its normals alone, by unit direction."""
    waves = STEEPNESS * torch.sin(RIPPLE * RADIUS * direction)
    return normalize(direction + waves - direction * dot(direction, waves))


@pytest.fixture(scope="module")
def views():
    cameras = sphere_cameras(views=9, size=64)
    images = sphere_images(cameras)
    images["normal_world"] = rippled(images["normal_world"]) * images["mask"]
    return MaterialViews(cameras=cameras, reference=8, **images)


def bump_at(fitted, points):
    field = MaterialField(fitted.material_spec)
    field.load_state_dict(fitted.material_state)
    with torch.no_grad():
        return field(points).bump


def test_bump_is_fitted_from_its_share_of_the_steps_on(views, make_context):
    points = RADIUS * normalize(torch.randn(50, 3, generator=torch.Generator().manual_seed(0)))
    # The last of the steps is the first that fits it.
    for start, fitted_in in ((0.76, False), (0.75, True)):
        config = CONFIG.model_copy(update={"steps": 4, "bump_start": start})
        fitted = fit(views, None, config=config, ctx=make_context("nerf"))
        assert bool((bump_at(fitted, points) != 0.0).any()) == fitted_in


def error_deg(views, bump_start, make_context):
    """Mean angle between what the asset's normal map restores and the truth, on what is seen."""
    config = CONFIG.model_copy(update={"bump_start": bump_start})
    fitted = fit(views, None, config=config, ctx=make_context("nerf"))
    mesh = bake(views, fitted, None, config=BAKE, ctx=make_context("uv_bake"))
    area = face_normals_scaled(mesh.vertices, mesh.faces).norm(dim=1)
    chosen = torch.multinomial(area, 4000, True, generator=torch.Generator().manual_seed(1))
    corners = mesh.faces[chosen].long()

    def at(attribute):
        return attribute[corners].mean(1)

    local = sample_texture(mesh.normal_tangent, at(mesh.uv))
    frame = at(mesh.normals), at(mesh.tangents[:, :3])
    restored = world_from_tangent(local, *frame, at(bitangents(mesh.normals, mesh.tangents)))
    direction = normalize(at(mesh.vertices))
    truth = rippled(direction)
    cosine = dot(normalize(restored), truth)[:, 0].clamp(-1.0, 1.0)
    seen = direction[:, 1].abs() < 0.6
    return float(torch.rad2deg(torch.acos(cosine))[seen].mean())


@pytest.mark.slow
def test_relief_that_only_normals_show_ends_in_the_baked_map(views, make_context):
    without = error_deg(views, 1.0, make_context)
    bumped = error_deg(views, 0.5, make_context)
    assert bumped < 0.7 * without
