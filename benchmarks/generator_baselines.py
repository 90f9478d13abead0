"""What the generator must beat: the reference repeated, a mean image, a textured ellipsoid.

Each is made as strong as is fair. All get what a user has (the reference picture, its mask, the
cameras) and what a training set tells: mean images, constants, and a choice among variants, taken
where a variant did best on training objects.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from benchmarks.generator_scores import EMPTY_ANGLE_DEG, angle_deg, decibels, masked_mean
from benchmarks.generator_views import COVERED, Case, Views, over_white
from benchmarks.generator_warp import Warp, fit_ellipsoid, inflated_normals, warp_views
from svim3d.diffusion.groups import without_background
from svim3d.numerics import normalize

BINS = 21  # azimuths of the mean images
CHOICE_OBJECTS = 16  # training objects on which variants compete
SCALES = (1.0, 1.1, 1.2)  # of the ellipsoid: corners of boxes stick out of what fits their mask
LEVELS = 101  # of the constants that are tried


@dataclass(frozen=True)
class Tone:
    """The affine map of reference colours to basecolor that fits training references best."""

    gain: float
    offset: float

    def __call__(self, rgb: Tensor) -> Tensor:
        """Both straight and encoded for display."""
        return (self.gain * rgb + self.offset).clamp(0.0, 1.0)


@dataclass(frozen=True)
class Training:
    """What baselines know of a training set.

    Attributes:
        mean: images of `BINS` azimuths, the first at 0.
        mean_value: roughness and metallic of the mean covered pixel.
        constant: roughness and metallic with the smallest mean error over views, where one value
            has to do: for metallic, mostly 0 or 1, that is not the mean.
        tone: from reference colours to basecolor.
        warp: the variant of the ellipsoid whose colours did best.
        shape: the variant whose normals did best; it gives the mask too.
        repeats_mean_normals: whether the repeated view's normals are the mean image's rather than
            those of the inflated mask.
        objects: how many were seen.
    """

    mean: Views
    mean_value: dict[str, float]
    constant: dict[str, float]
    tone: Tone
    warp: Warp
    shape: Warp
    repeats_mean_normals: bool
    objects: int


@dataclass
class _Sums:
    """Running sums over training views."""

    count: Tensor
    planes: dict[str, Tensor]
    spreads: dict[str, list[Tensor]]
    tone: Tensor


def learn(cases: Iterable[Case], size: int) -> Training:
    """One pass over training objects."""
    sums = _Sums(
        count=torch.zeros(BINS, 1, 1, 1),
        planes={
            name: torch.zeros(BINS, size, size, channels)
            for name, channels in (("rgb", 3), ("basecolor", 3), ("normal", 3), ("mask", 1))
        }
        | {name: torch.zeros(BINS, size, size, 1) for name in ("roughness", "metallic", "known")},
        spreads={"roughness": [], "metallic": []},
        tone=torch.zeros(5, dtype=torch.float64),
    )
    kept: list[Case] = []
    objects = 0
    for case in cases:
        _add(sums, case)
        objects += 1
        if len(kept) < CHOICE_OBJECTS:
            kept.append(case)
    return _choose(_without_choices(sums, objects), kept)


def azimuth_bin(azimuth_deg: Tensor) -> Tensor:
    """Nearest of `BINS` azimuths."""
    return (azimuth_deg * BINS / 360.0).round().long().remainder(BINS)


def _add(sums: _Sums, case: Case) -> None:
    assert case.truth is not None
    truth, place = case.truth, azimuth_bin(case.azimuth_deg)
    known = truth.mask * float(case.has_materials)
    covered = {
        "rgb": truth.rgb,
        "normal": truth.normal * truth.mask,
        "mask": truth.mask,
        "basecolor": truth.basecolor,
        "known": known,
        "roughness": truth.roughness * known,
        "metallic": truth.metallic * known,
    }
    sums.count.index_add_(0, place, torch.ones(len(place), 1, 1, 1))
    for name, plane in covered.items():
        sums.planes[name].index_add_(0, place, plane)
    if not case.has_materials:
        return
    there = truth.mask > COVERED
    for name, spreads in sums.spreads.items():
        for value, mask in zip(getattr(truth, name)[:-1], there[:-1], strict=True):
            inside = value[mask]
            spreads.append(torch.stack([inside.mean(), inside.var(correction=0)]))
    x = without_background(case.picture, case.mask, 1.0)[case.mask[..., 0] > COVERED].double()
    y = without_background(truth.basecolor[-1], truth.mask[-1], 1.0)
    y = y[case.mask[..., 0] > COVERED].double()
    sums.tone += torch.stack(
        [torch.tensor(float(x.numel())).double(), x.sum(), y.sum(), (x * x).sum(), (x * y).sum()]
    )


def _without_choices(sums: _Sums, objects: int) -> Training:
    """Means and constants; the free choices still at their first variants."""
    count = sums.count.clamp(min=1.0)
    known = sums.planes["known"]
    value = {
        name: float(sums.planes[name].sum() / known.sum().clamp(min=1.0)) for name in sums.spreads
    }
    mask = ((sums.planes["mask"] / count) > COVERED).float()
    # Where training shows nothing at all, the mean value stands for the mean image.
    images = {
        name: torch.where(known > 0.0, sums.planes[name] / known.clamp(min=1e-6), value[name])
        for name in value
    }
    mean = Views(
        rgb=sums.planes["rgb"] / count,
        basecolor=sums.planes["basecolor"] / count,
        normal=normalize(sums.planes["normal"]) * mask,
        mask=mask,
        **images,
    )
    return Training(
        mean=mean,
        mean_value=value,
        constant={name: best_constant(torch.stack(s)) for name, s in sums.spreads.items()},
        tone=_fit_tone(sums.tone),
        warp=Warp(SCALES[0], carves=False),
        shape=Warp(SCALES[0], carves=False),
        repeats_mean_normals=False,
        objects=objects,
    )


def best_constant(spreads: Tensor) -> float:
    """The value whose RMS error, averaged over views, is smallest.

    Args:
        spreads: mean and variance of each view, [N, 2].
    """
    tried = torch.linspace(0.0, 1.0, LEVELS)
    error = ((spreads[:, :1] - tried).square() + spreads[:, 1:]).sqrt().mean(0)
    return float(tried[error.argmin()])


def _fit_tone(sums: Tensor) -> Tone:
    """Least squares of y = gain x + offset from n, sum x, sum y, sum x^2 and sum xy."""
    n, x, y, xx, xy = sums.tolist()
    spread = n * xx - x * x
    if spread <= 0.0:
        return Tone(1.0, 0.0)
    gain = (n * xy - x * y) / spread
    return Tone(gain, (y - gain * x) / n)


def _choose(training: Training, cases: list[Case]) -> Training:
    """Take the variants that do best on training objects."""

    def mean_of(score: Callable[[Views, Views], Tensor], found: list[Views]) -> float:
        pairs = zip(found, cases, strict=True)
        return float(torch.stack([score(v, c.truth)[:-1].mean() for v, c in pairs]).mean())

    def rgb_psnr(found: Views, truth: Views) -> Tensor:
        return decibels((found.rgb - truth.rgb).square().mean((1, 2, 3)))

    def normal_deg(found: Views, truth: Views) -> Tensor:
        there = truth.mask > COVERED
        angle = angle_deg(found.normal, truth.normal).where(
            found.mask > COVERED, torch.tensor(EMPTY_ANGLE_DEG)
        )
        return masked_mean(angle, there)

    variants = [Warp(scale, carves) for scale in SCALES for carves in (False, True)]
    colours, shapes = {}, {}
    for warp in variants:
        tried = replace(training, warp=warp, shape=warp)
        found = [warped(case, tried) for case in cases]
        colours[warp] = mean_of(rgb_psnr, found)
        shapes[warp] = mean_of(normal_deg, found)
    training = replace(
        training,
        warp=max(colours, key=lambda w: colours[w]),
        shape=min(shapes, key=lambda w: shapes[w]),
    )
    angle = {}
    for choice in (False, True):
        tried = replace(training, repeats_mean_normals=choice)
        angle[choice] = mean_of(normal_deg, [repeated(case, tried) for case in cases])
    return replace(training, repeats_mean_normals=angle[True] < angle[False])


def repeated(case: Case, training: Training) -> Views:
    """The reference view at every azimuth; normals of its inflated mask or of the mean image."""
    frames = len(case.azimuth_deg)
    mask = case.mask.expand(frames, -1, -1, -1)
    seen = (mask > 0.0).to(mask)
    if training.repeats_mean_normals:
        # Directions outside the thresholded mean mask are taken from a frontal normal.
        normal = training.mean.normal[azimuth_bin(case.azimuth_deg)]
        blank = (normal.square().sum(-1, keepdim=True) < 0.5).to(normal)
        normal = normal + blank * torch.tensor([0.0, 0.0, 1.0])
    else:
        normal = inflated_normals(case.mask).expand(frames, -1, -1, -1)
    straight = training.tone(without_background(case.picture, case.mask, 1.0))
    return Views(
        rgb=case.picture.expand(frames, -1, -1, -1),
        basecolor=over_white(straight, case.mask).expand(frames, -1, -1, -1),
        normal=normal * seen,
        mask=mask,
        **_constants(mask, training.constant),
    )


def mean_image(case: Case, training: Training) -> Views:
    """The training set's mean view of each azimuth."""
    place = azimuth_bin(case.azimuth_deg)
    mean = training.mean
    return Views(**{name: getattr(mean, name)[place] for name in Views.__dataclass_fields__})


def warped(case: Case, training: Training) -> Views:
    """The reference view on an ellipsoid that fits its mask; the unseen half is mirrored."""
    body = fit_ellipsoid(case.mask, float(case.elevation_deg[-1]), case.fov_deg)
    straight = without_background(case.picture, case.mask, 1.0)
    colours = torch.cat([straight, training.tone(straight)], -1)
    shown, shape = (
        warp_views(case, body.scaled(warp.scale), colours, carves=warp.carves)
        for warp in (training.warp, training.shape)
    )
    rgb, basecolor = shown.colours.split(3, -1)
    return Views(
        rgb=over_white(rgb, shown.mask),
        basecolor=over_white(basecolor, shown.mask),
        normal=shape.normal,
        mask=shape.mask,
        **_constants(shape.mask, training.constant),
    )


def repeated_truth(case: Case) -> Views:
    """An oracle: the true materials of the reference view at every azimuth."""
    assert case.truth is not None
    frames = len(case.azimuth_deg)
    planes = {
        name: getattr(case.truth, name)[-1:].expand(frames, -1, -1, -1)
        for name in Views.__dataclass_fields__
    }
    return Views(**planes | {"rgb": case.picture.expand(frames, -1, -1, -1)})


def _constants(mask: Tensor, constant: dict[str, float]) -> dict[str, Tensor]:
    return {name: torch.full_like(mask, value) for name, value in constant.items()}
