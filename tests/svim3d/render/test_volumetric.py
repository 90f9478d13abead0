"""Rendering a sharp sphere of one material: composites, normals, depth and deferred shading."""

import pytest
import torch

from svim3d.fields.material_field import MaterialField, MaterialFieldSpec
from svim3d.fields.sdf_grid import node_positions
from svim3d.numerics import normalize
from svim3d.render.march import Rays
from svim3d.render.volumes import SdfVolume
from svim3d.render.volumetric import render_rays
from svim3d.shading.prefilter import PyramidOperator
from svim3d.shading.split_sum import shade

HALF_EXTENT, RADIUS = 0.55, 0.35


@pytest.fixture(scope="module")
def scene():
    """A sharp sphere, a field whose only parameters that matter are the output biases, and rays."""
    sdf = RADIUS - node_positions(64, HALF_EXTENT, like=torch.zeros(1)).norm(dim=-1)
    volume = SdfVolume(sdf, HALF_EXTENT)
    volume.sharpness = 1500.0
    volume.refresh()
    materials = MaterialField(
        MaterialFieldSpec(levels=2, log2_entries=8, coarsest=4, finest=8, hidden=4)
    )
    materials.reset(torch.Generator().manual_seed(0))
    with torch.no_grad():
        materials.network.second.weight.zero_()
        materials.network.second.bias[3:5] = torch.tensor([0.1, -0.2])
    generator = torch.Generator().manual_seed(1)
    origins = 2.0 * normalize(torch.randn(64, 3, generator=generator))
    targets = 0.3 * (torch.rand(64, 3, generator=generator) - 0.5)
    rays = Rays(origins, normalize(targets - origins))
    return volume, materials, rays, torch.rand(64, generator=generator)


def hit_points(rays):
    along = -(rays.origins * rays.directions).sum(-1, keepdim=True)
    gap = rays.origins.square().sum(-1, keepdim=True) - along.square()
    distance = along - (RADIUS**2 - gap).sqrt()
    return distance, rays.origins + distance * rays.directions


def render(scene, pyramid=None, rays=None, **rest):
    volume, materials, own, jitter = scene
    rays = own if rays is None else rays
    return render_rays(
        volume,
        materials,
        rays,
        jitter=jitter[: len(rays)],
        pyramid=pyramid,
        min_weight=0.01,
        **rest,
    )


def test_constant_material_is_seen_unchanged(scene):
    seen = render(scene)
    ones = torch.ones(64, 1)
    torch.testing.assert_close(seen.mask, ones, atol=1e-3, rtol=0)
    torch.testing.assert_close(seen.roughness, 0.6 * ones, atol=1e-3, rtol=0)
    torch.testing.assert_close(seen.metallic, 0.3 * ones, atol=1e-3, rtol=0)
    assert seen.radiance is None


def test_normals_and_depth_are_the_spheres(scene):
    seen = render(scene)
    distance, points = hit_points(scene[2])
    torch.testing.assert_close(seen.depth, distance, atol=3e-3, rtol=0)
    cosine = (normalize(seen.normal_geometric) * normalize(points)).sum(-1)
    assert float(cosine.detach().min()) > 0.998
    torch.testing.assert_close(seen.normal_shading, seen.normal_geometric)


def test_bump_turns_the_shading_normal_alone(scene):
    bias = scene[1].network.second.bias
    with torch.no_grad():
        bias[5:] = torch.tensor([0.0, 0.5, 0.0])
    bumped, smooth = render(scene), render(scene, use_bump=False)
    with torch.no_grad():
        bias[5:] = 0.0
    torch.testing.assert_close(bumped.normal_geometric, smooth.normal_geometric)
    want = normalize(normalize(smooth.normal_geometric) + torch.tensor([0.0, 0.5, 0.0]))
    torch.testing.assert_close(normalize(bumped.normal_shading), want, atol=5e-3, rtol=0)


def test_radiance_is_the_shaded_composite_and_reaches_every_parameter(scene):
    light = (
        torch.rand(16, 16, 3, generator=torch.Generator().manual_seed(2)) + 0.2
    ).requires_grad_()
    pyramid = PyramidOperator.build(16)(light)
    seen = render(scene, pyramid)
    want = shade(
        normalize(seen.normal_shading),
        -scene[2].directions,
        seen.basecolor / seen.mask,
        seen.roughness / seen.mask,
        seen.metallic / seen.mask,
        pyramid,
    ).radiance
    torch.testing.assert_close(seen.radiance, want * seen.mask, atol=1e-5, rtol=1e-4)
    parameters = [light, scene[0].grid, scene[1].network.second.bias]
    for gradient in torch.autograd.grad(seen.radiance.sum(), parameters):
        assert bool(torch.isfinite(gradient).all())
        assert float(gradient.abs().sum()) > 0.0


def test_rays_that_miss_are_black_and_harmless(scene):
    past = Rays(torch.tensor([[0.0, 5.0, 2.0]]), torch.tensor([[0.0, 0.0, -1.0]]))
    light = torch.ones(16, 16, 3, requires_grad=True)
    seen = render(scene, PyramidOperator.build(16)(light), rays=past)
    for image in (seen.mask, seen.basecolor, seen.radiance, seen.depth):
        assert torch.count_nonzero(image) == 0
    (gradient,) = torch.autograd.grad(seen.radiance.sum(), light)
    assert torch.count_nonzero(gradient) == 0
