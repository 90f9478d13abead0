"""Loss terms: zero where they should be, exact where a value is known."""

import math

import torch

from svim3d.render import ray_losses


def test_tone_curve_is_normalised_and_unbounded():
    x = torch.tensor([[0.0, 1.0, 100.0]])
    want = torch.tensor([[0.0, 1.0, math.log(1001.0) / math.log(11.0)]])
    torch.testing.assert_close(ray_losses.tonemap(x), want)


def test_losses_vanish_on_equal_inputs():
    color = torch.rand(5, 4, 3)
    assert float(ray_losses.color_loss(color, color)) == 0.0
    assert float(ray_losses.radiance_loss(color, color)) == 0.0
    assert float(ray_losses.absolute_loss(color, color)) == 0.0
    assert float(ray_losses.squared_loss(color, color)) == 0.0


def test_mask_loss_is_the_entropy_at_best():
    half = torch.full((2, 4, 1), 0.5)
    torch.testing.assert_close(ray_losses.mask_loss(half, half), torch.tensor(math.log(2.0)))
    full = torch.ones(2, 4, 1)
    assert float(ray_losses.mask_loss(full, full)) < 2e-4
    assert math.isfinite(float(ray_losses.mask_loss(full, 0.0 * full)))


def test_unit_gradient_loss_is_the_mean_squared_excess():
    gradient = torch.tensor([[2.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    torch.testing.assert_close(ray_losses.unit_gradient_loss(gradient), torch.tensor(0.5))
    assert float(ray_losses.unit_gradient_loss(torch.zeros(0, 3))) == 0.0


def test_bilateral_loss_smooths_plain_areas_and_spares_edges():
    values = torch.tensor([[[0.0], [1.0], [0.0], [1.0]]])  # a vertical edge
    mask = torch.ones(1, 4, 1)
    plain = torch.zeros(1, 4, 3)
    edge = plain + values
    # Two of the four pairs differ, by one each.
    torch.testing.assert_close(ray_losses.bilateral_loss(values, plain, mask), torch.tensor(0.5))
    spared = 0.5 * math.exp(-3.0 * math.sqrt(3.0))
    torch.testing.assert_close(ray_losses.bilateral_loss(values, edge, mask), torch.tensor(spared))
    assert float(ray_losses.bilateral_loss(values, plain, 0.0 * mask)) == 0.0


def test_depth_smoothness_counts_small_steps_only():
    mask = torch.ones(1, 4, 1)
    slope = torch.tensor([[[0.0], [1.0], [0.0], [1.0]]]) * 0.01
    want = 2.0 / 4.0 * (1.0 / ray_losses.MAX_DEPTH_STEP) ** 2
    torch.testing.assert_close(
        ray_losses.depth_smoothness_loss(slope, mask, 0.01), torch.tensor(want)
    )
    assert float(ray_losses.depth_smoothness_loss(100.0 * slope, mask, 0.01)) == 0.0


def test_a_weight_of_one_changes_no_bit_of_value_or_gradient():
    """Phases 1 and 2 give the same bytes with a uniform confidence as without any."""
    generator = torch.Generator().manual_seed(0)
    target = torch.rand(9, 4, 3, generator=generator)
    start = torch.rand(9, 4, 3, generator=generator)
    one, zero = torch.ones(9, 4, 1), torch.zeros(9, 4, 1)
    for loss, channels in (
        (ray_losses.color_loss, 3),
        (ray_losses.radiance_loss, 3),
        (ray_losses.absolute_loss, 3),
        (ray_losses.squared_loss, 3),
        (ray_losses.mask_loss, 1),
    ):
        results = []
        for weight in (None, one, zero):
            rendered = start[..., :channels].clone().requires_grad_()
            value = loss(rendered, target[..., :channels], weight)
            value.backward()
            results.append((value.detach(), rendered.grad))
        assert torch.equal(results[0][0], results[1][0]), loss
        assert torch.equal(results[0][1], results[1][1]), loss
        assert not results[2][0].any() and not results[2][1].any(), loss


def test_an_untrusted_guide_shows_no_edges():
    radiance = torch.rand(3, 4, 3)
    assert torch.equal(ray_losses.smoothing_guide(radiance, None), ray_losses.tonemap(radiance))
    assert not ray_losses.smoothing_guide(radiance, torch.zeros(3, 4, 1)).any()
