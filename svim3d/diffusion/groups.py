"""The eleven channels of a view as four pictures, and back.

RGB and basecolor are display-referred over a background (white where none is said); roughness and
metallic sit in the green and blue of a picture whose red is 0, as in glTF; normals are the camera's
(x right, y up, z to the camera). The last two lie on black. All are in [-1, 1] for the autoencoder.

Source: Engelhardt et al. 2025, SViM3D, section 3.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from svim3d.color import linear_from_srgb
from svim3d.numerics import normalize

GROUPS = ("rgb", "basecolor", "orm", "normal")  # the order of their channels in a latent
# Coverage at and below which a pixel of the decoded normals is background: twice the 8-bit steps
# by which an autoencoder leaves black.
BACKGROUND_COVERAGE = 0.1
FULL_COVERAGE = 0.9
SMALLEST_COVERAGE = 1e-3  # protects the division that takes the background out of a pixel


@dataclass(frozen=True)
class GeneratedViews:
    """Views of one clip, channel last, on the square that the model sees.

    Attributes:
        rgb_linear: straight radiance in the exposure of the reference picture.
        basecolor: linear, straight.
        roughness: straight.
        metallic: straight.
        normal_camera: unit; x right, y up, z to the camera. Zero where the mask is.
        mask: coverage in [0, 1].
    """

    rgb_linear: Float[Tensor, "K H W 3"]
    basecolor: Float[Tensor, "K H W 3"]
    roughness: Float[Tensor, "K H W 1"]
    metallic: Float[Tensor, "K H W 1"]
    normal_camera: Float[Tensor, "K H W 3"]
    mask: Float[Tensor, "K H W 1"]


def unpack(
    pictures: dict[str, Float[Tensor, "K 3 H W"]], normal_length: float = 1.0
) -> GeneratedViews:
    """Views from the four decoded pictures, each in [-1, 1], over white and black.

    Args:
        pictures: by group.
        normal_length: of decoded normals, see `coverage`.
    """
    planes = {
        name: ((picture.permute(0, 2, 3, 1) + 1.0) / 2.0).clamp(0.0, 1.0)
        for name, picture in pictures.items()
    }
    shown = coverage(planes["normal"], normal_length)
    mask = sharpen(shown)
    seen = (mask > 0.0).to(mask)
    # What is nearly full is taken for full; a rim is divided by the share that it was mixed by.
    share = torch.where(shown < FULL_COVERAGE, shown, torch.ones_like(shown))
    roughness, metallic = without_background(planes["orm"], share, 0.0)[..., 1:].split(1, -1)
    normal = normalize(2.0 * without_background(planes["normal"], share, 0.0) - 1.0)
    return GeneratedViews(
        rgb_linear=linear_from_srgb(without_background(planes["rgb"], share, 1.0)) * seen,
        basecolor=linear_from_srgb(without_background(planes["basecolor"], share, 1.0)) * seen,
        roughness=roughness * seen,
        metallic=metallic * seen,
        normal_camera=normal * seen,
        mask=mask,
    )


def coverage(normal: Float[Tensor, "*b 3"], length: float = 1.0) -> Float[Tensor, "*b 1"]:
    """Share of a pixel that an encoded normal over black covers.

    A pixel p = m (n + 1) / 2 with |n| = l gives |2 p - m 1| = l m, that is
    (3 - l^2) m^2 / 2 - 2 m sum(p) + 2 |p|^2 = 0, whose smaller root is the coverage, unless, for
    l = 1, n.x + n.y + n.z < -1: normals that point far down and to the left, which only faces seen
    at a grazing angle have.

    Args:
        normal: pixels in [0, 1].
        length: of the normals: 1, or less where a model's answer is a mean of several.
    """
    total = normal.sum(-1, keepdim=True)
    squares = (normal**2).sum(-1, keepdim=True)
    lead = (3.0 - length**2) / 2.0
    root = (total**2 - 2.0 * lead * squares).clamp(min=0.0).sqrt()
    return ((total - root) / lead).clamp(0.0, 1.0)


def sharpen(mask: Float[Tensor, "*b 1"]) -> Float[Tensor, "*b 1"]:
    """Stretch coverage so that a nearly empty pixel is empty and a nearly full one is full."""
    stretched = (mask - BACKGROUND_COVERAGE) / (FULL_COVERAGE - BACKGROUND_COVERAGE)
    return stretched.clamp(0.0, 1.0)


def without_background(
    plane: Float[Tensor, "*b c"], mask: Float[Tensor, "*b 1"], background: float
) -> Float[Tensor, "*b c"]:
    """The object's share of pixels that show it over a background."""
    share = mask.clamp(min=SMALLEST_COVERAGE)
    return ((plane - (1.0 - mask) * background) / share).clamp(0.0, 1.0)


def over_background(
    rgb: Float[Tensor, "*#b H W 3"],
    mask: Float[Tensor, "*#b H W 1"],
    color: Float[Tensor, "*#b 1 1 3"],
) -> Float[Tensor, "*b H W 3"]:
    """Another background behind display-referred pictures that stand on white."""
    return rgb - (1.0 - mask) * (1.0 - color)


def as_network_input(pictures: Float[Tensor, "*b H W 3"]) -> Float[Tensor, "*b 3 H W"]:
    """Channel-last pictures in [0, 1] as channel-first ones in [-1, 1]."""
    return 2.0 * pictures.movedim(-1, -3) - 1.0
