"""Sharpened coverage and colours without fringe, against known ones."""

import math

import pytest
import torch
from cut_out_scenes import HEIGHT, WIDTH, disc, gradient, grey, orange, photo, white

from svim3d.color import linear_from_srgb
from svim3d.matting import cut_out_plain
from svim3d.unmixing import foreground_colour, sharpen_coverage


@pytest.mark.parametrize("background", [white, grey])
def test_colours_along_the_edge_lose_the_background(background):
    truth, colour = disc(1.0), torch.tensor([0.1, 0.3, 0.6])
    picture = photo(truth, colour.expand(HEIGHT, WIDTH, 3), background(), noise=0.0)
    found = cut_out_plain(picture, lambda kind, text: None)
    unmixed = foreground_colour(linear_from_srgb(picture), found)
    edge = ((truth > 0.1) & (truth < 0.95) & (found > 0.1))[..., 0]
    before = (linear_from_srgb(picture)[edge] - colour).abs().mean()
    after = (unmixed[edge] - colour).abs().mean()
    assert float(after) < 0.03 and float(after) < 0.15 * float(before)
    # Composed anew they give the photo back.
    again = found * unmixed + (1.0 - found) * background()
    assert float((again - linear_from_srgb(picture)).abs().max()) < 0.05


def test_exact_coverage_gives_exact_colours():
    truth, colour = disc(2.0), torch.tensor([0.1, 0.3, 0.6])
    mixed = truth * colour + (1.0 - truth) * 0.8
    found = foreground_colour(mixed, truth)
    inside = (truth > 0.05)[..., 0]
    assert float((found[inside] - colour).abs().max()) < 0.02


def test_blurred_coverage_moves_onto_the_edges():
    truth = disc()
    picture = photo(truth, orange(), gradient())
    blurred = disc(8.0, x=122.0)
    sharp = sharpen_coverage(picture, blurred, radius_px=8)
    error = float((sharp - truth).abs().mean())
    assert error < 0.5 * float((blurred - truth).abs().mean())
    assert torch.equal((sharp > 0.5)[truth == 1.0], truth[truth == 1.0] > 0.5)


def test_even_coverage_stays_even():
    picture = photo(disc(), orange(), gradient())
    for level in (0.0, 1.0):
        even = torch.full((HEIGHT, WIDTH, 1), level)
        torch.testing.assert_close(
            sharpen_coverage(picture, even, radius_px=5), even, rtol=0, atol=1e-6
        )
    assert math.isfinite(float(sharpen_coverage(white(), disc(), radius_px=5).sum()))
