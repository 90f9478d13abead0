"""The look: statistics of a picture in closed form, and maps moved to the means it tells."""

from dataclasses import replace

import pytest
import torch
from tiny_model import EXPECTING, tiny_model

from svim3d.diffusion.groups import GeneratedViews
from svim3d.diffusion.look import QUANTILES, STATISTICS, Look, look_statistics, with_means


def over_white(color, share=0.5, side=16):
    """A flat object on the left of a white picture, in [-1, 1]."""
    picture = torch.ones(1, 3, side, side)
    picture[..., : int(share * side)] = 2.0 * torch.tensor(color).view(1, 3, 1, 1) - 1.0
    return picture


def test_statistics_of_a_flat_object_in_closed_form():
    found = look_statistics(over_white((0.8, 0.4, 0.2)))[0]
    grey = (0.8 + 0.4 + 0.2) / 3.0
    hue = [0.8 - grey, 0.4 - grey, 0.2 - grey]
    count = len(QUANTILES)
    wanted = [0.8, 0.4, 0.2, 0, 0, 0, *hue, 0, 0, 0, *[0.8] * count, *[0.75] * count]
    torch.testing.assert_close(found, torch.tensor(wanted), atol=1e-5, rtol=0.0)
    assert len(found) == STATISTICS


def test_white_around_an_object_plays_no_part():
    small, large = (look_statistics(over_white((0.3, 0.6, 0.5), share)) for share in (0.25, 0.9))
    torch.testing.assert_close(small, large, atol=1e-5, rtol=0.0)
    # A white object has no pixels of its own; then all count.
    assert look_statistics(torch.ones(1, 3, 16, 16))[0, :3].tolist() == [1.0, 1.0, 1.0]


def test_quantiles_are_nearest_ranks():
    picture = torch.ones(1, 3, 10, 10)
    picture[0, :, 0] = torch.linspace(0.0, 0.9, 10) * 2.0 - 1.0
    value = look_statistics(picture)[0, 12 : 12 + len(QUANTILES)]
    torch.testing.assert_close(value, torch.tensor([0.0, 0.2, 0.4, 0.7, 0.9]), atol=1e-5, rtol=0.0)


def views(mask, **planes):
    zero = torch.zeros(2, 4, 4, 1)
    full = {"roughness": zero, "metallic": zero} | planes
    three = torch.zeros(2, 4, 4, 3)
    return GeneratedViews(three, three, normal_camera=three, mask=mask, **full)


@pytest.mark.parametrize("detail", [0.0, 0.5, 1.0])
def test_maps_are_moved_to_the_means_and_keep_their_share_of_detail(detail):
    mask = torch.zeros(2, 4, 4, 1)
    mask[:, :, :2] = 1.0
    drawn = (torch.rand(2, 4, 4, 1, generator=torch.Generator().manual_seed(0)) * 0.2 + 0.4) * mask
    moved = with_means(views(mask, roughness=drawn), torch.tensor([0.3, 0.9]), detail)
    inside = mask > 0.0
    assert float(moved.roughness[inside].mean()) == pytest.approx(0.3, abs=1e-6)
    assert float(moved.metallic[inside].mean()) == pytest.approx(0.9, abs=1e-6)
    spread = float(moved.roughness[inside].std())
    assert spread == pytest.approx(detail * float(drawn[inside].std()), abs=1e-6)
    assert not moved.roughness[~inside].any() and not moved.metallic[~inside].any()


def test_means_stay_possible():
    mask = torch.ones(2, 4, 4, 1)
    moved = with_means(views(mask), torch.tensor([-0.2, 1.4]), 1.0)
    assert not moved.roughness.any() and bool((moved.metallic == 1.0).all())


def test_a_model_with_a_look_asks_it():
    model = tiny_model(replace(EXPECTING, look={"hidden": 4}, look_detail=0.0))
    torch.nn.init.zeros_(model.look.body[-1].weight)
    with torch.no_grad():
        model.look.body[-1].bias.copy_(torch.tensor([0.25, 0.75]))
    angles = torch.arange(5) * 72.0
    told = model.condition(torch.rand(16, 16, 3), torch.full((5,), 10.0), angles)
    latents = model.draw(told, 0)
    plain, asked = model.decode(latents), model.decode(latents, conditioning=told)
    covered = asked.mask > 0.0
    assert torch.equal(plain.mask, asked.mask) and torch.equal(plain.basecolor, asked.basecolor)
    assert bool((asked.roughness[covered] == 0.25).all())
    assert bool((asked.metallic[covered] == 0.75).all())


def test_scales_are_those_of_the_training_set():
    look = Look(hidden=4)
    statistics = 3.0 + 2.0 * torch.randn(500, STATISTICS)
    look.fit_scale(statistics)
    scaled = look.scaled(statistics)
    torch.testing.assert_close(scaled.mean(0), torch.zeros(STATISTICS), atol=1e-4, rtol=0.0)
    torch.testing.assert_close(scaled.std(0), torch.ones(STATISTICS), atol=1e-4, rtol=0.0)
