"""What a generator does to the content of a view, where every pixel stays in its place.

Each function changes one thing by a strength of its own; a strength of zero is left to the caller,
who then changes nothing. Colours are linear and straight (not premultiplied) unless told otherwise.
A length in `px` is one of pixels of a picture 256 wide, as in `displacements`.
"""

import math

import torch
from jaxtyping import Float
from scipy.ndimage import distance_transform_edt
from torch import Tensor
from torch.nn import functional

from svim3d.color import luminance
from svim3d.numerics import dot, normalize, saturate
from svim3d.synthesis.displacements import nominal_px, pixel_centres, resample

MIN_COVERAGE = 1e-3  # below it a pixel holds no colour that could be divided out
MIN_LUMINANCE = 1e-6  # guards the ratio of two mean luminances where a view is black
BLUR_LEVELS = 4  # Gaussians between which each pixel's own width is interpolated
MIN_SPREAD_PX = 1e-6  # guards the division by the widest blur where there is none
GAUSSIAN_REACH = 3.0  # standard deviations beyond which a Gaussian counts as zero
# A disc is searched along rings, so that parts thinner than it are found too.
DISC_DIRECTIONS, DISC_RINGS = 16, 3


def blurred(
    picture: Float[Tensor, "H W C"],
    mask: Float[Tensor, "H W 1"],
    spread_px: Float[Tensor, "H W 1"],
) -> Float[Tensor, "H W C"]:
    """Straight values, each a Gaussian mean over covered pixels of the standard deviation given.

    Between `BLUR_LEVELS` pictures of equal steps of the deviation values are interpolated.
    """
    widest = float(spread_px.max()) * picture.shape[1] * 0.5 * float(nominal_px(_shape(mask))[0])
    weighted = torch.cat([picture * mask, mask], -1)
    levels = [
        weighted if level == 0 else _gaussian_mean(weighted, widest * level / (BLUR_LEVELS - 1))
        for level in range(BLUR_LEVELS)
    ]
    stack = torch.stack(levels)
    straight = stack[..., :-1] / stack[..., -1:].clamp_min(MIN_COVERAGE)
    place = spread_px / spread_px.max().clamp_min(MIN_SPREAD_PX) * (BLUR_LEVELS - 1)
    away = (place - torch.arange(BLUR_LEVELS).to(place).view(-1, 1, 1, 1)).abs()
    return torch.where(mask > MIN_COVERAGE, (straight * saturate(1.0 - away)).sum(0), picture)


def _gaussian_mean(picture: Float[Tensor, "H W C"], deviation: float) -> Float[Tensor, "H W C"]:
    """Mean by a Gaussian whose deviation is in pixels of this picture; zero beyond its border."""
    radius = max(1, math.ceil(GAUSSIAN_REACH * deviation))
    offset = torch.arange(-radius, radius + 1).to(picture)
    window = (-0.5 * (offset / max(deviation, 1e-3)) ** 2).exp()
    window = window / window.sum()
    planes = picture.permute(2, 0, 1)[:, None]
    rows = functional.conv2d(planes, window.view(1, 1, -1, 1), padding=(radius, 0))
    both = functional.conv2d(rows, window.view(1, 1, 1, -1), padding=(0, radius))
    return both[:, 0].permute(1, 2, 0)


def drifted(
    colour: Float[Tensor, "H W 3"], stops: Float[Tensor, "H W 3"]
) -> Float[Tensor, "H W 3"]:
    """Linear colour, or premultiplied radiance, times two to the power of `stops`."""
    return colour * torch.exp2(stops)


def with_baked_light(
    basecolor: Float[Tensor, "H W 3"],
    radiance: Float[Tensor, "H W 3"],
    mask: Float[Tensor, "H W 1"],
    share: float,
) -> Float[Tensor, "H W 3"]:
    """Basecolor of which a share was taken from the lit picture: its shading and its highlights.

    Args:
        basecolor: linear, straight.
        radiance: linear, premultiplied; exposed so that both have one mean luminance.
        mask: coverage.
        share: of the lit picture, 0 to 1.
    """
    lit = radiance / mask.clamp_min(MIN_COVERAGE)
    exposure = (luminance(basecolor) * mask).mean() / (luminance(lit) * mask).mean().clamp_min(
        MIN_LUMINANCE
    )
    mixed = basecolor + share * (saturate(lit * exposure) - basecolor)
    return torch.where(mask > MIN_COVERAGE, mixed, basecolor)


def with_tilted_normals(
    normal: Float[Tensor, "H W 3"], noise: Float[Tensor, "H W 3"], largest_deg: float
) -> Float[Tensor, "H W 3"]:
    """Unit normals, each turned by no more than `largest_deg`; zero vectors stay zero.

    Args:
        normal: unit, or zero where nothing is; world or camera space.
        noise: vectors no longer than 1 in the same space; the part across the normal tilts it.
        largest_deg: angle that a unit vector across the normal stands for, below 90.
    """
    across = noise - dot(noise, normal) * normal
    tilted = normalize(normal + math.tan(math.radians(largest_deg)) * across)
    return torch.where(dot(normal, normal) > 0.5, tilted, normal)


def with_moved_silhouette(
    mask: Float[Tensor, "H W 1"], outward_px: Float[Tensor, "H W 1"]
) -> Float[Tensor, "H W 1"]:
    """Coverage whose outline has moved outward (dilation), or inward where negative (erosion).

    Each pixel takes the largest, or the smallest, coverage within a disc of that radius, which
    need not be a whole number of pixels.
    """
    # Inward, the largest share of the background within the disc is wanted.
    inward = outward_px < 0.0
    signed = torch.where(inward, -mask, mask)
    best = signed
    centres = pixel_centres(_shape(mask), mask)
    radius = outward_px.abs() * nominal_px(_shape(mask)).to(mask)
    for ring in range(1, DISC_RINGS + 1):
        for turn in range(DISC_DIRECTIONS):
            angle = math.tau * (turn + 0.5 * (ring % 2)) / DISC_DIRECTIONS
            direction = mask.new_tensor([math.cos(angle), math.sin(angle)])
            found = resample(mask, centres + radius * direction * (ring / DISC_RINGS))
            best = torch.maximum(best, torch.where(inward, -found, found))
    return best.abs()


def spread_outward(
    picture: Float[Tensor, "H W C"], mask: Float[Tensor, "H W 1"]
) -> Float[Tensor, "H W C"]:
    """Straight values where something is covered, elsewhere those of the nearest such pixel."""
    empty = (mask[..., 0] <= MIN_COVERAGE).cpu().numpy()
    if empty.all():
        return picture
    nearest = distance_transform_edt(empty, return_distances=False, return_indices=True)
    row, column = torch.from_numpy(nearest).long().to(picture.device)
    return picture[row, column]


def _shape(mask: Float[Tensor, "H W 1"]) -> tuple[int, int]:
    return mask.shape[0], mask.shape[1]
