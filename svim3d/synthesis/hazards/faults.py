"""Numeric faults: one value that no render should hold, in one kind of tensor a trial."""

import math
from dataclasses import replace

import torch
from torch import Tensor

from svim3d.cameras import Cameras
from svim3d.shading.environment import latlong_from_octahedral
from svim3d.synthesis.dice import Dice
from svim3d.synthesis.hazards.things import toy
from svim3d.synthesis.hazards.trials import Darkroom, Hazard, Trial

VALUES = {"nan": math.nan, "infinite": math.inf, "negative": -3.0, "huge": 6e4, "zero": 0.0}
IMAGES = ("radiance", "basecolor", "roughness", "metallic", "normal_world", "mask", "confidence")
# Zero is a fault of normals and poses alone; a negative number is none of them.
VARIANTS = (
    *(f"{name} {value}" for name in IMAGES for value in ("nan", "infinite", "negative", "huge")),
    "normal_world zero",
    *(f"camera {value}" for value in ("nan", "infinite", "huge", "zero")),
    *(f"light {value}" for value in ("nan", "infinite", "negative", "huge")),
)
PARTS = (0.0, 0.008, 0.5)  # of a view's pixels; the smaller share can be mended
LIGHT_ROWS = 32


def numeric(room: Darkroom, severity: float, seed: int, variant: str) -> Trial:
    """One kind of bad value in one kind of tensor, in a few pixels of a view or half of two."""
    name, _, value = variant.partition(" ")
    trial = room.trial(toy(seed), seed)
    share, dice = PARTS[int(severity)], Dice.of(seed, 3)
    if name == "light":
        light = latlong_from_octahedral(room.studio(), height=LIGHT_ROWS)
        return replace(trial, light=_spoilt(light[None], [0], share, VALUES[value], dice)[0])
    images = dict(trial.images)
    if name == "confidence":
        images[name] = torch.ones_like(images["mask"])
    if not severity:
        return replace(trial, images=images)
    views = list(range(int(severity)))
    if name == "camera":
        return replace(trial, cameras=_spoilt_poses(trial.cameras, views, VALUES[value]))
    images[name] = _spoilt(images[name], views, share, VALUES[value], dice)
    return replace(trial, images=images)


def _spoilt(images: Tensor, views: list[int], share: float, value: float, dice: Dice) -> Tensor:
    """Images with a value in a share of the pixels of some views, one at least."""
    changed = images.clone()
    pixels = images.shape[1] * images.shape[2]
    count = max(1, round(share * pixels)) if share else 0
    for view in views:
        chosen = torch.randperm(pixels, generator=dice.generator)[:count]
        changed[view].view(pixels, -1)[chosen] = value
    return changed


def _spoilt_poses(cameras: Cameras, views: list[int], value: float) -> Cameras:
    """Poses of which one entry of the rotation holds a value."""
    c2w = cameras.c2w.clone()
    c2w[views, 0, 0] = value
    return replace(cameras, c2w=c2w)


HAZARDS = (
    Hazard(
        "numeric",
        "NaN, infinite, negative and huge values, one kind in one kind of tensor",
        "step",
        (0.0, 1.0, 2.0),
        numeric,
        notes=(
            "non_finite_pixels",
            "clamped",
            "normals_rescaled",
            "light_mended",
            "glaring_pixels",
            "clipped_highlights",
            "views_disagree",
        ),
        variants=VARIANTS,
    ),
)
