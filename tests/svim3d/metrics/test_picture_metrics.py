import math

import numpy as np
import pytest
import torch
from scipy import ndimage

from svim3d.metrics.pictures import psnr, rmse, structural_similarity


def test_psnr_of_a_constant_error_inside_the_mask():
    truth = torch.zeros(4, 4, 3)
    mask = torch.zeros(4, 4, 1, dtype=torch.bool)
    mask[:2] = True
    image = torch.where(mask, 0.1, 1.0).expand(4, 4, 3)
    assert psnr(image, truth, mask) == pytest.approx(20.0, abs=1e-5)
    assert psnr(truth, truth, mask) == math.inf


def test_similarity_of_flat_pictures_is_the_closed_form():
    a, b = 0.3, 0.7
    found = structural_similarity(torch.full((1, 16, 16, 3), a), torch.full((1, 16, 16, 3), b))
    expected = (2 * a * b + 1e-4) / (a * a + b * b + 1e-4)
    torch.testing.assert_close(found, torch.full((1, 16, 16, 1), expected), atol=1e-4, rtol=0.0)


def test_similarity_of_a_negative_is_minus_one():
    # About a mean of one half both pictures have the same means and opposite covariance; noise is
    # large against the constants that keep flat pictures defined, but its window means are not
    # exactly one half.
    noise = torch.rand(1, 64, 64, 1, generator=torch.Generator().manual_seed(0), dtype=torch.double)
    noise = (noise > 0.5).double()
    similar = structural_similarity(noise, 1.0 - noise)
    assert float(similar.mean()) == pytest.approx(-1.0, abs=0.08)


def test_rmse_is_the_root_of_the_mean_square_inside_the_mask():
    truth = torch.zeros(2, 2, 1)
    image = torch.tensor([[[0.3], [0.4]], [[9.0], [9.0]]])
    mask = torch.tensor([[[True], [True]], [[False], [False]]])
    assert rmse(image, truth, mask) == pytest.approx(math.sqrt((0.09 + 0.16) / 2), rel=1e-6)
    # With a peak of 1 PSNR is the same figure in decibels.
    assert psnr(image, truth, mask) == pytest.approx(-20 * math.log10(rmse(image, truth, mask)))


@pytest.mark.parametrize(
    ("options", "radius", "border"),
    [({}, 5, "nearest"), ({"radius_px": 1, "border": "reflect"}, 1, "mirror")],
)
def test_similarity_is_scipys_with_the_same_window(options, radius, border):
    generator = np.random.default_rng(0)
    truth = ndimage.gaussian_filter(generator.random((20, 30, 3)), (1, 1, 0))
    image = np.clip(truth + 0.1 * generator.standard_normal(truth.shape), 0, 1)
    found = structural_similarity(*(torch.from_numpy(x)[None] for x in (image, truth)), **options)

    def mean(x):
        # Truncation in deviations: scipy's window reaches `radius` pixels, as ours.
        sigma = (1.5, 1.5, 0)
        return ndimage.gaussian_filter(x, sigma, mode=border, truncate=(radius + 0.1) / 1.5)

    a, b = mean(image), mean(truth)
    va, vb = mean(image**2) - a**2, mean(truth**2) - b**2
    cab = mean(image * truth) - a * b
    c1, c2 = 0.01**2, 0.03**2
    expected = (2 * a * b + c1) * (2 * cab + c2) / ((a**2 + b**2 + c1) * (va + vb + c2))
    np.testing.assert_allclose(found[0, ..., 0].numpy(), expected.mean(-1), atol=1e-9)
