"""The rules by which Stanford-ORB scores a capture, and rows that its rules hide.

All pictures are scene-linear. What the benchmark's script does, in its order:

- The mask is eroded by 5 x 5 pixels, and prediction and truth are black outside it.
- For PSNR-H both are multiplied by mean(sRGB(truth)) / mean(truth), both means of the truth
  clipped to [0, 1] and over the whole picture.
- Relit pictures and albedo are scaled per picture and channel by least squares; novel views are
  not.
- Both are clipped: to [0, 4] for PSNR-H, to [0, 1] for the rest. For PSNR-L, SSIM and LPIPS the
  sRGB curve follows; albedo stays linear.
- The mean square runs over ALL pixels: a foreground-only PSNR is lower by 10 log10(1 / share).
- A PSNR below that of a constant 0.5 inside the mask is replaced by it.
- SSIM is the mean over all pixels, window 3 x 3. LPIPS applies the sRGB curve once more.
- A missing picture counts as a white one. Because of the scale and the floor it costs little, so
  its number is told beside every mean.

Rows, each of which changes one rule of the official one: `foreground` means over the eroded mask
(LPIPS sees a whole picture and has no such row), `unscaled` leaves the scale away.
Source: Kuang et al. 2023, "Stanford-ORB", and the rules of its public evaluation script.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional

from svim3d.color import srgb_from_linear
from svim3d.metrics.pictures import structural_similarity
from svim3d.metrics.surface_agreement import squared_chamfer
from svim3d.metrics.surface_search import sample_surface
from svim3d.numerics import saturate

EROSION_PX = 5  # side of the square
PEAK_HDR, PEAK_LDR = 4.0, 1.0  # where pictures are clipped; the peak of a PSNR stays 1
FLOOR_VALUE = 0.5  # of the constant picture that no PSNR may be worse than
MIN_MEAN = 1e-8  # of a truth that is brightened for PSNR-H
MIN_ENERGY = 1e-6  # sum of squares of a channel or a depth map that is scaled
SSIM_RADIUS_PX = 1
NORMAL_EPS = 1e-6  # added to lengths of normals
DEPTH_UNIT = 1e3  # the tables' figure is the mean square times this
CHAMFER_SAMPLES = 30_000  # of the prediction; the truth's points are the vertices of its scan
CHAMFER_UNIT = 2e3  # the tables' figure is the mean of both mean squares times this

OFFICIAL, FOREGROUND, UNSCALED = "official", "foreground", "unscaled"
ROWS = (OFFICIAL, FOREGROUND, UNSCALED)

# Encoded pictures [N, H, W, 3] -> their mean distance, as `svim3d.losses.lpips.Lpips` gives it.
Distance = Callable[[Tensor, Tensor], Tensor]


@dataclass(frozen=True)
class PictureScore:
    """Figures of one picture.

    Attributes:
        rows: by row, then by figure: `psnr_hdr_db` (not of albedo), `psnr_ldr_db`, `ssim`, and
            `lpips` where there are weights for it.
        is_missing: there was no prediction, and white was scored.
    """

    rows: Mapping[str, Mapping[str, float]]
    is_missing: bool


def eroded(mask: Bool[Tensor, "H W 1"]) -> Bool[Tensor, "H W 1"]:
    """Without the pixels that have one off the object within 5 x 5; borders do not erode."""
    away = (~mask).float()[None, None, ..., 0]
    near = functional.max_pool2d(away, EROSION_PX, stride=1, padding=EROSION_PX // 2)
    return near[0, 0, ..., None] < 0.5


def compare_pictures(
    prediction: Float[Tensor, "H W 3"] | None,
    truth: Float[Tensor, "H W 3"],
    mask: Bool[Tensor, "H W 1"],
    *,
    scaled: bool,
    lpips: Distance | None = None,
) -> PictureScore:
    """Score a relit picture (`scaled`) or a novel view (not) by all rows.

    Args:
        prediction: radiance; None if the method gave none.
        truth: radiance.
        mask: of the object, before it is eroded.
        scaled: whether the official row fits a scale per channel.
        lpips: distance of encoded pictures; without it the figure is left out.

    Raises:
        ValueError: see `_prepared`.
    """
    inside = eroded(mask)
    image, target = _prepared(prediction, truth, inside)
    rows = {}
    for row, fit, share in _variants(inside, scaled=scaled):
        gain = _brightening(target)
        bright, wanted = _clipped(image * gain, target * gain, inside, PEAK_HDR, fit=fit)
        seen, shown = _clipped(image, target, inside, PEAK_LDR, fit=fit)
        seen, shown = srgb_from_linear(seen), srgb_from_linear(shown)
        figures = {"psnr_hdr_db": _floored_psnr(bright, wanted, inside, share)}
        figures |= _encoded_figures(seen, shown, inside, share)
        if lpips is not None and row != FOREGROUND:
            figures["lpips"] = _encoded_distance(seen, shown, lpips)
        rows[row] = figures
    return PictureScore(rows, prediction is None)


def compare_albedo(
    prediction: Float[Tensor, "H W 3"] | None,
    truth: Float[Tensor, "H W 3"],
    mask: Bool[Tensor, "H W 1"],
    *,
    lpips: Distance | None = None,
) -> PictureScore:
    """Score linear albedo by all rows; `psnr_ldr_db` and `ssim` are of linear values.

    Raises:
        ValueError: see `_prepared`.
    """
    inside = eroded(mask)
    image, target = _prepared(prediction, truth, inside)
    rows = {}
    for row, fit, share in _variants(inside, scaled=True):
        seen, shown = _clipped(image, target, inside, PEAK_LDR, fit=fit)
        rows[row] = _encoded_figures(seen, shown, inside, share)
        if lpips is not None and row != FOREGROUND:
            rows[row]["lpips"] = _encoded_distance(seen, shown, lpips)
    return PictureScore(rows, prediction is None)


def normal_error(
    prediction: Float[Tensor, "H W 3"] | None,
    truth: Float[Tensor, "H W 3"],
    mask: Bool[Tensor, "H W 1"],
) -> float:
    """Mean of 1 - cos over the eroded mask; both in one frame. What is missing counts 1."""
    inside = eroded(mask)[..., 0]
    if prediction is None:
        return 1.0
    a, b = (n[inside].double() for n in (prediction, truth))
    a, b = (n / (torch.linalg.vector_norm(n, dim=-1, keepdim=True) + NORMAL_EPS) for n in (a, b))
    return float((1.0 - (a * b).sum(-1)).mean())


def depth_error(
    predictions: Sequence[Float[Tensor, "H W 1"]],
    truths: Sequence[Float[Tensor, "H W 1"]],
    masks: Sequence[Bool[Tensor, "H W 1"]],
) -> float:
    """Mean square over all pixels and views after one scale for the whole capture, times 1e3.

    An empty prediction counts as a constant one. Views without a prediction are left out by the
    caller, as the script leaves them out.
    """
    pairs, dot, energy = [], 0.0, 0.0
    for prediction, truth, mask in zip(predictions, truths, masks, strict=True):
        inside = eroded(mask)
        depth, target = prediction.double() * inside, truth.double() * inside
        if float(depth.square().sum()) <= MIN_ENERGY:
            depth = inside.double()
        dot += float((depth * target).sum())
        energy += float(depth.square().sum())
        pairs.append((depth, target))
    squares = [float((dot / energy * depth - target).square().mean()) for depth, target in pairs]
    return DEPTH_UNIT * sum(squares) / len(squares)


def shape_error(
    mesh: tuple[Float[Tensor, "N 3"], Int[Tensor, "F 3"]] | None,
    scan_points: Float[Tensor, "P 3"],
    generator: torch.Generator,
) -> float:
    """Chamfer distance of 30k samples to the vertices of a scan, as the tables print it.

    Half the sum of both mean SQUARED distances, times 2e3; a missing mesh counts as a point in
    the origin. The script compares samples to points, so that a perfect mesh scores above zero.
    """
    if mesh is None:
        points = scan_points.new_zeros(1, 3)
    else:
        points = sample_surface(*mesh, CHAMFER_SAMPLES, generator)
    return CHAMFER_UNIT * squared_chamfer(points, scan_points)


def _prepared(
    prediction: Float[Tensor, "H W 3"] | None,
    truth: Float[Tensor, "H W 3"],
    inside: Bool[Tensor, "H W 1"],
) -> tuple[Float[Tensor, "H W 3"], Float[Tensor, "H W 3"]]:
    """Both pictures in double precision, black outside the mask; white for what is missing.

    Raises:
        ValueError: the eroded mask is empty, or the prediction is negative or not finite.
    """
    if not bool(inside.any()):
        raise ValueError("wanted a mask that 5 x 5 erosion leaves a pixel of, got none")
    image = torch.ones_like(truth) if prediction is None else prediction
    if not bool((image[inside[..., 0]] >= 0.0).all() & image[inside[..., 0]].isfinite().all()):
        raise ValueError("wanted finite linear values >= 0 inside the mask, got others")
    black = truth.new_zeros((), dtype=torch.float64)
    image, target = (torch.where(inside, x.double(), black) for x in (image, truth))
    return image, target.clamp_min(0.0)


def _variants(
    inside: Bool[Tensor, "H W 1"], *, scaled: bool
) -> tuple[tuple[str, bool, Bool[Tensor, "H W 1"]], ...]:
    """By row: its name, whether a scale is fitted, and the pixels that means run over."""
    everywhere = torch.ones_like(inside)
    return (
        (OFFICIAL, scaled, everywhere),
        (FOREGROUND, scaled, inside),
        (UNSCALED, False, everywhere),
    )


def _brightening(target: Float[Tensor, "H W 3"]) -> float:
    """The factor of PSNR-H."""
    clipped = saturate(target)
    mean = float(clipped.mean())
    return float(srgb_from_linear(clipped).mean()) / mean if mean > MIN_MEAN else 1.0


def _clipped(
    image: Float[Tensor, "H W 3"],
    target: Float[Tensor, "H W 3"],
    inside: Bool[Tensor, "H W 1"],
    peak: float,
    *,
    fit: bool,
) -> tuple[Float[Tensor, "H W 3"], Float[Tensor, "H W 3"]]:
    """Both pictures, the first one scaled if asked for, clipped to [0, peak]."""
    if fit:
        x, y = image[inside[..., 0]], target[inside[..., 0]]
        # A channel that is as good as black is fitted as if it were one; it stays black.
        x = torch.where(x.square().sum(0) <= MIN_ENERGY, 1.0, x)
        image = image * ((x * y).sum(0) / x.square().sum(0))
    return image.clamp(0.0, peak), target.clamp(0.0, peak)


def _floored_psnr(
    image: Float[Tensor, "H W 3"],
    target: Float[Tensor, "H W 3"],
    inside: Bool[Tensor, "H W 1"],
    share: Bool[Tensor, "H W 1"],
) -> float:
    """PSNR of peak 1 over the pixels of `share`, no worse than a constant picture's."""
    constant = FLOOR_VALUE * inside.to(target).expand_as(target)
    chosen = share[..., 0]
    squares = [float((x - target)[chosen].square().mean()) for x in (image, constant)]
    return float(-10.0 * torch.tensor(min(squares), dtype=torch.float64).log10())


def _encoded_figures(
    image: Float[Tensor, "H W 3"],
    target: Float[Tensor, "H W 3"],
    inside: Bool[Tensor, "H W 1"],
    share: Bool[Tensor, "H W 1"],
) -> dict[str, float]:
    """What needs no network of clipped pictures."""
    similar = structural_similarity(
        image[None], target[None], radius_px=SSIM_RADIUS_PX, border="reflect"
    )
    return {
        "psnr_ldr_db": _floored_psnr(image, target, inside, share),
        "ssim": float(similar[0][share].mean()),
    }


def _encoded_distance(
    image: Float[Tensor, "H W 3"], target: Float[Tensor, "H W 3"], lpips: Distance
) -> float:
    """LPIPS as the script calls it: the sRGB curve is applied to what it is given."""
    pair = (srgb_from_linear(x).float()[None] for x in (image, target))
    return float(lpips(*pair))
