"""Ray march: covers what may hold surface, stops in solid, kernel equals plain torch."""

import math

import pytest
import torch

from svim3d.fields.sdf_grid import node_positions
from svim3d.numerics import normalize
from svim3d.render.march import (
    EMPTY,
    SOLID,
    SURFACE,
    Rays,
    classify_cells,
    hits_surface,
    march,
    march_reference,
)

HALF_EXTENT, STEP = 0.55, 0.01


def make_rays(count=300, seed=0):
    generator = torch.Generator().manual_seed(seed)
    origins = 2.0 * normalize(torch.randn(count, 3, generator=generator))
    targets = torch.rand(count, 3, generator=generator) - 0.5
    return Rays(origins, normalize(targets - origins)), torch.rand(count, generator=generator)


def sphere_cells(band=0.05, nodes=25):
    sdf = 0.35 - node_positions(nodes, HALF_EXTENT, like=torch.zeros(1)).norm(dim=-1)
    return sdf, classify_cells(sdf, band)


def test_full_cube_is_sampled_evenly_from_entry_to_exit():
    rays, jitter = make_rays()
    cells = torch.full((8, 8, 8), SURFACE, dtype=torch.uint8)
    samples = march(rays, cells, half_extent=HALF_EXTENT, step=STEP, jitter=jitter)
    assert float(samples.points.abs().max()) <= HALF_EXTENT + 1e-5
    counts = samples.starts.diff()
    gaps = samples.distance.diff(dim=0)[:, 0]
    within = samples.ray.diff() == 0
    torch.testing.assert_close(gaps[within], torch.full_like(gaps[within], STEP), atol=1e-5, rtol=0)
    near = ((rays.origins.abs() - HALF_EXTENT) / rays.directions.abs()).amax(-1)
    first = samples.distance[samples.starts[:-1][counts > 0], 0]
    torch.testing.assert_close(first, (near + STEP * jitter)[counts > 0], atol=1e-4, rtol=0)
    on_ray = rays.origins[samples.ray] + samples.distance * rays.directions[samples.ray]
    torch.testing.assert_close(samples.points, on_ray)


def test_kernel_equals_plain_torch():
    rays, jitter = make_rays()
    _, cells = sphere_cells()
    assert {EMPTY, SURFACE, SOLID} == set(cells.unique().tolist())
    fast = march(rays, cells, half_extent=HALF_EXTENT, step=STEP, jitter=jitter)
    plain = march_reference(rays, cells, half_extent=HALF_EXTENT, step=STEP, jitter=jitter)
    # A sample on a cell's border may fall to either side.
    assert abs(len(fast) - len(plain)) <= 3
    same = fast.starts.diff() == plain.starts.diff()
    assert int((~same).sum()) <= 3
    kept = same[fast.ray], same[plain.ray]
    torch.testing.assert_close(fast.points[kept[0]], plain.points[kept[1]], atol=1e-5, rtol=0)


def test_every_first_crossing_of_a_sphere_is_bracketed():
    rays, jitter = make_rays()
    _, cells = sphere_cells()
    samples = march(rays, cells, half_extent=HALF_EXTENT, step=STEP, jitter=jitter)
    along = -(rays.origins * rays.directions).sum(-1)
    gap = rays.origins.square().sum(-1) - along.square()
    hit = gap < 0.3**2
    t = along - (0.35**2 - gap).clamp_min(0).sqrt()
    for ray in torch.nonzero(hit)[:, 0].tolist():
        distance = samples.distance[samples.starts[ray] : samples.starts[ray + 1], 0]
        assert float(distance.min()) < float(t[ray]) < float(distance.max())
    # The solid ends the ray: nothing is sampled on the far side.
    deep = gap < 0.2**2
    far_side = samples.distance[:, 0] > along[samples.ray]
    assert not bool((far_side & deep[samples.ray]).any())


def test_classification_is_exact_and_device_independent_code_agrees():
    sdf, cells = sphere_cells()
    torch.testing.assert_close(classify_cells(sdf.double(), 0.05), cells)
    corners = torch.stack(
        [sdf[i : i + 24, j : j + 24, k : k + 24] for i in (0, 1) for j in (0, 1) for k in (0, 1)]
    )
    assert torch.equal(cells == EMPTY, (corners <= -0.05).all(0))
    assert torch.equal(cells == SOLID, (corners >= 0.05).all(0))


def test_select_keeps_the_grouping():
    rays, jitter = make_rays(40)
    _, cells = sphere_cells()
    samples = march(rays, cells, half_extent=HALF_EXTENT, step=STEP, jitter=jitter)
    chosen = torch.arange(0, len(samples), 3)
    part = samples.select(chosen)
    for ray in range(40):
        assert bool((part.ray[part.starts[ray] : part.starts[ray + 1]] == ray).all())
    assert int(part.starts[-1]) == len(part) == len(chosen)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_axis_parallel_rays_and_rays_that_miss(axis):
    direction = torch.zeros(3)
    direction[axis] = 1.0
    through, past = -2.0 * direction, -2.0 * direction + 1.0 - direction
    rays = Rays(torch.stack([through, past]), direction.expand(2, 3))
    cells = torch.full((4, 4, 4), SURFACE, dtype=torch.uint8)
    hits = hits_surface(rays, cells, half_extent=HALF_EXTENT, step=STEP)
    assert hits.tolist() == [True, False]
    count = march(
        rays, cells, half_extent=HALF_EXTENT, step=STEP, jitter=torch.full((2,), 0.5)
    ).starts[1]
    assert int(count) == math.floor(2 * HALF_EXTENT / STEP + 0.5)
