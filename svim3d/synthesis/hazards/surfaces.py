"""Hazards of materials and colour: metals, gloss, darkness, clipping, wrong transfer curves."""

from dataclasses import replace

import torch

from svim3d.color import linear_from_srgb, srgb_from_linear
from svim3d.mesh.source_mesh import SourceMaterial
from svim3d.synthesis.dice import Dice
from svim3d.synthesis.hazards.things import PLASTIC, STEEL, even, striped, toy
from svim3d.synthesis.hazards.trials import Darkroom, Hazard, Trial
from svim3d.synthesis.hazards.warps import DISAGREE
from svim3d.synthesis.view_defects import with_baked_light

GOLD = (1.0, 0.71, 0.29)  # linear F0
# Roughness of plastic, brushed steel, satin gold and chrome, and the share of what they mirror that
# a generator leaves in the basecolor.
FINISHES = ((PLASTIC, 0.0), (STEEL, 0.1), (0.15, 0.25), (0.04, 0.4))
CLIPS = (1e4, 1.0, 0.6, 0.3)  # radiance beyond which a camera sees white
DARKNESS = (1.0, 0.1, 0.03, 0.006)  # factors of the paint
GLOSSY = SourceMaterial(roughness_factor=0.2, metallic_factor=0.0)
METAL = SourceMaterial(roughness_factor=0.2, metallic_factor=1.0)


def mirrors(room: Darkroom, severity: float, seed: int, variant: str) -> Trial:
    """Ever smoother metals, with some of what they mirror left in their basecolor."""
    finish, baked = FINISHES[int(severity)]
    if isinstance(finish, float):
        finish = SourceMaterial(roughness_factor=finish, metallic_factor=1.0)
    colours = (striped(Dice.of(seed, 0)), striped(Dice.of(seed, 0)), even(GOLD), even((0.9,) * 3))
    trial = room.trial(toy(seed, colours[int(severity)], (finish,)), seed)
    if not baked:
        return trial
    lit = [
        with_baked_light(basecolor, radiance, mask, baked)
        for basecolor, radiance, mask in zip(
            trial.images["basecolor"], trial.images["radiance"], trial.images["mask"], strict=True
        )
    ]
    return replace(trial, images=trial.images | {"basecolor": torch.stack(lit)})


def gloss_or_metal(room: Darkroom, severity: float, seed: int, variant: str) -> Trial:
    """Views of which a share takes glossy plastic for metal, or metal for plastic."""
    material = METAL if variant == "metal" else GLOSSY
    trial = room.trial(toy(seed, materials=(material,)), seed)
    count = round(severity * len(trial.cameras))
    order = torch.randperm(len(trial.cameras), generator=Dice.of(seed, 2).generator)
    metallic = trial.images["metallic"].clone()
    mistaken = order[:count]
    metallic[mistaken] = (1.0 - metallic[mistaken]) * (trial.images["mask"][mistaken] > 0.0)
    return replace(trial, images=trial.images | {"metallic": metallic})


def darkness(room: Darkroom, severity: float, seed: int, variant: str) -> Trial:
    """Paint so dark that only its highlights say what it is."""
    paint = striped(Dice.of(seed, 0))
    factor = DARKNESS[int(severity)]
    return room.trial(toy(seed, lambda points: factor * paint(points)), seed)


def clipped(room: Darkroom, severity: float, seed: int, variant: str) -> Trial:
    """A camera that sees white where it is bright."""
    glossy = SourceMaterial(roughness_factor=0.25, metallic_factor=0.0)
    trial = room.trial(toy(seed, materials=(glossy,)), seed)
    limit = CLIPS[int(severity)] * trial.images["mask"]
    radiance = torch.minimum(trial.images["radiance"], limit)
    return replace(trial, images=trial.images | {"radiance": radiance})


def wrong_curve(room: Darkroom, severity: float, seed: int, variant: str) -> Trial:
    """Pictures whose transfer curve was forgotten, or applied twice, by so large a share."""
    trial = room.trial(toy(seed), seed)
    name, _, direction = variant.partition(" ")
    curve = srgb_from_linear if direction == "encoded" else linear_from_srgb
    mask = trial.images["mask"]
    image = trial.images[name]
    straight = image / mask.clamp_min(1e-3) if name == "radiance" else image
    wrong = straight + severity * (curve(straight.clamp(0.0, 1.0)) - straight)
    wrong = wrong * mask if name == "radiance" else wrong
    return replace(trial, images=trial.images | {name: wrong})


HAZARDS = (
    Hazard(
        "mirror",
        "brushed steel, satin gold and chrome, with their reflections in the basecolor",
        "finish",
        (0.0, 1.0, 2.0, 3.0),
        mirrors,
        notes=(DISAGREE, "mirror_like"),
    ),
    Hazard(
        "gloss-or-metal",
        "a share of the views takes plastic for metal, or metal for plastic",
        "share of views",
        (0.0, 0.2, 0.4, 0.6),
        gloss_or_metal,
        notes=(DISAGREE, "metal_in_doubt"),
        variants=("plastic", "metal"),
    ),
    Hazard(
        "dark",
        "paint of a tenth, a thirtieth and a hundred-and-sixtieth of the brightness",
        "step",
        (0.0, 1.0, 2.0, 3.0),
        darkness,
        notes=(DISAGREE, "dark_basecolor"),
    ),
    Hazard(
        "clipped",
        "highlights cut off at 1, 0.6 and 0.3 (0.8 is what a twentieth exceeds)",
        "step",
        (0.0, 1.0, 2.0, 3.0),
        clipped,
        notes=(DISAGREE, "clipped_highlights"),
    ),
    Hazard(
        "colour-space",
        "basecolor encoded that should be linear, or linearised twice; radiance encoded",
        "share of the curve",
        (0.0, 0.5, 1.0),
        wrong_curve,
        notes=(DISAGREE, "colour_space"),
        variants=("basecolor encoded", "basecolor linearised", "radiance encoded"),
    ),
)
