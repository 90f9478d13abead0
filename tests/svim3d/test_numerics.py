"""Guarded operations: exact where they can be, finite where they must be."""

import torch

from svim3d import numerics


def test_normalize_is_unit_and_keeps_zero():
    v = torch.tensor([[3.0, 4.0, 0.0], [0.0, 0.0, 0.0]])
    n = numerics.normalize(v)
    assert torch.equal(n[0], torch.tensor([0.6, 0.8, 0.0]))
    assert torch.equal(n[1], torch.zeros(3))


def test_gradient_of_normalize_is_finite_at_zero():
    v = torch.zeros(1, 3, requires_grad=True)
    numerics.normalize(v).sum().backward()
    assert torch.isfinite(v.grad).all()


def test_reflect_matches_closed_form():
    normal = torch.tensor([[0.0, 1.0, 0.0]])
    wo = numerics.normalize(torch.tensor([[1.0, 1.0, 0.0]]))
    assert torch.allclose(numerics.reflect(wo, normal), wo * torch.tensor([-1.0, 1.0, 1.0]))


def test_smoothstep_values_and_clamps():
    x = torch.tensor([-1.0, 0.0, 0.25, 0.5, 1.0, 2.0])
    expected = torch.tensor([0.0, 0.0, 0.15625, 0.5, 1.0, 1.0])
    assert torch.equal(numerics.smoothstep(x), expected)
