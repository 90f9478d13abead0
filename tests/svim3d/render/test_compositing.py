"""Compositing: homogeneous slab, NeuS opacity, backward passes against plain torch."""

import math

import torch

from svim3d.render.compositing import (
    accumulate,
    composite_weights,
    composite_weights_reference,
    density_opacity,
    surface_opacity,
)
from svim3d.render.march import Samples


def make_samples(counts):
    starts = torch.tensor([0, *counts]).cumsum(0)
    ray = torch.repeat_interleave(torch.arange(len(counts)), torch.tensor(counts))
    total = int(starts[-1])
    return Samples(torch.zeros(total, 3), torch.arange(total)[:, None] * 0.01, ray, starts)


def test_homogeneous_slab_transmits_exp_of_minus_density_times_depth():
    samples = make_samples([50, 0, 20])
    density, step = 3.0, 0.01
    opacity = density_opacity(torch.full((70, 1), density), step)
    seen = accumulate(composite_weights(opacity, samples), torch.ones(70, 1), samples)
    want = torch.tensor([[-math.expm1(-1.5)], [0.0], [-math.expm1(-0.6)]])
    torch.testing.assert_close(seen, want)


def test_weights_sum_to_what_does_not_pass():
    samples = make_samples([5, 9, 0, 1])
    opacity = torch.rand(15, 1, generator=torch.Generator().manual_seed(0))
    weights = composite_weights(opacity, samples)
    for ray in range(4):
        part = slice(int(samples.starts[ray]), int(samples.starts[ray + 1]))
        passed = (1.0 - opacity[part]).prod()
        torch.testing.assert_close(weights[part].sum(), 1.0 - passed)


def test_kernels_equal_plain_torch_in_values_and_gradients():
    generator = torch.Generator().manual_seed(1)
    samples = make_samples([7, 0, 30, 1, 12])
    opacity = (0.98 * torch.rand(50, 1, generator=generator)).requires_grad_()
    values = torch.randn(50, 4, generator=generator, requires_grad=True)
    upstream = torch.randn(5, 4, generator=generator)
    fast = accumulate(composite_weights(opacity, samples), values, samples)
    weights = composite_weights_reference(opacity, samples)
    plain = torch.zeros(5, 4).index_add(0, samples.ray, weights * values)
    torch.testing.assert_close(fast, plain)
    got = torch.autograd.grad(fast, (opacity, values), upstream)
    want = torch.autograd.grad(plain, (opacity, values), upstream)
    torch.testing.assert_close(got[0], want[0], atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(got[1], want[1])


def test_gradient_survives_full_opacity():
    samples = make_samples([4])
    opacity = torch.tensor([[0.2], [1.0], [0.5], [0.1]], requires_grad=True)
    upstream = torch.tensor([[1.0], [2.0], [3.0], [4.0]])
    (gradient,) = torch.autograd.grad(composite_weights(opacity, samples), opacity, upstream)
    # w = (a, (1-a) b, (1-a)(1-b) c, ...) at b = 1.
    want = [1.0 - 2.0, 0.8 * (2.0 - 3.0 * 0.5 - 0.5 * 4.0 * 0.1), 0.0, 0.0]
    torch.testing.assert_close(gradient[:, 0], torch.tensor(want))


def test_double_precision_passes_gradcheck():
    samples = make_samples([3, 2])
    opacity = torch.rand(5, 1, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    assert torch.autograd.gradcheck(
        lambda a: composite_weights(a, samples), (0.1 + 0.8 * opacity).requires_grad_()
    )


def test_surface_weights_peak_at_the_surface_and_sum_to_one():
    samples = make_samples([200])
    t = torch.linspace(-0.2, 0.2, 200)[:, None]
    step = 0.4 / 199
    for cosine in (1.0, 0.5):
        opacity = surface_opacity(cosine * t, torch.full_like(t, cosine), step, 100.0)
        weights = composite_weights(opacity, samples)
        assert abs(float(t[int(weights.argmax())])) <= step
        torch.testing.assert_close(weights.sum(), torch.tensor(1.0), atol=1e-4, rtol=0)
        # NeuS is unbiased to first order: the mean lies on the surface.
        assert abs(float((weights * t).sum())) < 0.2 * step / cosine


def test_leaving_a_surface_is_transparent_and_gradients_stay_finite():
    sdf = torch.tensor([[0.0], [5.0], [-5.0], [0.3]], requires_grad=True)
    slope = torch.tensor([[-1.0], [1.0], [1.0], [0.0]], requires_grad=True)
    opacity = surface_opacity(sdf, slope, 0.01, 1000.0)
    assert opacity[0] == 0.0 and opacity[3] == 0.0
    assert 0.99 < float(opacity[1].detach()) <= 1.0
    assert float(opacity[2].detach()) < 1e-6
    for gradient in torch.autograd.grad(opacity.sum(), (sdf, slope)):
        assert bool(torch.isfinite(gradient).all())
