import math

import pytest
import scipy.sparse
import torch
from torch.nn import functional

from svim3d.raster.texture import bilinear_taps
from svim3d.render.material_evidence import GROUPS, Hypothesis, cost, judge, verdict
from svim3d.render.palettes import (
    border_length,
    growing_palettes,
    have_insides,
    palette_values,
)
from svim3d.render.view_pixels import ViewPixels
from svim3d.shading.linear_operator import SparseOperator

SIZE = 40
COUNTS = {group.name: SIZE**2 for group in GROUPS}
GOLD = torch.tensor([1.0, 0.71, 0.29, 0.3, 1.0])
PLASTIC = torch.tensor([0.6, 0.05, 0.04, 0.5, 0.0])


def smooth(noise, blur_px):
    """Noise [V, C, H, W] convolved with a Gaussian, at unit strength."""
    reach = round(4 * blur_px)
    window = torch.exp(-0.5 * (torch.arange(-reach, reach + 1) / blur_px) ** 2)
    flat = noise.flatten(0, 1)[:, None]
    flat = functional.conv2d(flat, window.view(1, 1, -1, 1))
    flat = functional.conv2d(flat, window.view(1, 1, 1, -1))
    return (flat / flat.std()).view(*noise.shape[:2], *flat.shape[2:])


def view_noise(views, blur_px, size=SIZE):
    """Independent in each view; [V * H * W, 5]."""
    generator = torch.Generator().manual_seed(5)
    edge = round(8 * blur_px)
    noise = torch.randn(views, 5, size + edge, size + edge, generator=generator)
    noise = smooth(noise, blur_px) if blur_px else noise
    return noise.permute(0, 2, 3, 1).reshape(-1, 5)


def flat_views(truth, *, views=6, noise=0.0, blur_px=0.0):
    """A flat texture [S, S, 5] seen from straight ahead, each time a fraction of a texel aside."""
    generator = torch.Generator().manual_seed(4)
    at = (torch.arange(SIZE) + 0.5) / SIZE
    grid = torch.stack([at.expand(SIZE, SIZE), at[:, None].expand(SIZE, SIZE)], -1).view(-1, 2)
    blocks = []
    for _ in range(views):
        uv = grid + torch.rand(2, generator=generator) / SIZE
        texel, weight = bilinear_taps(uv.clamp(0.5 / SIZE, 1 - 0.5 / SIZE), SIZE, SIZE)
        row = torch.arange(SIZE**2)[:, None].expand_as(texel)
        entries = weight.flatten().numpy(), (row.flatten().numpy(), texel.flatten().numpy())
        blocks.append(scipy.sparse.csr_matrix(entries, (SIZE**2, SIZE**2)))
    operator = SparseOperator(scipy.sparse.vstack(blocks).tocsr())
    target = operator(truth.reshape(-1, 5)) + noise * view_noise(views, blur_px)
    return ViewPixels(
        operator=operator,
        pixel=torch.arange(views * SIZE**2),
        target=target.clamp(0.0, 1.0),
        weight=torch.ones(views * SIZE**2, 1),
        shape=(views, SIZE, SIZE),
        texture_size=SIZE,
    )


def even():
    return (0.2 + 0.5 * GOLD).expand(SIZE, SIZE, 5)


def halves():
    left = (torch.arange(SIZE) < SIZE // 2)[None, :, None]
    return torch.where(left, GOLD, PLASTIC).expand(SIZE, SIZE, 5)


def waves():
    at = torch.arange(SIZE) * 0.7
    pattern = torch.sin(at)[:, None] + torch.sin(1.3 * at)[None]
    return (0.5 + 0.2 * pattern)[..., None].expand(SIZE, SIZE, 5)


def forms(pixels):
    verdicts = judge(pixels, texel_count=COUNTS, prior=0.015, iterations=20)
    return {name: v.chosen.form for name, v in verdicts.items()}, verdicts


def test_misfit_and_size_are_paid_for_in_nats():
    assert cost(0.25, 100.0, 1) == pytest.approx(50 * math.log(0.25) + 0.5 * math.log(101))
    assert cost(0.25, 100.0, 50) == pytest.approx(50 * math.log(0.25) + 25 * math.log(3))
    assert cost(0.0, 100.0, 1) == cost(10**-4.5, 100.0, 1)  # below 45 dB nothing is told apart


@pytest.mark.parametrize("blur_px", [0.0, 2.0], ids=["grainy", "smooth"])
@pytest.mark.parametrize("noise", [0.0, 0.02, 0.08])
def test_noise_alone_does_not_promote_a_constant(noise, blur_px):
    found, verdicts = forms(flat_views(even(), noise=noise, blur_px=blur_px))
    assert set(found.values()) == {"constant"}
    assert all(v.lost_db <= 0.0 for v in verdicts.values())


@pytest.mark.parametrize("noise", [0.0, 0.03])
def test_two_materials_are_two_values(noise):
    pixels = flat_views(halves(), noise=noise)
    found, verdicts = forms(pixels)
    assert set(found.values()) == {"palette"}
    assert {v.chosen.clusters for v in verdicts.values()} == {2}
    assert all(v.lost_db < 0.2 for v in verdicts.values())


@pytest.mark.parametrize("noise", [0.0, 0.03])
def test_a_pattern_needs_a_texture(noise):
    found, verdicts = forms(flat_views(waves(), noise=noise))
    assert set(found.values()) == {"texture"}
    assert all(v.lost_db == 0.0 for v in verdicts.values())


def test_channels_are_judged_apart():
    mixed = torch.cat([waves()[..., :3], even()[..., 3:4], halves()[..., 4:]], -1)
    found, verdicts = forms(flat_views(mixed))
    assert found == {"basecolor": "texture", "roughness": "constant", "metallic": "palette"}
    assert "palette of 2 by" in str(verdicts["metallic"])
    assert "constant" in str(verdicts["metallic"])


def test_one_view_cannot_be_held_against_another():
    assert forms(flat_views(even(), views=1))[0] == {}


def test_views_without_weight_do_not_count():
    pixels = flat_views(even(), views=6)
    waved = flat_views(waves(), views=6)
    blind = torch.where(pixels.view[:, None] < 2, 0.0, pixels.weight)
    target = torch.where(pixels.view[:, None] < 2, waved.target, pixels.target)
    mixed = ViewPixels(
        pixels.operator, pixels.pixel, target, blind, pixels.shape, pixels.texture_size
    )
    assert set(forms(mixed)[0].values()) == {"constant"}


def test_smooth_noise_counts_by_its_area():
    pixels = flat_views(even(), views=6)
    count = len(pixels.pixel)
    assert pixels.independent(view_noise(6, 0.0)) == pytest.approx(count, rel=0.02)
    # A Gaussian's autocorrelation exp(-d^2 / 4 s^2) has the integral 2 s sqrt(pi) along each axis.
    for blur_px in (1.0, 2.0):
        area = 4.0 * math.pi * blur_px**2
        found = pixels.independent(view_noise(6, blur_px))
        assert found == pytest.approx(count / area, rel=0.15)
    halved = torch.where(pixels.view[:, None] < 3, 2.0, 1.0)
    weighted = ViewPixels(
        pixels.operator, pixels.pixel, pixels.target, halved, pixels.shape, pixels.texture_size
    )
    assert weighted.independent(view_noise(6, 0.0)) == pytest.approx(0.9 * count, rel=0.02)


def test_blocks_of_texels_stand_for_their_texels():
    pixels = flat_views(even(), views=2)
    blocky = torch.rand(SIZE // 2, SIZE // 2, 1, generator=torch.Generator().manual_seed(0))
    fine = blocky.repeat_interleave(2, 0).repeat_interleave(2, 1).reshape(-1, 1)
    whole = pixels.operator(fine)
    coarse = pixels.coarsened(2)
    assert coarse.texture_size == SIZE // 2
    assert torch.allclose(coarse.operator(blocky.reshape(-1, 1)), whole, atol=1e-6)
    assert torch.equal(pixels.operator(fine), whole)


def test_pixels_are_counted_once_however_many_views_show_them():
    pixels = flat_views(even(), views=5)
    distinct, seen = pixels.distinct()
    assert distinct == pytest.approx(SIZE**2, rel=0.15)
    assert seen == SIZE**2


def test_clusters_are_found_one_by_one():
    centres = torch.tensor([[0.1, 0.2], [0.8, 0.3], [0.4, 0.9]])
    generator = torch.Generator().manual_seed(0)
    texels = centres.repeat(50, 1) + 0.02 * torch.randn(150, 2, generator=generator)
    palettes = list(growing_palettes(texels, torch.ones(150), 3))
    assert [len(p.values) for p in palettes] == [2, 3]
    labels = palettes[-1].labels(texels)
    assert len({tuple(sorted(set(labels[i::3].tolist()))) for i in range(3)}) == 3
    found = palettes[-1].values[labels[:3]]
    assert torch.allclose(found, centres, atol=0.02)
    assert list(growing_palettes(torch.ones(9, 2), torch.ones(9), 4)) == []


def test_values_come_through_mixed_pixels():
    pixels = flat_views(halves())
    labels = (torch.arange(SIZE**2) % SIZE >= SIZE // 2).long()
    spoilt = halves().reshape(-1, 5) * 0.8
    values = palette_values(labels, 2, spoilt, torch.ones(SIZE**2), pixels)
    assert torch.allclose(values, torch.stack([GOLD, PLASTIC]), atol=1e-4)


def test_borders_and_insides_of_clusters():
    labels = torch.zeros(8, 8, dtype=torch.int64)
    labels[:, 4:] = 1
    seen = torch.ones(8, 8, dtype=torch.bool)
    assert border_length(labels, seen) == 8
    assert have_insides(labels, seen, 2)
    labels[:, 3:5] = 2  # a line of mixed colour between two materials
    assert border_length(labels, seen) == 16
    assert not have_insides(labels, seen, 3)
    seen[:, 3:5] = False
    assert border_length(labels, seen) == 0


@pytest.mark.parametrize(
    ("most_lost_db", "form", "lost_db"),
    [
        (math.inf, "constant", 6.0),
        (6.5, "constant", 6.0),
        (5.0, "palette", 1.0),
        (0.5, "texture", 0),
    ],
)
def test_what_loses_more_than_may_be_lost_is_left_out(most_lost_db, form, lost_db):
    """The cheapest form is taken of those that are close enough; beyond 45 dB all are alike."""
    forms = [
        Hypothesis("constant", 1, 30.0, -300.0),
        Hypothesis("palette", 2, 35.0, -200.0),
        Hypothesis("texture", 0, 36.0, -100.0),
    ]
    found = verdict(forms, 500.0, most_lost_db)
    assert found.chosen.form == form
    assert found.lost_db == pytest.approx(lost_db)
    unseen = [Hypothesis("constant", 1, 46.0, -9.0), Hypothesis("texture", 0, 90.0, -1.0)]
    assert verdict(unseen, 500.0, 0.0).chosen.form == "constant"
