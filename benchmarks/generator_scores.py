"""How near generated views are to true ones, per view; and whether they turn with the camera."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from benchmarks.generator_views import COVERED, Views
from svim3d.metrics import structural_similarity
from svim3d.numerics import dot, normalize

# Equal pictures would give infinity, which no mean survives; 8 bits alone give 59 dB.
HIGHEST_PSNR_DB = 60.0
EMPTY_ANGLE_DEG = 90.0  # of a pixel of the object that a method left empty


@dataclass(frozen=True)
class Figure:
    """A column of the table."""

    title: str
    digits: int
    is_better_high: bool = True
    is_material: bool = False
    is_square: bool = False  # of which the root is taken after all means


FIGURES = {
    "rgb_psnr": Figure("RGB dB", 2),
    "rgb_ssim": Figure("RGB SSIM", 3),
    "rgb_psnr_object": Figure("RGB dB, object", 2),
    "rgb_ssim_object": Figure("RGB SSIM, object", 3),
    "basecolor_psnr": Figure("basecolor dB", 2, is_material=True),
    "basecolor_ssim": Figure("basecolor SSIM", 3, is_material=True),
    "basecolor_psnr_object": Figure("basecolor dB, object", 2, is_material=True),
    "basecolor_ssim_object": Figure("basecolor SSIM, object", 3, is_material=True),
    "roughness_rmse": Figure("roughness RMSE", 3, is_better_high=False, is_material=True),
    "metallic_rmse": Figure("metallic RMSE", 3, is_better_high=False, is_material=True),
    "roughness_pooled": Figure("roughness RMSE, pooled", 3, False, True, True),
    "metallic_pooled": Figure("metallic RMSE, pooled", 3, False, True, True),
    "normal_deg": Figure("normal deg", 1, is_better_high=False),
    "normal_deg_both": Figure("normal deg, both", 1, is_better_high=False),
    "mask_iou": Figure("mask IoU", 3),
}


def score_views(found: Views, truth: Views, empty: dict[str, float]) -> dict[str, Tensor]:
    """All figures of each view, [K].

    Colours: over white, of the whole picture and on the union of both masks. Roughness, metallic
    and normals: on the true mask. `normal_deg_both`: where both masks are.

    Args:
        found: of the method.
        truth: of the same cameras.
        empty: what counts as the roughness and metallic of a pixel of the object that the method
            left empty: the training set's mean. Its normal counts as 90 degrees off.
    """
    here, there = found.mask > COVERED, truth.mask > COVERED
    union, both = here | there, here & there
    scores = {}
    for name in ("rgb", "basecolor"):
        a, b = getattr(found, name), getattr(truth, name)
        squared = (a - b).square().mean(-1, keepdim=True)
        similar = structural_similarity(a, b)
        scores[f"{name}_psnr"] = decibels(squared.mean((1, 2, 3)))
        scores[f"{name}_ssim"] = similar.mean((1, 2, 3))
        scores[f"{name}_psnr_object"] = decibels(masked_mean(squared, union))
        scores[f"{name}_ssim_object"] = masked_mean(similar, union)
    for name in ("roughness", "metallic"):
        told = torch.where(here, getattr(found, name), torch.tensor(empty[name]))
        squared = (told - getattr(truth, name)).square()
        scores[f"{name}_pooled"] = masked_mean(squared, there)
        scores[f"{name}_rmse"] = scores[f"{name}_pooled"].sqrt()
    angle = angle_deg(found.normal, truth.normal)
    scores["normal_deg"] = masked_mean(angle.where(here, torch.tensor(EMPTY_ANGLE_DEG)), there)
    scores["normal_deg_both"] = masked_mean(angle, both)
    scores["mask_iou"] = both.sum((1, 2, 3)) / union.sum((1, 2, 3)).clamp(min=1)
    return scores


def masked_mean(values: Tensor, mask: Tensor) -> Tensor:
    """Mean of each view inside a mask; NaN where the mask is empty."""
    weight = mask.to(values)
    return (values * weight).sum((1, 2, 3)) / weight.sum((1, 2, 3))


def decibels(mean_squared: Tensor) -> Tensor:
    """PSNR of peak 1, capped."""
    return (-10.0 * mean_squared.log10()).clamp(max=HIGHEST_PSNR_DB)


def angle_deg(a: Tensor, b: Tensor) -> Tensor:
    """Angle at each pixel; a zero vector counts as a right angle."""
    a, b = normalize(a), normalize(b)
    sine = torch.linalg.vector_norm(torch.linalg.cross(a, b), dim=-1, keepdim=True)
    blank = (dot(a, a) < 0.5) | (dot(b, b) < 0.5)
    return torch.rad2deg(torch.atan2(sine, dot(a, b))).where(~blank, torch.tensor(EMPTY_ANGLE_DEG))


@dataclass(frozen=True)
class Turning:
    """Whether generated views are most like the true views of their own azimuths.

    Attributes:
        rank_1: share of views whose nearest true view is their own; ties share.
        mean_rank: of the own view, 1 is best; ties take their middle.
        error_deg: mean angle between the azimuth of the nearest true view and the own.
        chance_rank_1: of views that do not turn.
        chance_rank: likewise.
        asymmetry: RMS difference of true views from the most similar one that is no neighbour.
    """

    rank_1: float
    mean_rank: float
    error_deg: float
    chance_rank_1: float
    chance_rank: float
    asymmetry: float


def turning(found: Views, truth: Views, azimuth_deg: Tensor) -> Turning:
    """Retrieve the azimuth of each generated view among the true views, the reference left out.

    Distances are mean squares over encoded normals and, over white, basecolor.
    """
    generated, true = _descriptors(found), _descriptors(truth)
    distance = _distances(generated, true)
    views = len(distance)
    own = distance.diagonal()[:, None]
    before, ties = (distance < own).sum(1), (distance == own).sum(1)
    azimuth = azimuth_deg[:-1].double()
    nearest = azimuth[distance.argmin(1)]
    error = ((nearest - azimuth + 180.0).remainder(360.0) - 180.0).abs()
    return Turning(
        rank_1=float(((before == 0) / ties).mean()),
        mean_rank=float((before + (ties + 1.0) / 2.0).mean()),
        error_deg=float(error.mean()),
        chance_rank_1=1.0 / views,
        chance_rank=(views + 1) / 2.0,
        asymmetry=_asymmetry(true),
    )


def _descriptors(views: Views) -> Tensor:
    """What views are told apart by, [K - 1, numbers]."""
    pictures = views.pictures()
    both = torch.cat([pictures["basecolor"], pictures["normal"]], -1)
    return both[:-1].flatten(1)


def _distances(generated: Tensor, true: Tensor) -> Tensor:
    """Mean squares of all pairs. No expanded squares: equal pairs must give equal bits."""
    return torch.stack([(view - true).square().mean(1) for view in generated])


def _asymmetry(true: Tensor) -> float:
    """RMS difference of a true view from its most similar one two or more places away."""
    distance = _distances(true, true)
    place = torch.arange(len(true))
    apart = (place[:, None] - place[None]).abs()
    near = torch.minimum(apart, len(true) - apart) < 2
    return math.sqrt(float(distance.masked_fill(near, torch.inf).min(1).values.mean()))
