"""The plain cut-out against pictures composed from known coverage and colours."""

import math

import pytest
import torch

from svim3d.color import linear_from_srgb, srgb_from_linear
from svim3d.matting import cut_out_plain, foreground_colour, oklab, sharpen_coverage

HEIGHT, WIDTH = 180, 240
NOISE = 0.006  # sRGB; 1.5 of 255, a camera in good light


def blurred_steps(signed_distance, softness_px=0.5):
    """Coverage of a region given by its signed distance in pixels, averaged over `softness_px`."""
    return (signed_distance / (2.0 * softness_px) + 0.5).clamp(0.0, 1.0)[..., None]


def grid():
    return torch.meshgrid(torch.arange(HEIGHT) + 0.5, torch.arange(WIDTH) + 0.5, indexing="ij")


def disc(softness_px=0.5, radius=55.0, x=120.0, y=90.0):
    rows, columns = grid()
    return blurred_steps(radius - torch.hypot(columns - x, rows - y), softness_px)


def ring():
    rows, columns = grid()
    distance = torch.hypot(columns - 120, rows - 90)
    return blurred_steps(15.0 - (distance - 45.0).abs())


def lollipop():
    """A disc on a stick of three pixels."""
    rows, columns = grid()
    stick = torch.minimum(1.5 - (columns - 120.3).abs(), torch.minimum(rows - 60, 160 - rows))
    return torch.maximum(disc(radius=30.0, y=50.0), blurred_steps(stick))


def orange():
    """A colour with pattern and shading."""
    rows, columns = grid()
    pattern = 0.9 + 0.1 * torch.sin(columns / 3.0) * torch.sin(rows / 4.0)
    shading = 0.7 + 0.3 * (columns / WIDTH)
    return torch.tensor([0.8, 0.3, 0.05]) * (pattern * shading)[..., None]


def grey():
    return torch.full((HEIGHT, WIDTH, 3), 0.4)


def white():
    return torch.ones(HEIGHT, WIDTH, 3)


def gradient():
    rows, columns = grid()
    x, y = columns / WIDTH * 2 - 1, rows / HEIGHT * 2 - 1
    light = 0.5 + 0.12 * y - 0.08 * x - 0.08 * (x * x + y * y)
    return light[..., None] * torch.tensor([0.9, 1.0, 1.05])


def vignette():
    """Light that falls off as the fourth power of a cosine: no quadratic."""
    rows, columns = grid()
    radius = torch.hypot((columns - 120) / 150, (rows - 90) / 150)
    return (0.7 * torch.atan(radius).cos() ** 4)[..., None] * torch.tensor([0.6, 0.8, 1.0])


def photo(coverage, colour, background, noise=NOISE, seed=0):
    """What a camera sees: mixed in linear light, encoded, noisy, rounded to 8 bit."""
    encoded = srgb_from_linear(coverage * colour + (1.0 - coverage) * background)
    generator = torch.Generator().manual_seed(seed)
    noisy = encoded + noise * torch.randn(encoded.shape, generator=generator)
    return (noisy.clamp(0.0, 1.0) * 255).round() / 255


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


@pytest.mark.parametrize("background", [white, grey])
def test_colours_along_the_edge_lose_the_background(background):
    truth, colour = disc(1.0), torch.tensor([0.1, 0.3, 0.6])
    picture = photo(truth, colour.expand(HEIGHT, WIDTH, 3), background(), noise=0.0)
    found, _ = cut(picture)
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


def stripes():
    _, columns = grid()
    return (0.5 + 0.45 * torch.sin(columns))[..., None].expand(HEIGHT, WIDTH, 3)


def patches():
    generator = torch.Generator().manual_seed(3)
    small = torch.rand(6, 8, 3, generator=generator)
    return small.repeat_interleave(30, 0).repeat_interleave(30, 1)


@pytest.mark.parametrize(
    ("picture", "said"),
    [
        (lambda: photo(disc(), orange(), stripes()), "scatters by"),
        (lambda: photo(disc(), orange(), patches()), "wanted a plain background"),
        (lambda: photo(disc(radius=300.0), patches(), white()), "wanted a plain background"),
        (lambda: photo(disc(), gradient(), gradient()), "nothing stands out"),
        (lambda: white(), "nothing stands out"),
        (lambda: photo(disc(radius=5000.0, y=4910.0 + 91), orange(), grey()), "opposite sides"),
        (lambda: torch.rand(10, 300, 3), "at least 16 pixels"),
        (lambda: torch.rand(1, 1, 3), "at least 16 pixels"),
    ],
)
def test_what_cannot_be_told_is_refused_with_advice(picture, said):
    with pytest.raises(ValueError, match=f"(?s){said}.*--matting NETWORK.onnx"):
        cut(picture())


def test_nearly_everything_different_is_refused():
    truth = torch.zeros(HEIGHT, WIDTH, 1)
    truth[2:-2, 2:-2] = 1.0
    with pytest.raises(ValueError, match="no background is left"):
        cut(photo(truth, orange(), grey()))


def test_blurred_coverage_moves_onto_the_edges():
    truth = disc()
    picture = photo(truth, orange(), gradient())
    blurred = disc(8.0, x=122.0)
    sharp = sharpen_coverage(picture, blurred, radius_px=8)
    error = float((sharp - truth).abs().mean())
    assert error < 0.35 * float((blurred - truth).abs().mean())
    assert overlap(sharp, truth) > 0.97


def test_even_coverage_stays_even():
    picture = photo(disc(), orange(), gradient())
    for level in (0.0, 1.0):
        even = torch.full((HEIGHT, WIDTH, 1), level)
        torch.testing.assert_close(
            sharpen_coverage(picture, even, radius_px=5), even, rtol=0, atol=1e-6
        )
    assert math.isfinite(float(sharpen_coverage(white(), disc(), radius_px=5).sum()))
