"""Trilinear signed distance: exact for linear fields, kernels against plain torch."""

import torch

from svim3d.fields.sdf_grid import node_positions, resample_grid, sample_reference, sample_sdf

HALF_EXTENT = 0.55
SLOPE = torch.tensor([0.3, -0.8, 0.5])


def linear_grid(nodes):
    return node_positions(nodes, HALF_EXTENT, like=SLOPE) @ SLOPE + 0.1


def test_linear_field_has_exact_value_and_gradient_even_outside():
    points = 1.4 * torch.rand(400, 3, generator=torch.Generator().manual_seed(0)) - 0.7
    value, gradient = sample_sdf(linear_grid(12), points, HALF_EXTENT)
    torch.testing.assert_close(value[:, 0], points @ SLOPE + 0.1, atol=1e-6, rtol=0)
    torch.testing.assert_close(gradient, SLOPE.expand_as(gradient), atol=2e-5, rtol=0)


def test_kernels_equal_plain_torch_in_values_and_gradients():
    generator = torch.Generator().manual_seed(1)
    grid = torch.randn(20, 20, 20, generator=generator, requires_grad=True)
    points = 1.2 * torch.rand(4000, 3, generator=generator) - 0.6
    fast = torch.cat(sample_sdf(grid, points, HALF_EXTENT), -1)
    plain = sample_reference(grid, points, HALF_EXTENT)
    # A position in cells is rounded differently; the gradient magnifies that by nodes per unit.
    torch.testing.assert_close(fast, plain, atol=1e-3, rtol=1e-4)
    weights = torch.randn(fast.shape, generator=generator)
    (got,) = torch.autograd.grad(fast, grid, weights)
    (want,) = torch.autograd.grad(plain, grid, weights)
    torch.testing.assert_close(got, want, atol=2e-3, rtol=1e-4)


def test_gradient_is_the_derivative_of_the_value():
    generator = torch.Generator().manual_seed(2)
    grid = torch.randn(6, 6, 6, generator=generator, dtype=torch.float64)
    cells = torch.randint(0, 5, (50, 3), generator=generator)
    inside = 0.2 + 0.6 * torch.rand(50, 3, generator=generator, dtype=torch.float64)
    points = (cells + inside) * (2 * HALF_EXTENT / 5) - HALF_EXTENT
    _, gradient = sample_sdf(grid, points, HALF_EXTENT)
    for axis in range(3):
        step = torch.zeros(3, dtype=torch.float64)
        step[axis] = 1e-6
        ahead, _ = sample_sdf(grid, points + step, HALF_EXTENT)
        behind, _ = sample_sdf(grid, points - step, HALF_EXTENT)
        torch.testing.assert_close(
            gradient[:, axis], ((ahead - behind) / 2e-6)[:, 0], atol=1e-6, rtol=1e-6
        )


def test_value_and_gradient_pass_gradcheck_in_the_grid():
    generator = torch.Generator().manual_seed(3)
    grid = torch.randn(3, 3, 3, generator=generator, dtype=torch.float64, requires_grad=True)
    points = torch.rand(5, 3, generator=generator, dtype=torch.float64) - 0.5
    assert torch.autograd.gradcheck(lambda g: sample_sdf(g, points, HALF_EXTENT), (grid,))


def test_resampling_keeps_linear_fields_and_equals_torch():
    torch.testing.assert_close(resample_grid(linear_grid(7), 19), linear_grid(19))
    grid = torch.randn(6, 6, 6, generator=torch.Generator().manual_seed(4))
    want = torch.nn.functional.interpolate(
        grid[None, None], size=(11, 11, 11), mode="trilinear", align_corners=True
    )[0, 0]
    torch.testing.assert_close(resample_grid(grid, 11), want, atol=1e-5, rtol=1e-5)
    assert torch.equal(resample_grid(grid, 6), grid)
