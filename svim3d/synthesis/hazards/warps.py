"""Hazards of views that contradict each other, the pose they claim, or their own outline."""

from dataclasses import replace

import torch
from torch import Tensor

from svim3d.cameras import Cameras
from svim3d.synthesis.bodies import turned
from svim3d.synthesis.dice import Dice
from svim3d.synthesis.hazards.things import even, toy
from svim3d.synthesis.hazards.trials import Darkroom, Hazard, Images, Trial
from svim3d.synthesis.inconsistency import Strengths, make_inconsistent
from svim3d.synthesis.view_defects import spread_outward

DISAGREE = "views_disagree"
BENT = (DISAGREE, "views_bent", "warp_bound", "view_outvoted", "inconsistent_masks")
BEHIND_DEG = 100.0  # from here on a view counts as one of the back
STRANGER = 1000  # added to a seed: an object that nobody asked for


def misaligned(room: Darkroom, severity: float, seed: int, variant: str) -> Trial:
    """Each view displaced by a homography of its own, and the smooth warp that goes with it."""
    strengths = Strengths(homography_px=severity, smooth_warp_px=0.25 * severity)
    return _corrupted(room.trial(toy(seed), seed), strengths, seed)


def inconsistent(room: Darkroom, severity: float, seed: int, variant: str) -> Trial:
    """All faults of a poor generator at once."""
    return _corrupted(room.trial(toy(seed), seed), Strengths.at(severity), seed)


def uniform(room: Darkroom, severity: float, seed: int, variant: str) -> Trial:
    """Misaligned views of one colour: nothing but the outline tells where they belong."""
    strengths = Strengths(homography_px=severity)
    return _corrupted(room.trial(toy(seed, even()), seed), strengths, seed)


def back_side(room: Darkroom, severity: float, seed: int, variant: str) -> Trial:
    """Views of the back that each invent colours and relief of their own."""
    trial = room.trial(toy(seed), seed)
    images = {name: image.clone() for name, image in trial.images.items()}
    backward = trial.cameras.c2w[:, :3, 2]
    limit = torch.tensor(BEHIND_DEG).deg2rad().cos()
    behind = torch.nonzero(backward @ backward[trial.reference] < limit)[:, 0]
    for view in behind.tolist():
        stops = severity * Dice.of(seed, 10 + view).uniforms(-1.0, 1.0, 3)
        images["basecolor"][view] = (images["basecolor"][view] * stops.exp2()).clamp(0.0, 1.0)
        images["radiance"][view] = images["radiance"][view] * stops.exp2()
    dented = Strengths(normal_deg=min(20.0 * severity, 60.0), smooth_warp_px=2.0 * severity)
    wild = make_inconsistent(trial.cameras, images, trial.reference, dented, seed).images
    for name, image in wild.items():
        images[name][behind] = image[behind]
    return replace(trial, images=images)


def outlier(room: Darkroom, severity: float, seed: int, variant: str) -> Trial:
    """One view that is another's: taken 20 or 60 degrees off its pose, or of another object."""
    trial = room.trial(toy(seed), seed)
    if not severity:
        return trial
    view = len(trial.cameras) // 3
    shown = toy(seed + STRANGER) if severity > 2.0 else trial.truth.mesh
    turn = (0.0, 20.0, 60.0, 0.0)[int(severity)]
    camera = _turned(trial.cameras[view], turn)
    strange = room.pictures(shown, camera, room.studio())
    scale = float(trial.images["radiance"].mean() / strange["radiance"].mean())
    strange["radiance"] = strange["radiance"] * scale
    images = {name: image.clone() for name, image in trial.images.items()}
    for name, image in strange.items():
        images[name][view] = image[0]
    # Normals are those that the view's own pose would have seen.
    images["normal_world"][view] = images["normal_world"][view] @ turned(1, -turn).T
    return replace(trial, images=images)


def _turned(cameras: Cameras, azimuth_deg: float) -> Cameras:
    turn = torch.eye(4)
    turn[:3, :3] = turned(1, azimuth_deg)
    return replace(cameras, c2w=turn @ cameras.c2w)


def soft_masks(room: Darkroom, severity: float, seed: int, variant: str) -> Trial:
    """Outlines that fade over so many pixels, through a white background that shines in."""
    trial = room.trial(toy(seed), seed)
    if not severity:
        return trial
    blurred: dict[str, list[Tensor]] = {name: [] for name in trial.images}
    for view in range(len(trial.cameras)):
        for name, image in _softened(trial.images, view, severity).items():
            blurred[name].append(image)
    return replace(trial, images={name: torch.stack(views) for name, views in blurred.items()})


def _softened(images: Images, view: int, width_px: float) -> dict[str, Tensor]:
    mask = images["mask"][view]
    radius = 2 * round(width_px) + 1
    mean = torch.nn.functional.avg_pool2d(
        mask.permute(2, 0, 1)[None], radius, 1, radius // 2, count_include_pad=False
    )
    soft = mean[0].permute(1, 2, 0)
    straight = images["radiance"][view] / mask.clamp_min(1e-3)
    changed = {"mask": soft}
    for name, image in images.items():
        if name != "mask":
            source = straight if name == "radiance" else image[view]
            changed[name] = spread_outward(source, mask) * (soft > 0.0)
    # What was cut out of a white picture carries the white along where it is half covered.
    white = changed["radiance"] * mask.clamp_max(1.0) + (1.0 - mask)
    changed["radiance"] = white * soft
    changed["basecolor"] = changed["basecolor"] * mask + (1.0 - mask) * (soft > 0.0)
    return changed


def _corrupted(trial: Trial, strengths: Strengths, seed: int) -> Trial:
    views = make_inconsistent(trial.cameras, trial.images, trial.reference, strengths, seed)
    return replace(trial, images=views.images)


HAZARDS = (
    Hazard(
        "misaligned",
        "each view displaced by a homography of its own",
        "pixels of 256",
        (0.0, 2.0, 4.0, 8.0),
        misaligned,
        notes=BENT,
        is_perturbation=True,
    ),
    Hazard(
        "inconsistent",
        "all faults of a poor generator: warps, blur, drift, baked light, outlines, normals",
        "severity 0 to 5",
        (0.0, 1.0, 3.0, 5.0),
        inconsistent,
        notes=BENT,
        is_perturbation=True,
    ),
    Hazard(
        "uniform-colour",
        "misaligned views of one colour, where warps have nothing to hold on to",
        "pixels of 256",
        (0.0, 2.0, 4.0, 8.0),
        uniform,
        notes=BENT,
        is_perturbation=True,
    ),
    Hazard(
        "back-side",
        "views of the back that contradict each other",
        "stops of colour",
        (0.0, 0.5, 1.0, 2.0),
        back_side,
        notes=BENT,
        is_perturbation=True,
    ),
    Hazard(
        "outlier",
        "one view that is 20 or 60 degrees off its pose, or of another object",
        "kind",
        (0.0, 1.0, 2.0, 3.0),
        outlier,
        notes=BENT,
        is_perturbation=True,
    ),
    Hazard(
        "soft-mask",
        "outlines that fade through a white background",
        "pixels",
        (0.0, 1.0, 2.0, 4.0),
        soft_masks,
        notes=(DISAGREE, "soft_masks", "background_bleeds"),
        is_perturbation=True,
    ),
)
