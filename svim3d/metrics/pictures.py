"""How alike two pictures are: signal to noise, root mean square, structural similarity."""

from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

# Source: Wang et al. 2004, "Image Quality Assessment", section III.C.
SSIM_RADIUS_PX, SSIM_SPREAD_PX = 5, 1.5
SSIM_C1, SSIM_C2 = 0.01**2, 0.03**2

Border = Literal["replicate", "reflect"]


def psnr(
    image: Float[Tensor, "*batch C"],
    truth: Float[Tensor, "*batch C"],
    mask: Bool[Tensor, "*batch 1"],
) -> float:
    """Peak signal-to-noise ratio in dB inside a mask; both images are encoded for display, peak 1.

    Equal images give infinity. The mean runs over masked pixels only: over a whole picture with
    an equal background the figure would be higher by 10 log10(1 / share of the mask).
    """
    squared = (image - truth).square()[mask.expand_as(image)]
    return float(-10.0 * squared.double().mean().log10())


def rmse(
    image: Float[Tensor, "*batch C"],
    truth: Float[Tensor, "*batch C"],
    mask: Bool[Tensor, "*batch 1"],
) -> float:
    """Root of the mean square difference inside a mask, in the pictures' own unit."""
    squared = (image - truth).square()[mask.expand_as(image)]
    return float(squared.double().mean().sqrt())


def structural_similarity(
    image: Float[Tensor, "V H W C"],
    truth: Float[Tensor, "V H W C"],
    *,
    radius_px: int = SSIM_RADIUS_PX,
    border: Border = "replicate",
) -> Float[Tensor, "V H W 1"]:
    """SSIM at every pixel, averaged over channels; display-encoded pictures, peak 1.

    Args:
        image: compared.
        truth: to this.
        radius_px: of the Gaussian window, cut off without care for its spread of 1.5 pixels; the
            paper's window has 11 pixels, Stanford-ORB's 3.
        border: how a picture goes on beyond its border: as its last row, or mirrored at it.

    Source: Wang et al. 2004, eq. 13.
    """

    def mean(pictures: Tensor) -> Tensor:
        return _gaussian_mean(pictures, radius_px, border)

    mean_a, mean_b = mean(image), mean(truth)
    variance_a = mean(image.square()) - mean_a.square()
    variance_b = mean(truth.square()) - mean_b.square()
    covariance = mean(image * truth) - mean_a * mean_b
    level = (2 * mean_a * mean_b + SSIM_C1) / (mean_a.square() + mean_b.square() + SSIM_C1)
    structure = (2 * covariance + SSIM_C2) / (variance_a + variance_b + SSIM_C2)
    return (level * structure).mean(-1, keepdim=True)


def _gaussian_mean(
    pictures: Float[Tensor, "V H W C"], radius_px: int, border: Border
) -> Float[Tensor, "V H W C"]:
    """Mean over SSIM's window, one axis after the other."""
    offset = torch.arange(-radius_px, radius_px + 1).to(pictures)
    window = (-0.5 * (offset / SSIM_SPREAD_PX) ** 2).exp()
    window = window / window.sum()
    planes = pictures.movedim(-1, 1).flatten(0, 1)[:, None]
    padded = functional.pad(planes, [radius_px] * 4, mode=border)
    rows = functional.conv2d(padded, window.view(1, 1, -1, 1))
    mean = functional.conv2d(rows, window.view(1, 1, 1, -1))
    views, channels = len(pictures), pictures.shape[-1]
    return mean.view(views, channels, *mean.shape[2:]).movedim(1, -1)
