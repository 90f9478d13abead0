"""A finer texture pays where views see its detail each a little aside, and nowhere else."""

import pytest
import scipy.sparse
import torch
from torch.nn.functional import avg_pool2d

from svim3d.raster.texture import bilinear_taps
from svim3d.render.material_evidence import GROUPS
from svim3d.render.texture_detail import gained_db, unseen_errors
from svim3d.render.view_pixels import ViewPixels
from svim3d.shading.linear_operator import SparseOperator

FINE, PX, VIEWS = 48, 24, 12  # a pixel covers two texels each way
PRIOR = 0.015


def looks(truth, noise):
    """A flat texture [FINE, FINE, 5] in views of PX x PX pixels, each a part of one aside."""
    draw = torch.Generator().manual_seed(0)
    inner = torch.tensor([0.125, 0.375, 0.625, 0.875])  # four samples of a pixel each way
    at = (torch.arange(PX)[:, None] + inner).reshape(-1) / PX
    uv = torch.stack(torch.meshgrid(at, at, indexing="ij")[::-1], -1)
    pixel = (torch.arange(PX)[:, None] * PX + torch.arange(PX)).repeat_interleave(4, 0)
    pixel = pixel.repeat_interleave(4, 1).reshape(-1, 1)
    blocks = []
    for _ in range(VIEWS):
        aside = (torch.rand(2, generator=draw) - 0.5) / PX
        moved = (uv.reshape(-1, 2) + aside).clamp(0.5 / FINE, 1.0 - 0.5 / FINE)
        texel, weight = bilinear_taps(moved, FINE, FINE)
        row = pixel.expand_as(texel).flatten().numpy()
        entries = (weight / 16).flatten().numpy(), (row, texel.flatten().numpy())
        blocks.append(scipy.sparse.csr_matrix(entries, (PX**2, FINE**2)))
    operator = SparseOperator(scipy.sparse.vstack(blocks).tocsr())
    target = operator(truth.reshape(-1, 5))
    return ViewPixels(
        operator=operator,
        pixel=torch.arange(VIEWS * PX**2),
        target=target + noise * torch.randn(target.shape, generator=draw),
        weight=torch.ones(VIEWS * PX**2, 1),
        shape=(VIEWS, PX, PX),
        texture_size=FINE,
    )


def gains(truth, noise=0.01):
    """What the fine texture gains over one of half its side, by group, dB."""
    pixels = looks(truth, noise)
    coarse = avg_pool2d(truth.movedim(-1, 0), 4).movedim(0, -1)  # a bake that knows no detail
    errors = []
    for factor in (2, 1):
        start = coarse.repeat_interleave(4 // factor, 0).repeat_interleave(4 // factor, 1)
        part = pixels.coarsened(factor)
        shown = start.reshape(-1, 5)
        errors.append(unseen_errors(part, shown, GROUPS, prior=PRIOR, iterations=20))
    return {name: gained_db(errors[0][name], errors[1][name]) for name in errors[0]}


def test_detail_that_each_view_sees_a_little_aside_pays():
    draw = torch.Generator().manual_seed(1)
    truth = 0.2 + 0.6 * (torch.rand(FINE, FINE, 5, generator=draw) > 0.5).float()
    assert min(gains(truth).values()) > 1.0


def test_noise_in_views_of_a_smooth_surface_does_not():
    at = torch.linspace(0.0, 3.0, FINE)
    truth = (0.5 + 0.2 * (at.sin()[:, None] + at.cos()))[..., None].expand(FINE, FINE, 5)
    assert max(gains(truth.contiguous(), noise=0.05).values()) < 0.0


def test_groups_are_judged_apart():
    draw = torch.Generator().manual_seed(1)
    truth = torch.full((FINE, FINE, 5), 0.5)
    truth[..., 3] = 0.2 + 0.6 * (torch.rand(FINE, FINE, generator=draw) > 0.5).float()
    found = gains(truth)
    assert found["roughness"] > 1.0
    assert max(found["basecolor"], found["metallic"]) < 0.3


def test_views_that_cannot_check_each_other_give_no_figure():
    pixels = looks(torch.full((FINE, FINE, 5), 0.5), noise=0.0)
    alone = pixels.take(pixels.view == 0)
    start = torch.zeros(FINE**2, 5)
    assert unseen_errors(alone, start, GROUPS, prior=PRIOR, iterations=2) == {}


def test_gain_is_in_decibels():
    assert gained_db(1e-3, 1e-4) == pytest.approx(10.0)
    assert gained_db(0.0, 0.0) == 0.0
