import numpy as np
import pytest
import torch

from svim3d.metrics.alignment import (
    align_scale,
    align_scale_and_shift,
    least_squares_scale,
    least_squares_scale_and_shift,
)


def draw(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed))


@pytest.fixture
def mask() -> torch.Tensor:
    return draw(7, 9, 1, seed=3) > 0.4


def test_scale_is_numpys_least_squares(mask):
    image, truth = draw(7, 9, 3), draw(7, 9, 3, seed=1)
    inside = mask[..., 0].numpy()
    for channel, found in enumerate(least_squares_scale(image, truth, mask)):
        x, y = (t[..., channel].double().numpy()[inside] for t in (image, truth))
        (expected,), *_ = np.linalg.lstsq(x[:, None], y, rcond=None)
        assert float(found) == pytest.approx(expected, rel=1e-6)


def test_scale_and_shift_are_numpys_least_squares(mask):
    image, truth = draw(7, 9, 2), draw(7, 9, 2, seed=1)
    inside = mask[..., 0].numpy()
    scale, shift = least_squares_scale_and_shift(image, truth, mask)
    for channel in range(2):
        x, y = (t[..., channel].double().numpy()[inside] for t in (image, truth))
        expected = np.polyfit(x, y, 1)
        assert [float(scale[channel]), float(shift[channel])] == pytest.approx(expected, rel=1e-5)


def test_what_is_off_by_a_line_per_channel_comes_back(mask):
    truth = draw(7, 9, 3)
    factors = torch.tensor([0.2, 1.0, 3.0])
    back = align_scale(truth * factors, truth, mask)
    torch.testing.assert_close(back, truth, rtol=1e-5, atol=1e-6)
    back = align_scale_and_shift(truth * factors - 0.3, truth, mask)
    torch.testing.assert_close(back, truth, rtol=1e-5, atol=1e-5)


def test_pixels_off_the_mask_have_no_say(mask):
    truth = draw(7, 9, 3)
    spoilt = torch.where(mask, 0.5 * truth, 100.0)
    torch.testing.assert_close(least_squares_scale(spoilt, truth, mask), torch.full((3,), 2.0))


def test_black_and_flat_channels_tell_no_factor(mask):
    truth = draw(7, 9, 1)
    assert least_squares_scale(torch.zeros(7, 9, 1), truth, mask).tolist() == [1.0]
    aligned = align_scale_and_shift(torch.full((7, 9, 1), 0.25), truth, mask)
    torch.testing.assert_close(aligned, torch.full((7, 9, 1), float(truth[mask].mean())))


def test_an_empty_mask_is_refused(mask):
    with pytest.raises(ValueError, match="at least one pixel"):
        least_squares_scale(draw(7, 9, 3), draw(7, 9, 3), mask & False)
