"""Transfer curve and luminance against the standard's own numbers."""

import pytest
import torch

from svim3d import color


def test_srgb_half_decodes_to_the_standard_value():
    assert float(color.linear_from_srgb(torch.tensor(0.5))) == pytest.approx(0.2140411, abs=1e-6)


def test_srgb_round_trip_over_the_whole_range():
    x = torch.linspace(0.0, 1.0, 4097, dtype=torch.float64)
    # The standard's two published knees differ in the eighth digit, which bounds the round trip.
    assert torch.allclose(color.linear_from_srgb(color.srgb_from_linear(x)), x, atol=1e-7)


def test_curve_is_differentiable_at_black():
    x = torch.zeros(1, requires_grad=True)
    color.srgb_from_linear(x).sum().backward()
    assert float(x.grad) == pytest.approx(12.92)


def test_luminance_of_white_is_one():
    assert float(color.luminance(torch.ones(1, 3))) == pytest.approx(1.0, abs=1e-6)
