"""Cutting an object out of a picture with a plain background.

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
BORDER_DEGREE, FULL_DEGREE = 2, 4  # of the polynomials through the border and the background
FIT_SAMPLES = 20_000  # pixels that stand for the whole background
ROBUST_ITERATIONS = 20
ROBUST_START, ROBUST_END = 0.2, 0.01  # Oklab; width of the weights at the first and last iteration
MAD_TO_SIGMA = 1.4826  # of a normal distribution
MIN_TOLERANCE, MAX_TOLERANCE = 0.035, 0.10  # Oklab; a just noticeable difference is about 0.02
MAX_SCATTER = 0.05  # Oklab; a border of more is a pattern, not noise
NOISE_TOLERANCE = 4.0  # standard deviations of the border about its gradient
MIN_PLAIN_SHARE = 0.6  # of the border; an object may be cut off at one side
DRIFT_ITERATIONS = 3  # of widening the background and following it where it leaves the gradient
LEAST_WEIGHT = np.float32(0.05)  # share of background in a window below which its drift fades out
DRIFT_SHARE = 0.03  # radius over which that is averaged, of the picture's longer side
SHADOW_DARKEST = 0.6  # cube root of the light that is left: a fifth; darker is called object
SHADOW_CHROMA = 0.02  # Oklab; a shadow keeps the background's hue, up to a tinted skylight
SHADOW_SLOPE = 0.012  # Oklab per pixel; object edges are steeper
SHADOW_GAP_PX = 2  # what is narrower is no way for a shadow into the object
MIN_OBJECT_SHARE, MAX_OBJECT_SHARE = 0.0005, 0.9  # of the picture's pixels
SIDE_SHARE = 0.1  # of a side's pixels; an object that takes more is cut off there
SPECK_PX = 12  # fewer pixels than this are noise
HOLE_SHARE = 0.004  # of the object; smaller enclosed patches of background are highlights
HOLE_DIFFERENCE = 0.35  # root mean square difference of a hole from the background, of tolerances
MAX_EDGE_DEPTH_PX = 4  # inside the outline, up to which pixels may be mixtures; found by looking
EDGE_MARGIN_PX = 2  # outside the outline, within which they may be
EDGE_CONTRAST = 0.02  # linear light; below this mixtures cannot be told from noise
PATTERN_WEIGHT = 4.0  # of the colours' variance nearby, against the contrast across the edge
CLEARLY_TOLD = 0.8  # weight of a mixture beyond which it says how soft the edges are
ALL_OBJECT = 0.9  # a mixture of this share of object is taken for the object alone
MIN_WEIGHT = 1e-4  # protects divisions by local weights


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
    backdrop, tolerance = fit_backdrop(lab)
    behind, backdrop = _flood(lab, backdrop, tolerance)
    shadow = _soft_shadow(lab, backdrop, behind, tolerance)
    inside = _without_specks(~(behind | shadow))
    _refuse_extremes(inside)
    if shadow.sum() > MIN_OBJECT_SHARE * shadow.size:
        notify("shadow_removed", "a soft shadow was taken for background")
    holes = _holes(lab, backdrop, inside, tolerance, notify)
    return _soft_edge(linear.numpy(), inside & ~holes)


def oklab(rgb_linear: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """Lightness and two opponent colours in which equal distances look about equally large."""
    cones = rgb_linear @ rgb_linear.new_tensor(OKLAB_CONES).T
    return cones.clamp_min(0.0).pow(1.0 / 3.0) @ rgb_linear.new_tensor(OKLAB_OPPONENT).T


def fit_backdrop(lab: NDArray[np.float32]) -> tuple[NDArray[np.float32], float]:
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
    terms = _terms(ring, BORDER_DEGREE)
    residual = np.linalg.norm(seen - np.median(seen, 0), axis=1)
    coefficients = np.zeros((terms.shape[1], 3))
    for width_now in np.geomspace(ROBUST_START, ROBUST_END, ROBUST_ITERATIONS):
        weight = 1.0 / (1.0 + (residual / width_now) ** 2)
        coefficients = _least_squares(terms, seen, weight)
        residual = np.linalg.norm(seen - terms @ coefficients, axis=1)
    plain = residual < MAX_TOLERANCE
    share = float(plain.mean())
    scatter = MAD_TO_SIGMA * float(np.median(residual[plain])) if plain.any() else 0.0
    if share < MIN_PLAIN_SHARE:
        raise ValueError(
            f"wanted a plain background, but only {100 * share:.0f} % of the picture's border is "
            f"of one colour or gradient (the object touches it, or the scene is busy); {ADVICE}"
        )
    if scatter > MAX_SCATTER:
        raise ValueError(
            "wanted a plain background, but the picture's border is no even colour or gradient: "
            f"it scatters by {scatter:.3f}, more than {MAX_SCATTER:.3f}, in Oklab; {ADVICE}"
        )
    tolerance = float(np.clip(NOISE_TOLERANCE * scatter, MIN_TOLERANCE, MAX_TOLERANCE))
    return _surface(coefficients, BORDER_DEGREE, height, width), tolerance


def _powers(degree: int) -> list[tuple[int, int]]:
    """Exponents of y and x of all terms of a polynomial."""
    return [(i, total - i) for total in range(degree + 1) for i in range(total + 1)]


def _terms(where: NDArray[np.bool_], degree: int) -> NDArray[np.float64]:
    """All terms at the marked pixels, [P, T]; x and y run from -1 to 1 over the picture."""
    rows, columns = np.nonzero(where)
    y, x = np.linspace(-1, 1, where.shape[0])[rows], np.linspace(-1, 1, where.shape[1])[columns]
    return np.stack([y**i * x**j for i, j in _powers(degree)], -1)


def _surface(
    coefficients: NDArray[np.float64], degree: int, height: int, width: int
) -> NDArray[np.float32]:
    """A polynomial at every pixel, [H, W, 3]."""
    y, x = np.linspace(-1, 1, height), np.linspace(-1, 1, width)
    total = np.zeros((height, width, 3), np.float32)
    for (i, j), coefficient in zip(_powers(degree), coefficients, strict=True):
        total += np.outer(y**i, x**j).astype(np.float32)[..., None] * coefficient.astype(np.float32)
    return total


def _least_squares(
    terms: NDArray[np.float64], values: NDArray[np.float64], weight: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Coefficients [T, 3] that fit the values best."""
    weighted = terms * weight[:, None]
    found = np.linalg.lstsq(weighted.T @ terms, weighted.T @ values, rcond=None)[0]
    return found.astype(np.float64)


def _flood(
    lab: NDArray[np.float32], backdrop: NDArray[np.float32], tolerance: float
) -> tuple[NDArray[np.bool_], NDArray[np.float32]]:
    """Pixels like the background that are connected to the border, and the background itself.

    The border tells a quadratic. Each round fits a quartic to all that was reached, as lenses and
    lamps leave it, and adds the local mean of what is left over.
    """
    height, width = lab.shape[:2]
    smooth = ndimage.uniform_filter(lab, (3, 3, 1))
    radius = max(1, round(DRIFT_SHARE * max(height, width)))
    behind = _from_border(np.linalg.norm(smooth - backdrop, axis=-1) < tolerance)
    sample = np.zeros_like(behind)
    step = max(1, round((height * width / FIT_SAMPLES) ** 0.5))
    for _ in range(DRIFT_ITERATIONS):
        sample[::step, ::step] = behind[::step, ::step]
        seen = lab[sample].astype(np.float64)
        found = _least_squares(_terms(sample, FULL_DEGREE), seen, np.ones(len(seen)))
        gradient = _surface(found, FULL_DEGREE, height, width)
        weight = _local_mean(behind[..., None].astype(np.float32), radius)
        drift = _local_mean((lab - gradient) * behind[..., None], radius)
        # Where no background is near, the gradient is all that is known.
        backdrop = (gradient + drift / np.maximum(weight, LEAST_WEIGHT)).astype(np.float32)
        behind = _from_border(np.linalg.norm(smooth - backdrop, axis=-1) < tolerance)
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
    kept = np.bincount(label.ravel(), minlength=count + 1) >= SPECK_PX
    kept[0] = False
    return kept[label]


def _refuse_extremes(inside: NDArray[np.bool_]) -> None:
    """Raise where nothing or nearly everything stands out, or something from side to side."""
    share = float(inside.mean())
    if share < MIN_OBJECT_SHARE:
        raise ValueError(f"nothing stands out from the plain background; {ADVICE}")
    if share > MAX_OBJECT_SHARE:
        raise ValueError(
            f"{100 * share:.0f} % of the picture differ from its border's colour: no background "
            f"is left to tell the object from; {ADVICE}"
        )
    sides = (inside[0], inside[-1], inside[:, 0], inside[:, -1])
    reached = [float(side.mean()) > SIDE_SHARE for side in sides]
    if (reached[0] and reached[1]) or (reached[2] and reached[3]):
        raise ValueError(
            "what stands out from the border's colour reaches two opposite sides of the picture: "
            f"that is a scene or a bar across it, not an object; {ADVICE}"
        )


def _holes(
    lab: NDArray[np.float32],
    backdrop: NDArray[np.float32],
    inside: NDArray[np.bool_],
    tolerance: float,
    notify: Notify,
) -> NDArray[np.bool_]:
    """Background seen through the object: enclosed patches of just its colour.

    A label or a highlight may come near that colour, but it is seldom as even.
    """
    smooth = ndimage.uniform_filter(lab, (3, 3, 1))
    difference = np.linalg.norm(smooth - backdrop, axis=-1)
    label, count = ndimage.label(inside & (difference < tolerance))
    sizes = np.bincount(label.ravel(), minlength=count + 1)
    squares = np.bincount(label.ravel(), (difference**2).ravel(), minlength=count + 1)
    even = np.sqrt(squares / np.maximum(sizes, 1)) < HOLE_DIFFERENCE * tolerance
    holes = even & (sizes >= max(SPECK_PX, HOLE_SHARE * inside.sum()))
    holes[0] = False
    if holes.any():
        notify(
            "seen_through",
            f"patches inside the object of just the background's colour: {int(holes.sum())}, "
            "taken for holes; give a picture with the object cut out if they are none",
        )
    return holes[label]


def _soft_edge(linear: NDArray[np.float32], inside: NDArray[np.bool_]) -> Float[Tensor, "H W 1"]:
    """Coverage along the outline, from how each pixel mixes the colours on its two sides.

    How far inside the outline pixels are mixtures is the same all around: beyond that, a pixel like
    the background is the object's own pattern.
    """
    signed = np.where(
        inside, ndimage.distance_transform_edt(inside), -ndimage.distance_transform_edt(~inside)
    )
    back, back_variance, has_back = _nearby_colour(
        linear, signed <= -EDGE_MARGIN_PX, EDGE_MARGIN_PX
    )
    for depth in range(1, MAX_EDGE_DEPTH_PX + 1):
        front, front_variance, has_front = _nearby_colour(linear, signed > depth, depth)
        axis = front - back
        contrast = (axis**2).sum(-1)
        mixed = ((linear - back) * axis).sum(-1) / np.maximum(contrast, EDGE_CONTRAST**2)
        noise = EDGE_CONTRAST**2 + PATTERN_WEIGHT * (front_variance + back_variance)
        told = np.where(has_front & has_back, contrast / (contrast + noise), 0.0)
        shell = (told > CLEARLY_TOLD) & (np.abs(signed - depth) < 0.5)
        if shell.any() and float(np.median(mixed[shell])) > ALL_OBJECT:
            break
    # Where pattern hides the mixture, the edge lies where it does elsewhere.
    outline = np.clip(0.5 * (signed - depth) + 1.0, 0.0, 1.0)
    # Parts too thin to have a sure inside: the most different pixel nearby is all object.
    away = np.sqrt(((linear - back) ** 2).sum(-1))
    thin = away / np.maximum(ndimage.maximum_filter(away, 2 * EDGE_MARGIN_PX + 1), EDGE_CONTRAST)
    outline = np.where(has_back & ~has_front, thin, outline)
    coverage = told * np.clip(mixed, 0.0, 1.0) + (1.0 - told) * outline
    lowest = np.where(has_front, np.clip(signed - depth + 0.5, 0.0, 1.0), 0.0)
    highest = np.clip(1.0 + signed / EDGE_MARGIN_PX, 0.0, 1.0)
    coverage = np.clip(coverage, lowest, highest)
    return torch.from_numpy(coverage.astype(np.float32))[..., None]


def _nearby_colour(
    linear: NDArray[np.float32], sure: NDArray[np.bool_], reach: int
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_]]:
    """Of sure pixels nearby: mean colour [H, W, 3], variance [H, W], whether there were any."""
    sigma = (reach, reach, 0)
    weight = ndimage.gaussian_filter(sure[..., None].astype(np.float32), sigma)
    weight = np.maximum(weight, MIN_WEIGHT)
    mean = ndimage.gaussian_filter(linear * sure[..., None], sigma) / weight
    square = ndimage.gaussian_filter((linear**2).sum(-1) * sure, reach) / weight[..., 0]
    variance = np.maximum(square - (mean**2).sum(-1), 0.0)
    return mean, variance, weight[..., 0] > 10.0 * MIN_WEIGHT
