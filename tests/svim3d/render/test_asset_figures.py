import pytest
import torch
from scored_sphere import ball
from sphere_orbit import sphere_cameras, sphere_images

from svim3d.render.asset_figures import light_figures, shade_images, visible
from svim3d.shading.environment import latlong_solid_angles


def test_inner_walls_are_not_seen_and_outer_ones_are():
    outer, inner = ball(0.5), ball(0.4)
    vertices = torch.cat([outer.vertices, inner.vertices])
    faces = torch.cat([outer.faces, inner.faces + len(outer.vertices)])
    seen = visible(vertices, vertices, faces)
    assert bool(seen[: len(outer.vertices)].all())
    assert not bool(seen[len(outer.vertices) :].any())


@pytest.mark.parametrize("name", ["light_error", "light_error_blocks"])
def test_light_errors_of_scaled_light_and_of_fine_detail(name):
    generator = torch.Generator().manual_seed(0)
    light = torch.rand(32, 64, 3, generator=generator)
    assert light_figures(light, light)[name] == 0.0
    assert light_figures(1.25 * light, light)[name] == pytest.approx(0.25, abs=1e-6)
    # Detail finer than 16 x 32 hardly counts: half the light's size here, gone after blurring.
    checker = 0.5 * (-1.0) ** (torch.arange(64)[None, :, None] + torch.arange(32)[:, None, None])
    even = latlong_solid_angles(32, 64, light)
    detailed = (1.0 + checker * even.min() / even).expand(-1, -1, 3)
    assert light_figures(detailed, torch.ones(32, 64, 3))[name] < 0.02


def test_true_images_shaded_by_their_own_colour():
    cameras = sphere_cameras(3, 24)
    images = sphere_images(cameras)
    shown = shade_images(images, cameras, 1, lambda normal, wo, materials: materials.basecolor)
    assert torch.equal(shown, images["basecolor"][1] * images["mask"][1])
