"""Soft outlines are brought back to where they were, and to the colours that they had."""

import pytest
import torch

from svim3d.render.outlines import sharpened, without_bleed
from svim3d.render.view_findings import ramp_width_px

RED = torch.tensor([0.6, 0.1, 0.05])


def disc(size=48, radius=15.0, ramp_px=1.0, colour=RED):
    """One view of a disc of one colour whose outline ramps over so many pixels."""
    at = torch.arange(size) + 0.5 - size / 2
    distance = torch.hypot(at[:, None], at[None, :])
    mask = (0.5 + (radius - distance) / ramp_px).clamp(0.0, 1.0)[None, ..., None]
    basecolor = colour.expand(1, size, size, 3) * (mask > 0)
    return {"mask": mask, "basecolor": basecolor, "radiance": 0.5 * basecolor * mask}


def before_white(images):
    """The same, cut out of white: what is half covered shows white by the other half."""
    mask = images["mask"]
    basecolor = (images["basecolor"] * mask + 1.0 - mask) * (mask > 0)
    return images | {"basecolor": basecolor, "radiance": 0.5 * basecolor * mask}


def test_white_that_bleeds_in_is_taken_out():
    clean = disc(ramp_px=2.0)
    mended, amount = without_bleed(before_white(clean))
    # Along a ramp from whole to nothing, white's share is a half in the mean.
    assert amount == pytest.approx(0.5 * float((1.0 - RED).norm()), rel=0.05)
    reached = clean["mask"] > 0.03  # what is fainter counts as background
    for name in ("basecolor", "radiance"):
        difference = ((mended[name] - clean[name]) * reached).abs().max()
        assert float(difference) < 0.03  # a pixel of coverage 0.97 counts as whole


def test_clean_outlines_are_left_as_they_are():
    clean = disc(ramp_px=2.0)
    mended, amount = without_bleed(clean)
    assert amount == 0.0
    assert all(mended[name] is clean[name] for name in clean)


def test_a_texture_and_a_bright_rim_are_no_bleed():
    images = disc(ramp_px=2.0)
    noise = torch.rand(images["basecolor"].shape, generator=torch.Generator().manual_seed(0))
    images["basecolor"] = noise * (images["mask"] > 0)
    images["radiance"] = (0.1 + 2.0 * (1.0 - images["mask"])).expand(-1, -1, -1, 3) * images["mask"]
    mended, amount = without_bleed(images)
    assert amount == 0.0 and mended["radiance"] is images["radiance"]


def test_an_object_without_whole_pixels_is_left_alone():
    images = before_white(disc(ramp_px=2.0))
    images["mask"] = 0.5 * images["mask"]
    assert without_bleed(images)[1] == 0.0


def test_ramps_are_sharpened_about_half_coverage():
    sharp, soft = disc(ramp_px=1.0), disc(ramp_px=6.0)
    again = sharpened(soft, ramp_width_px(soft["mask"]))
    # Widths are counted in pixels of coverage from 0.03 to 0.97, along rims of pixels.
    assert float((again["mask"] - sharp["mask"]).abs().max()) < 0.25
    assert float(again["mask"].sum()) == pytest.approx(float(sharp["mask"].sum()), rel=0.02)
    covered = again["mask"] > 0.03
    straight = again["radiance"] / again["mask"].clamp_min(1e-3)
    torch.testing.assert_close(straight[covered[..., 0]], (0.5 * RED).expand(int(covered.sum()), 3))
