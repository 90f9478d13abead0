"""The photo in its own view: colours, outline and detail; all other views stay as drawn."""

import dataclasses

import pytest
import torch
from drawn_sphere import drawn_sphere

from svim3d.color import linear_from_srgb, srgb_from_linear
from svim3d.diffusion.photo_view import enlarged, with_photo
from svim3d.numerics import length

SIZE, VIEWS = 32, 3


@pytest.fixture(scope="module")
def drawn():
    return drawn_sphere(VIEWS, SIZE)


def checkered(size, low, high):
    """A board of cells of two pixels, sRGB-encoded."""
    row, column = torch.meshgrid(torch.arange(size), torch.arange(size), indexing="ij")
    odd = ((row // 2 + column // 2) % 2 == 1)[..., None]
    return torch.where(odd, high, low).expand(size, size, 3)


def test_enlarged_views_keep_their_rims_clean(drawn):
    grey = dataclasses.replace(drawn, roughness=torch.where(drawn.mask > 0.0, 0.25, 0.0))
    large = enlarged(grey, 3 * SIZE)
    seen = large.mask[..., 0] > 0.0
    torch.testing.assert_close(
        large.roughness[seen], torch.full_like(large.roughness[seen], 0.25), rtol=0, atol=1e-4
    )
    torch.testing.assert_close(length(large.normal_camera[seen]), torch.ones(int(seen.sum()), 1))
    assert not bool(large.basecolor[~seen].any())
    # Its middle is where it was: areas keep their share of the picture.
    assert float(large.mask.mean()) == pytest.approx(float(drawn.mask.mean()), rel=0.01)


def test_views_of_the_asked_size_are_the_same(drawn):
    assert enlarged(drawn, SIZE) is drawn


def test_basecolor_takes_detail_but_no_brightness(drawn):
    plain = dataclasses.replace(drawn, basecolor=0.3 * (drawn.mask > 0.0).expand(-1, -1, -1, 3))
    known = with_photo(plain, checkered(SIZE, 0.7, 0.9), drawn.mask[-1])
    middle = (slice(10, 22), slice(10, 22))
    encoded = srgb_from_linear(known.basecolor[-1])[middle]
    broad = float(srgb_from_linear(torch.tensor(0.3)))
    assert float(encoded.mean()) == pytest.approx(broad, abs=0.01)
    assert float(encoded.max() - encoded.min()) == pytest.approx(0.2, abs=0.04)
    colours = linear_from_srgb(checkered(SIZE, 0.7, 0.9))
    torch.testing.assert_close(known.rgb_linear[-1][middle], colours[middle])


def test_beyond_the_drawn_outline_materials_go_on(drawn):
    half = drawn.mask.clone()
    half[-1, :, SIZE // 2 :] = 0.0
    kept = {name: plane * (half > 0.0) for name, plane in vars(drawn).items() if name != "mask"}
    known = with_photo(
        dataclasses.replace(drawn, mask=half, **kept), checkered(SIZE, 0.5, 0.5), drawn.mask[-1]
    )
    torch.testing.assert_close(known.mask[-1], drawn.mask[-1], rtol=0, atol=1e-6)
    covered = known.mask[-1, ..., 0] > 0.5
    torch.testing.assert_close(
        length(known.normal_camera[-1][covered]), torch.ones(int(covered.sum()), 1)
    )
    assert float(known.roughness[-1][covered].min()) > 0.0
    outside = known.mask[-1, ..., 0] == 0.0
    assert not any(bool(plane[-1][outside].any()) for plane in vars(known).values())


def test_a_drawing_of_nothing_takes_the_photo(drawn):
    nothing = dataclasses.replace(
        drawn, **{name: torch.zeros_like(plane) for name, plane in vars(drawn).items()}
    )
    known = with_photo(nothing, checkered(SIZE, 0.5, 0.5), drawn.mask[-1])
    assert all(bool(torch.isfinite(plane).all()) for plane in vars(known).values())
