"""Pictures composed from known coverage and colours."""

import torch

from svim3d.color import srgb_from_linear

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
    radius = torch.hypot((columns - 120) / 220, (rows - 90) / 220)
    return (0.7 * torch.atan(radius).cos() ** 4)[..., None] * torch.tensor([0.6, 0.8, 1.0])


def photo(coverage, colour, background, noise=NOISE, seed=0):
    """What a camera sees: mixed in linear light, encoded, noisy, rounded to 8 bit."""
    encoded = srgb_from_linear(coverage * colour + (1.0 - coverage) * background)
    generator = torch.Generator().manual_seed(seed)
    noisy = encoded + noise * torch.randn(encoded.shape, generator=generator)
    return (noisy.clamp(0.0, 1.0) * 255).round() / 255
