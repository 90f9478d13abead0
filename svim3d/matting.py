"""Cutting an object out of a picture: plain backgrounds, soft edges, colours without fringe.

A background is plain if one smooth gradient explains the border of the picture. The object is what
cannot be reached from the border over pixels of that gradient, or over its own soft shadow.
Mixtures are undone in linear light, where a sensor makes them; likeness is judged in Oklab.
"""

from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from scipy import ndimage
from torch import Tensor
from torch.nn.functional import interpolate

from svim3d.color import linear_from_srgb

Notify = Callable[[str, str], None]

# Source: Ottosson 2020, "A perceptual color space for image processing" (matrices of the web page).
OKLAB_CONES = (
    (0.4122214708, 0.5363325363, 0.0514459929),
    (0.2119034982, 0.6806995451, 0.1073969566),
    (0.0883024619, 0.2817188376, 0.6299787005),
)
OKLAB_OPPONENT = (
    (0.2104542553, 0.7936177850, -0.0040720468),
    (1.9779984951, -2.4285922050, 0.4505937099),
    (0.0259040371, 0.7827717662, -0.8086757660),
)
ADVICE = (
    "give a picture with the object cut out (PNG with opacity), give --matting NETWORK.onnx, "
    "or install svim3d[matting]"
)
MIN_SIDE_PX = 16  # below this a border of pixels tells nothing of the background
BORDER_SHARE = 0.02  # width of the frame that is looked at, of the picture's shorter side
ROBUST_ITERATIONS = 20
ROBUST_START, ROBUST_END = 0.2, 0.01  # Oklab; width of the weights at the first and last iteration
MAD_TO_SIGMA = 1.4826  # of a normal distribution
MIN_TOLERANCE, MAX_TOLERANCE = 0.035, 0.10  # Oklab; a just noticeable difference is about 0.02
NOISE_TOLERANCE = 4.0  # standard deviations of the border about its gradient
MIN_PLAIN_SHARE = 0.6  # of the border; an object may be cut off at one side
DRIFT_ITERATIONS = 3  # of widening the background and following it where it leaves the gradient
LEAST_WEIGHT = np.float32(0.05)  # share of background in a window below which its drift fades out
DRIFT_SHARE = 0.03  # radius over which that is averaged, of the picture's longer side
SHADOW_DARKEST = 0.6  # cube root of the light that is left: a fifth; darker is called object
SHADOW_CHROMA = 0.02  # Oklab; a shadow keeps the background's hue, up to a tinted skylight
SHADOW_SLOPE = 0.012  # Oklab per pixel; object edges are steeper
SHADOW_GAP_PX = 2  # what is narrower is no way for a shadow into the object
MIN_OBJECT_SHARE, MAX_OBJECT_SHARE = 0.0005, 0.95  # of the picture's pixels
SPECK_PX = 12  # fewer pixels than this are noise
HOLE_SHARE = 0.002  # of the object; smaller enclosed patches of background are highlights
CLIPPED = 0.985  # sRGB; white beyond this may be a highlight, a label, or the background
EDGE_SHARE = 1.0 / 400.0  # half width of a soft edge, of the picture's longer side
MIN_EDGE_PX, MAX_EDGE_PX = 2, 5
EDGE_CONTRAST = 0.02  # linear light; below this mixtures cannot be told from noise
MIN_WEIGHT = 1e-4  # protects divisions by local weights
FUSION_RADII_PX = (90, 6)  # Source: Forte 2021, "Approximate fast foreground colour estimation"
GUIDE_SIDE_PX = 512  # the guided filter's coefficients are smooth: found on a small picture
GUIDE_NOISE = 1e-4  # variance of the guide that is smoothed over; Source: He et al. 2013


def cut_out_plain(rgb_srgb: Float[Tensor, "H W 3"], notify: Notify) -> Float[Tensor, "H W 1"]:
    """Coverage of the object in front of a plain background.

    Args:
        rgb_srgb: display-encoded, in [0, 1].
        notify: told (kind, message) of what was taken for shadow or kept though it looks like
            background.

    Raises:
        ValueError: the background is not plain, or nothing or everything stands out from it; says
            what to do instead.
    """
    height, width = rgb_srgb.shape[:2]
    if min(height, width) < MIN_SIDE_PX:
        raise ValueError(
            f"wanted at least {MIN_SIDE_PX} pixels per side to find the object on its background, "
            f"got {height} x {width}; {ADVICE}"
        )
    linear = linear_from_srgb(rgb_srgb)
    lab = oklab(linear).numpy()
    gradient, tolerance = fit_backdrop(lab)
    behind, backdrop = _flood(lab, gradient, tolerance)
    shadow = _soft_shadow(lab, backdrop, behind, tolerance)
    inside = _without_specks(~(behind | shadow))
    _refuse_extremes(inside)
    if shadow.sum() > MIN_OBJECT_SHARE * shadow.size:
        notify("shadow_removed", "a soft shadow was taken for background")
    holes = _holes(lab, backdrop, inside, tolerance, rgb_srgb.numpy(), notify)
    return _soft_edge(linear.numpy(), inside & ~holes)


def oklab(rgb_linear: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """Lightness and two opponent colours in which equal distances look about equally large."""
    cones = rgb_linear @ rgb_linear.new_tensor(OKLAB_CONES).T
    return cones.clamp_min(0.0).pow(1.0 / 3.0) @ rgb_linear.new_tensor(OKLAB_OPPONENT).T


def fit_backdrop(
    lab: NDArray[np.float32],
) -> tuple[NDArray[np.float32], float]:
    """The quadratic gradient [H, W, 3] through the picture's border, and the distance it scatters.

    Least squares with weights of Cauchy that narrow from iteration to iteration: what covers up to
    about 40 % of the border has no say.

    Raises:
        ValueError: too little of the border follows one gradient.
    """
    height, width = lab.shape[:2]
    ring = np.ones((height, width), bool)
    thick = max(1, round(BORDER_SHARE * min(height, width)))
    ring[thick:-thick, thick:-thick] = False
    seen = lab[ring].astype(np.float64)
    basis = _quadratic_basis(height, width)
    rows = basis[ring]
    residual = np.linalg.norm(seen - np.median(seen, 0), axis=1)
    coefficients = np.zeros((rows.shape[1], 3))
    for width_now in np.geomspace(ROBUST_START, ROBUST_END, ROBUST_ITERATIONS):
        weight = 1.0 / (1.0 + (residual / width_now) ** 2)
        weighted = rows * weight[:, None]
        coefficients = np.linalg.lstsq(weighted.T @ rows, weighted.T @ seen, rcond=None)[0]
        residual = np.linalg.norm(seen - rows @ coefficients, axis=1)
    plain = residual < MAX_TOLERANCE
    share = float(plain.mean())
    scatter = MAD_TO_SIGMA * float(np.median(residual[plain])) if share > 0 else np.inf
    if share < MIN_PLAIN_SHARE or NOISE_TOLERANCE * scatter > 2.0 * MAX_TOLERANCE:
        raise ValueError(
            f"wanted a plain background, but only {100 * share:.0f} % of the picture's border is "
            f"of one colour or gradient (the object touches it, or the scene is busy); {ADVICE}"
        )
    tolerance = float(np.clip(NOISE_TOLERANCE * scatter, MIN_TOLERANCE, MAX_TOLERANCE))
    return (basis @ coefficients).astype(np.float32), tolerance


def _quadratic_basis(height: int, width: int) -> NDArray[np.float64]:
    """1, x, y, x^2, xy, y^2 at every pixel, [H, W, 6]; x and y run from -1 to 1."""
    y, x = np.meshgrid(np.linspace(-1, 1, height), np.linspace(-1, 1, width), indexing="ij")
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], -1)


def _flood(
    lab: NDArray[np.float32], gradient: NDArray[np.float32], tolerance: float
) -> tuple[NDArray[np.bool_], NDArray[np.float32]]:
    """Pixels like the background that are connected to the border, and the background itself.

    Real backgrounds leave a quadratic: each round adds the local mean of what was left over.
    """
    smooth = ndimage.uniform_filter(lab, (3, 3, 1))
    radius = max(1, round(DRIFT_SHARE * max(lab.shape[:2])))
    backdrop = gradient
    behind = np.zeros(lab.shape[:2], bool)
    for _ in range(DRIFT_ITERATIONS):
        behind = _from_border(np.linalg.norm(smooth - backdrop, axis=-1) < tolerance)
        weight = _local_mean(behind[..., None].astype(np.float32), radius)
        drift = _local_mean((lab - gradient) * behind[..., None], radius)
        # Where no background is near, the gradient is all that is known.
        backdrop = gradient + drift / np.maximum(weight, LEAST_WEIGHT)
    return behind, backdrop


def _local_mean(values: NDArray[np.float32], radius: int) -> NDArray[np.float32]:
    """Two passes of a box filter: about a Gaussian, at a cost that does not grow with it."""
    size = (2 * radius + 1, 2 * radius + 1, 1)
    once = ndimage.uniform_filter(values, size, mode="nearest")
    return ndimage.uniform_filter(once, size, mode="nearest")


def _from_border(allowed: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The part of a region that is connected to the picture's border."""
    label, _ = ndimage.label(allowed)
    edge = np.concatenate([label[0], label[-1], label[:, 0], label[:, -1]])
    reached = np.zeros(int(label.max()) + 1, bool)
    reached[edge] = True
    reached[0] = False
    return reached[label]


def _soft_shadow(
    lab: NDArray[np.float32],
    backdrop: NDArray[np.float32],
    behind: NDArray[np.bool_],
    tolerance: float,
) -> NDArray[np.bool_]:
    """Darker background that fades in smoothly from the lit background.

    Less light scales all three of Oklab's coordinates by one factor, the cube root of its share.
    """
    smooth = ndimage.uniform_filter(lab, (3, 3, 1))
    along = (smooth * backdrop).sum(-1) / np.maximum((backdrop**2).sum(-1), 1e-6)
    across = np.linalg.norm(smooth - along[..., None] * backdrop, axis=-1)
    slope = np.hypot(ndimage.sobel(smooth[..., 0], 0) / 8.0, ndimage.sobel(smooth[..., 0], 1) / 8.0)
    dark = (along > SHADOW_DARKEST) & (along < 1.0 + 0.5 * tolerance)
    alike = across < max(SHADOW_CHROMA, 0.5 * tolerance)
    way = behind | (dark & alike & (slope < SHADOW_SLOPE))
    wide = ndimage.binary_erosion(way, iterations=SHADOW_GAP_PX, border_value=1)
    reached = ndimage.binary_dilation(_from_border(wide), iterations=SHADOW_GAP_PX, mask=way)
    return reached & ~behind


def _without_specks(inside: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Drop regions of a few pixels, which noise makes."""
    label, count = ndimage.label(inside, np.ones((3, 3)))
    sizes = np.bincount(label.ravel(), minlength=count + 1)
    kept = sizes >= SPECK_PX
    kept[0] = False
    return kept[label]


def _refuse_extremes(inside: NDArray[np.bool_]) -> None:
    """Raise where nothing or nearly everything stands out."""
    share = float(inside.mean())
    if share < MIN_OBJECT_SHARE:
        raise ValueError(f"nothing stands out from the plain background; {ADVICE}")
    if share > MAX_OBJECT_SHARE:
        raise ValueError(
            f"{100 * share:.0f} % of the picture differ from its border's colour: no background "
            f"is left to tell the object from; {ADVICE}"
        )


def _holes(
    lab: NDArray[np.float32],
    backdrop: NDArray[np.float32],
    inside: NDArray[np.bool_],
    tolerance: float,
    rgb_srgb: NDArray[np.float32],
    notify: Notify,
) -> NDArray[np.bool_]:
    """Background seen through the object: enclosed patches of just its colour."""
    smooth = ndimage.uniform_filter(lab, (3, 3, 1))
    alike = inside & (np.linalg.norm(smooth - backdrop, axis=-1) < tolerance)
    label, count = ndimage.label(alike)
    sizes = np.bincount(label.ravel(), minlength=count + 1)
    large = sizes >= max(SPECK_PX, HOLE_SHARE * inside.sum())
    large[0] = False
    patches = large[label]
    if not patches.any():
        return patches
    if float(np.median(rgb_srgb[patches].min(-1))) > CLIPPED:
        notify(
            "holes_kept",
            f"{int(large.sum())} white patches inside the object may be background seen through "
            "it: kept; give a picture with the object cut out if they are",
        )
        return np.zeros_like(patches)
    return patches


def _soft_edge(linear: NDArray[np.float32], inside: NDArray[np.bool_]) -> Float[Tensor, "H W 1"]:
    """Coverage along the outline, from how each pixel mixes the colours on its two sides.

    A pixel is I = a F + (1 - a) B; F and B are means of what is surely object and background near
    it. Where the two are alike, or the object is thinner than the band, the region's own outline
    stays.
    """
    reach = int(np.clip(round(EDGE_SHARE * max(inside.shape)), MIN_EDGE_PX, MAX_EDGE_PX))
    signed = np.where(
        inside, ndimage.distance_transform_edt(inside), -ndimage.distance_transform_edt(~inside)
    )
    # The region was drawn at the faintest difference, a pixel or so outside the true edge.
    lowest = np.clip((signed - 1.5) / reach, 0.0, 1.0)
    highest = np.clip(1.0 + signed / reach, 0.0, 1.0)
    front = _nearby_colour(linear, lowest >= 1.0, reach + 1)
    back = _nearby_colour(linear, highest <= 0.0, reach + 1)
    difference = front[0] - back[0]
    contrast = (difference**2).sum(-1)
    mixed = ((linear - back[0]) * difference).sum(-1) / np.maximum(contrast, 1e-8)
    known = contrast / (contrast + EDGE_CONTRAST**2) * front[1] * back[1]
    outline = ndimage.gaussian_filter(inside.astype(np.float32), 0.7)
    coverage = np.clip(known * np.clip(mixed, 0.0, 1.0) + (1.0 - known) * outline, lowest, highest)
    return torch.from_numpy(coverage.astype(np.float32))[..., None]


def _nearby_colour(
    linear: NDArray[np.float32], sure: NDArray[np.bool_], reach: int
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Mean colour [H, W, 3] of sure pixels nearby, and whether there were any, [H, W]."""
    sigma = (reach, reach, 0)
    weight = ndimage.gaussian_filter(sure[..., None].astype(np.float32), sigma)
    total = ndimage.gaussian_filter(linear * sure[..., None], sigma)
    return total / np.maximum(weight, MIN_WEIGHT), (weight[..., 0] > 10 * MIN_WEIGHT).astype(
        np.float32
    )


def foreground_colour(
    rgb_linear: Float[Tensor, "H W 3"], coverage: Float[Tensor, "H W 1"]
) -> Float[Tensor, "H W 3"]:
    """Straight linear colour of the object alone: the background's share is taken out.

    Source: Forte 2021, "Approximate fast foreground colour estimation" (blur fusion, two rounds).
    """
    colour, mask = rgb_linear.numpy(), coverage.numpy()
    front = back = colour
    for radius in FUSION_RADII_PX:
        front_mean = _weighted_mean(front, mask, radius)
        back = _weighted_mean(back, np.float32(1.0) - mask, radius)
        left_over = colour - mask * front_mean - (1.0 - mask) * back
        front = np.clip(front_mean + mask * left_over, 0.0, 1.0)
    return torch.from_numpy(front)


def _weighted_mean(
    values: NDArray[np.float32], weight: NDArray[np.float32], radius: int
) -> NDArray[np.float32]:
    """Box mean of `values` weighted by `weight`, which may vanish."""
    size = (2 * radius + 1, 2 * radius + 1, 1)
    total = ndimage.uniform_filter(values * weight, size, mode="nearest")
    share = ndimage.uniform_filter(weight, size, mode="nearest")
    return total / np.maximum(share, 1e-5)


def sharpen_coverage(
    rgb_srgb: Float[Tensor, "H W 3"], coverage: Float[Tensor, "H W 1"], *, radius_px: int
) -> Float[Tensor, "H W 1"]:
    """Move a blurred coverage onto the picture's own edges.

    Args:
        rgb_srgb: the guide.
        coverage: blurred over about `radius_px` pixels.
        radius_px: of the windows in which coverage is a linear function of colour.

    Source: He, Sun, Tang 2013, "Guided image filtering", eq. 14 to 16, with the coefficients found
    on a smaller picture as in He, Sun 2015, "Fast guided filter".
    """
    height, width = rgb_srgb.shape[:2]
    factor = max(1.0, max(height, width) / GUIDE_SIDE_PX)
    size = (max(1, round(height / factor)), max(1, round(width / factor)))
    both = torch.cat([rgb_srgb, coverage], -1).permute(2, 0, 1)[None]
    small = interpolate(both, size=size, mode="bilinear", antialias=True)[0].permute(1, 2, 0)
    radius = max(1, round(radius_px / factor))
    guide, target = small[..., :3].double(), small[..., 3:].double()
    mean_guide, mean_target = _box(guide, radius), _box(target, radius)
    products = (guide[..., :, None] * guide[..., None, :]).flatten(-2)
    variance = _box(products, radius).unflatten(-1, (3, 3))
    variance = variance - mean_guide[..., :, None] * mean_guide[..., None, :]
    covariance = _box(guide * target, radius) - mean_guide * mean_target
    regular = variance + GUIDE_NOISE * torch.eye(3, dtype=variance.dtype)
    slope = torch.linalg.solve(regular, covariance[..., None])[..., 0]
    offset = mean_target - (slope * mean_guide).sum(-1, keepdim=True)
    smooth = _box(torch.cat([slope, offset], -1), radius).float().permute(2, 0, 1)[None]
    full = interpolate(smooth, size=(height, width), mode="bilinear")[0].permute(1, 2, 0)
    sharp = (full[..., :3] * rgb_srgb).sum(-1, keepdim=True) + full[..., 3:]
    return sharp.clamp(0.0, 1.0)


def _box(values: Float[Tensor, "H W C"], radius: int) -> Float[Tensor, "H W C"]:
    """Mean over a square window, mirrored at the border."""
    size = (2 * radius + 1, 2 * radius + 1, 1)
    return torch.from_numpy(ndimage.uniform_filter(values.numpy(), size))
