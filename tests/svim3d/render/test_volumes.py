"""Both volumes against an exact sphere: where they stop rays and what surface they report."""

import pytest
import torch

from svim3d.fields.hash_grid import HashGridSpec
from svim3d.fields.sdf_grid import node_positions
from svim3d.numerics import normalize
from svim3d.render.march import EMPTY, Rays
from svim3d.render.volumes import DensityVolume, SdfVolume

HALF_EXTENT, RADIUS, NODES = 0.55, 0.35, 40
SPEC = HashGridSpec(levels=4, log2_entries=12, coarsest=4, finest=32)


def sphere_sdf(nodes=NODES):
    return RADIUS - node_positions(nodes, HALF_EXTENT, like=torch.zeros(1)).norm(dim=-1)


def make_rays(count=200):
    generator = torch.Generator().manual_seed(0)
    origins = 2.0 * normalize(torch.randn(count, 3, generator=generator))
    targets = 0.2 * (torch.rand(count, 3, generator=generator) - 0.5)
    return Rays(origins, normalize(targets - origins)), torch.rand(count, generator=generator)


def exact_hits(rays):
    along = -(rays.origins * rays.directions).sum(-1)
    gap = rays.origins.square().sum(-1) - along.square()
    return along - (RADIUS**2 - gap).sqrt()


def mean_depth(seen, rays):
    depth = torch.zeros(len(rays), 1).index_add(
        0, seen.samples.ray, seen.weights * seen.samples.distance
    )
    total = torch.zeros(len(rays), 1).index_add(0, seen.samples.ray, seen.weights)
    return (depth / total)[:, 0]


def test_sharp_distance_stops_rays_at_the_sphere_with_its_normal():
    volume = SdfVolume(sphere_sdf(), HALF_EXTENT)
    volume.sharpness = 1000.0
    volume.refresh()
    rays, jitter = make_rays()
    seen = volume.trace(rays, jitter, 1e-3)
    torch.testing.assert_close(seen.coverage, torch.ones_like(seen.coverage), atol=2e-3, rtol=0)
    error = mean_depth(seen, rays) - exact_hits(rays)
    assert float(error.detach().abs().max()) < 0.5 * volume.cell
    outward = normalize(-seen.gradient)
    cosine = (outward * normalize(seen.samples.points)).sum(-1)
    assert float(cosine.detach().min()) > 0.99


def test_distance_is_the_sum_of_all_grids_and_resampling_keeps_it():
    volume = SdfVolume(sphere_sdf(), HALF_EXTENT, coarse_nodes=(4, 8))
    torch.testing.assert_close(volume.distance(), sphere_sdf(), atol=1e-6, rtol=0)
    with torch.no_grad():
        volume.coarse[0].add_(0.02)
        volume.coarse[1].sub_(0.005)
    torch.testing.assert_close(volume.distance(), sphere_sdf() + 0.015, atol=1e-6, rtol=0)
    volume.resample(2 * NODES - 1, (4,))
    torch.testing.assert_close(volume.distance()[::2, ::2, ::2], sphere_sdf() + 0.015)
    assert [len(grid) for grid in volume.coarse] == [4]
    assert torch.count_nonzero(volume.coarse[0]) == 0


def test_band_narrows_as_the_transition_sharpens():
    volume = SdfVolume(sphere_sdf(), HALF_EXTENT)
    counts = []
    for sharpness in (20.0, 40.0, 2000.0):
        volume.sharpness = sharpness
        volume.refresh()
        counts.append(int((volume.cells == 1).sum()))
    assert counts[0] > counts[1] > counts[2] > 0
    # Two cells on either side remain, so that the surface can still move.
    assert counts[2] * volume.cell**3 >= 4 * 3.14 * RADIUS**2 * 3 * volume.cell


@pytest.fixture(scope="module")
def dense_sphere():
    """A density field trained to be opaque inside the sphere and empty outside."""
    volume = DensityVolume(SPEC, sphere_sdf() + 0.08, HALF_EXTENT, threshold=50.0)
    generator = torch.Generator().manual_seed(0)
    volume.reset(generator)
    optimizer = torch.optim.Adam(volume.parameters(), lr=2e-2, betas=(0.9, 0.99))
    for _ in range(200):
        points = (2.0 * torch.rand(2048, 3, generator=generator) - 1.0) * 0.5
        wanted = (50.0 * (RADIUS - points.norm(dim=-1, keepdim=True))).clamp(-4.0, 4.0) + 3.9
        loss = (volume.field(points) - wanted).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    for step in range(80):
        volume.refresh(torch.Generator().manual_seed(step))
    return volume


def test_density_stops_rays_at_the_sphere_with_its_normal(dense_sphere):
    rays, jitter = make_rays()
    seen = dense_sphere.trace(rays, jitter, 1e-3)
    assert float(seen.coverage.detach().min()) > 0.98
    error = mean_depth(seen, rays) - exact_hits(rays)
    assert float(error.detach().abs().mean()) < 0.02
    heavy = seen.weights[:, 0] > 0.05
    cosine = (normalize(-seen.gradient) * normalize(seen.samples.points)).sum(-1)[heavy]
    assert float(cosine.detach().mean()) > 0.95


def test_density_becomes_a_distance_of_unit_gradient(dense_sphere):
    sdf = dense_sphere.signed_distance(NODES)
    exact = sphere_sdf()
    near = exact.abs() < 0.03
    assert float((sdf - exact)[near].abs().mean()) < 0.01
    gradient = torch.stack(torch.gradient(sdf, spacing=2 * HALF_EXTENT / (NODES - 1))).norm(dim=0)
    assert 0.8 < float(gradient[near].mean()) < 1.2


def test_occupancy_empties_what_is_thin_and_never_leaves_the_hull(dense_sphere):
    cells = dense_sphere.cells
    corner = node_positions(64, HALF_EXTENT, like=torch.zeros(1)) + HALF_EXTENT / 64
    radius = corner.norm(dim=-1)
    assert bool((cells[radius > RADIUS + 0.14] == EMPTY).all())
    assert bool((cells[(radius < RADIUS) & (radius > RADIUS - 0.05)] != EMPTY).all())
