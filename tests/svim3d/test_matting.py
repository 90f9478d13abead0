"""The plain cut-out against pictures composed from known coverage and colours."""

import pytest
import torch
from cut_out_scenes import (
    HEIGHT,
    WIDTH,
    blurred_steps,
    disc,
    gradient,
    grey,
    grid,
    lollipop,
    orange,
    photo,
    ring,
    vignette,
    white,
)

from svim3d.matting import cut_out_plain, oklab


def cut(picture):
    events = []
    found = cut_out_plain(picture, lambda kind, text: events.append(kind))
    return found, events


def overlap(found, truth):
    a, b = found > 0.5, truth > 0.5
    return float((a & b).sum() / (a | b).sum())


def test_oklab_of_known_colours():
    # Source: Ottosson 2020: white is (1, 0, 0); the values of red are those of CSS Color 4.
    colours = oklab(torch.tensor([[1.0, 1.0, 1.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]]))
    expected = torch.tensor([[1.0, 0.0, 0.0], [0.62796, 0.22486, 0.12585], [0.0, 0.0, 0.0]])
    torch.testing.assert_close(colours, expected, rtol=0, atol=1e-4)


@pytest.mark.parametrize("background", [white, grey, gradient, vignette])
@pytest.mark.parametrize("shape", [disc, ring, lollipop])
def test_known_coverage_is_found_again(background, shape):
    truth = shape()
    found, _ = cut(photo(truth, orange(), background()))
    assert overlap(found, truth) > 0.98
    edge = (truth > 0.02) & (truth < 0.98)
    assert float((found - truth)[edge].abs().mean()) < 0.1
    # Beyond the edge nothing is missing and nothing is left.
    assert float((found - truth)[~edge].abs().mean()) < 0.004
    assert float(found[truth == 0.0].mean()) < 0.003


@pytest.mark.parametrize("softness_px", [0.5, 1.0, 2.0])
def test_soft_edges_stay_as_soft_as_they_are(softness_px):
    truth = disc(softness_px)
    found, _ = cut(photo(truth, torch.tensor([0.05, 0.1, 0.4]).expand(HEIGHT, WIDTH, 3), white()))
    soft = (truth > 0.0) & (truth < 1.0)
    assert float((found - truth)[soft].abs().mean()) < 0.07
    assert float(found.sum()) == pytest.approx(float(truth.sum()), rel=0.01)


@pytest.mark.parametrize("noise", [0.0, 0.012, 0.03])
def test_noise_does_not_leave_specks(noise):
    truth = disc()
    found, _ = cut(photo(truth, orange(), gradient(), noise))
    assert overlap(found, truth) > 0.97
    assert float(found[disc(radius=62.0)[..., 0] == 0.0].max()) == 0.0


def test_soft_shadow_is_background():
    rows, columns = grid()
    truth = disc(radius=40.0)
    far = ((columns - 125) / 70) ** 2 + ((rows - 128) / 14) ** 2
    shaded = gradient() * (1.0 - 0.5 * torch.exp(-far))[..., None]
    found, events = cut(photo(truth, orange(), shaded))
    assert overlap(found, truth) > 0.97
    assert "shadow_removed" in events


def test_hard_shadow_is_kept_as_object():
    # A hard shadow is a thing like any other: a picture with the object cut out is the way.
    truth = disc(radius=40.0, y=70.0)
    shadow = disc(radius=30.0, y=130.0, x=150.0)
    found, _ = cut(photo(truth, orange(), gradient() * (1.0 - 0.6 * shadow)))
    assert overlap(found, torch.maximum(truth, shadow)) > 0.95


def test_hole_is_told_and_highlight_is_kept():
    truth = ring()
    found, events = cut(photo(truth, orange(), white()))
    assert events == ["seen_through"] and float(found[90, 120]) == 0.0
    colour = torch.lerp(orange(), white(), disc(4.0, radius=3.0))
    found, events = cut(photo(disc(), colour, white()))
    assert events == [] and float(found[90, 120]) == 1.0


def test_object_cut_off_at_one_side():
    truth = disc(x=10.0)
    found, _ = cut(photo(truth, orange(), gradient()))
    assert overlap(found, truth) > 0.98


def test_scale_of_the_picture_does_not_matter():
    truth = disc()
    picture = photo(truth, orange(), gradient(), noise=0.0)
    large = picture.repeat_interleave(3, 0).repeat_interleave(3, 1)
    found, _ = cut(large)
    assert overlap(found, truth.repeat_interleave(3, 0).repeat_interleave(3, 1)) > 0.98


def test_same_bits_and_mirrored_alike():
    picture = photo(disc(x=100.0), orange(), gradient())
    first, second, mirrored = cut(picture)[0], cut(picture)[0], cut(picture.flip(1))[0]
    assert torch.equal(first, second)
    assert float((mirrored.flip(1) - first).abs().max()) < 0.02


def stripes(strength):
    _, columns = grid()
    return (0.5 + strength * torch.sin(columns))[..., None].expand(HEIGHT, WIDTH, 3)


def patches():
    generator = torch.Generator().manual_seed(3)
    small = torch.rand(6, 8, 3, generator=generator)
    return small.repeat_interleave(30, 0).repeat_interleave(30, 1)


def bar():
    rows, _ = grid()
    return blurred_steps(30.0 - (rows - 90.0).abs())


@pytest.mark.parametrize(
    ("picture", "said"),
    [
        (lambda: photo(disc(), orange(), stripes(0.45)), "wanted a plain background"),
        (lambda: photo(disc(), orange(), stripes(0.13)), "scatters by"),
        (lambda: photo(disc(), orange(), patches()), "wanted a plain background"),
        (lambda: photo(disc(radius=300.0), patches(), white()), "wanted a plain background"),
        (lambda: photo(disc(), gradient(), gradient()), "nothing stands out"),
        (lambda: white(), "nothing stands out"),
        (lambda: photo(bar(), orange(), grey()), "opposite sides"),
        (lambda: torch.rand(10, 300, 3), "at least 16 pixels"),
        (lambda: torch.rand(1, 1, 3), "at least 16 pixels"),
    ],
)
def test_what_cannot_be_told_is_refused_with_advice(picture, said):
    with pytest.raises(ValueError, match=f"(?s){said}.*--matting NETWORK.onnx"):
        cut(picture())


def test_nearly_everything_different_is_refused():
    truth = torch.zeros(HEIGHT, WIDTH, 1)
    truth[4:-4, 4:-4] = 1.0
    with pytest.raises(ValueError, match="no background is left"):
        cut(photo(truth, orange(), grey()))
