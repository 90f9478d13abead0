"""Hash encoding: kernels against plain torch, exact dense levels, gradients."""

import pytest
import torch

from svim3d.fields.hash_grid import HashGrid, HashGridSpec, encode_reference

HASHED = HashGridSpec(levels=4, log2_entries=9, coarsest=4, finest=64)
DENSE = HashGridSpec(levels=1, log2_entries=12, coarsest=8, finest=8)


def make_grid(spec, seed=0):
    generator = torch.Generator().manual_seed(seed)
    grid = HashGrid(spec)
    with torch.no_grad():
        grid.table.copy_(torch.randn(grid.table.shape, generator=generator))
    return grid, generator


def test_levels_grow_geometrically_and_store_what_fits():
    spec = HashGridSpec(levels=3, log2_entries=10, coarsest=4, finest=16)
    assert spec.resolutions == [4, 8, 16]
    assert spec.sizes == [125, 729, 1024]  # 17^3 nodes do not fit into 1024 entries
    assert spec.hash_masks == [0, 0, 1023]
    assert spec.offsets == [0, 125, 854, 1878]


def test_kernels_equal_plain_torch_in_values_and_gradients():
    grid, generator = make_grid(HASHED)
    # Positions outside the unit cube are clamped to it.
    points = (1.2 * torch.rand(3000, 3, generator=generator) - 0.1).requires_grad_()
    weights = torch.randn(3000, grid.width, generator=generator)
    fast = grid(points)
    plain = encode_reference(points, grid.table, HASHED)
    torch.testing.assert_close(fast, plain, atol=2e-6, rtol=1e-5)
    got = torch.autograd.grad(fast, (points, grid.table), weights)
    want = torch.autograd.grad(plain, (points, grid.table), weights)
    torch.testing.assert_close(got[0], want[0], atol=2e-3, rtol=1e-4)
    torch.testing.assert_close(got[1], want[1], atol=2e-4, rtol=1e-4)


def test_dense_level_reproduces_a_linear_function():
    grid, generator = make_grid(DENSE)
    axis = torch.linspace(0.0, 1.0, 9)
    z, y, x = torch.meshgrid(axis, axis, axis, indexing="ij")  # rows run fastest along x
    with torch.no_grad():
        grid.table[:, 0] = (1.0 + 2.0 * x - 3.0 * y + 0.5 * z).reshape(-1)
        grid.table[:, 1] = z.reshape(-1)
    points = torch.rand(500, 3, generator=generator)
    want = 1.0 + points @ torch.tensor([2.0, -3.0, 0.5])
    encoded = grid(points)
    torch.testing.assert_close(encoded[:, 0], want, atol=2e-6, rtol=0)
    torch.testing.assert_close(encoded[:, 1], points[:, 2], atol=1e-6, rtol=0)


def test_gradients_pass_gradcheck_in_double_precision():
    grid, generator = make_grid(HashGridSpec(levels=2, log2_entries=5, coarsest=2, finest=5))
    table = grid.table.detach().double().requires_grad_()
    points = torch.rand(6, 3, generator=generator, dtype=torch.float64).requires_grad_()
    assert torch.autograd.gradcheck(lambda x, t: encode_reference(x, t, grid.spec), (points, table))


def test_results_do_not_depend_on_the_run():
    grid, generator = make_grid(HASHED)
    points = torch.rand(5000, 3, generator=generator)
    gradients = []
    for _ in range(2):
        grid.table.grad = None
        grid(points).square().sum().backward()
        gradients.append(grid.table.grad)
    assert torch.equal(*gradients)


def test_reset_is_small_and_seeded():
    grids = [HashGrid(HASHED) for _ in range(2)]
    for grid in grids:
        grid.reset(torch.Generator().manual_seed(3))
    assert torch.equal(grids[0].table, grids[1].table)
    assert 0.0 < float(grids[0].table.detach().abs().max()) <= 1e-4


@pytest.mark.gpu
def test_cuda_equals_cpu():
    grid, generator = make_grid(HASHED)
    points = torch.rand(1000, 3, generator=generator)
    torch.testing.assert_close(
        grid.cuda()(points.cuda()).cpu(), encode_reference(points, grid.table.cpu(), HASHED)
    )
