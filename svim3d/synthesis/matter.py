"""Stuff: the colour, roughness and metallic that go together in the world.

Roughness is not drawn by itself. Little is seen of it at 64 pixels, so that a network learns it
from what stuff of that look mostly is, and rendered objects have to be like the world in this.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import torch

from svim3d.color import linear_from_srgb
from svim3d.numerics import saturate
from svim3d.synthesis.dice import Dice

Colour = tuple[float, float, float]


@dataclass(frozen=True)
class Matter:
    """One kind of stuff.

    Attributes:
        basecolor: linear.
        roughness: perceptual.
        metallic: in [0, 1].
    """

    basecolor: Colour
    roughness: float
    metallic: float


# Linear reflectance of polished metals at normal incidence, mean over the three bands; and how
# often one is met polished: gold, silver and chromium are there for their shine, iron is cast.
METALS: tuple[tuple[Colour, float], ...] = (
    ((0.56, 0.57, 0.58), 0.15),  # iron
    ((0.91, 0.92, 0.92), 0.3),  # aluminium
    ((0.55, 0.56, 0.55), 0.9),  # chromium
    ((0.96, 0.64, 0.54), 0.6),  # copper
    ((1.00, 0.78, 0.34), 0.85),  # gold
    ((0.89, 0.76, 0.44), 0.7),  # brass
    ((0.97, 0.96, 0.91), 0.85),  # silver
    ((0.30, 0.31, 0.33), 0.15),  # gunmetal
)
ANODISED_SHARE = 0.1  # of metals, tinted in any hue
# Colours of wood, and how often one is varnished, which darkens it.
WOODS = (("#8a5a34", 0.5), ("#b5834f", 0.2), ("#5b3a22", 0.8), ("#c9a06c", 0.1), ("#a0522d", 0.7))
RUST = ("#6e3318", "#8b4a20", "#4c2412")
EARTH = ("#6b5a48", "#8f7a61", "#4a4038", "#a69884", "#3b342e")


def srgb(text: str) -> Colour:
    """Linear colour of #rrggbb."""
    r, g, b = linear_from_srgb(
        torch.tensor([int(text[i : i + 2], 16) / 255.0 for i in (1, 3, 5)])
    ).tolist()
    return r, g, b


def from_hue(hue: float, saturation: float, value: float) -> Colour:
    """Linear colour of sRGB-encoded hue (turns), saturation and value."""
    wheel = (torch.tensor([0.0, 2.0, 1.0]) / 3.0 + hue + 1.0) % 1.0 * 6.0
    encoded = value * (1.0 - saturation * (1.0 - saturate((wheel - 3.0).abs() - 1.0)))
    r, g, b = linear_from_srgb(encoded).tolist()
    return r, g, b


def shaded(colour: Colour, factor: float) -> Colour:
    """A darker or lighter kind of a colour; linear, never above 0.95."""
    r, g, b = (min(0.95, channel * factor) for channel in colour)
    return r, g, b


# Weights of the kinds of colour of paint, plastic, rubber and the like.
KINDS = {"bright": 4.0, "muted": 3.0, "pastel": 1.5, "white": 1.5, "grey": 1.0, "black": 1.3}
# Cloth and raw clay are seldom bright.
QUIET = {"bright": 1.0, "muted": 4.0, "pastel": 2.0, "white": 1.0, "grey": 1.0, "black": 1.0}
# How rough a finish is, and how often a colour has it. Gloss keeps a colour deep; a dull surface
# sends white light over it, so that bright stuff is mostly glossy (toys, enamel, lacquer), muted
# and grey stuff dull (clay, concrete, primer), white both (porcelain, plaster), black often rubber.
FINISHES = {"gloss": (0.08, 0.3), "satin": (0.3, 0.55), "dull": (0.55, 0.95)}
FINISH_OF = {
    "bright": (3.0, 1.0, 0.4),
    "muted": (0.4, 1.0, 3.0),
    "pastel": (0.4, 1.5, 1.5),
    "white": (2.0, 1.0, 0.8),
    "grey": (0.4, 1.0, 2.5),
    "black": (0.6, 0.8, 2.0),
}


def random_kind(dice: Dice, weights: Mapping[str, float] = KINDS) -> str:
    """Kind of a colour: bright, muted, pastel, white, grey or black."""
    return dice.choice(tuple(weights), tuple(weights.values()))


def colour_of(kind: str, dice: Dice) -> Colour:
    """A colour of a kind; linear."""
    hue = dice.uniform(0.0, 1.0)
    if kind == "bright":
        return from_hue(hue, dice.uniform(0.7, 1.0), dice.uniform(0.55, 0.95))
    if kind == "muted":
        return from_hue(hue, dice.uniform(0.3, 0.6), dice.uniform(0.3, 0.75))
    if kind == "pastel":
        return from_hue(hue, dice.uniform(0.12, 0.35), dice.uniform(0.8, 0.95))
    value = {"white": (0.85, 0.95), "grey": (0.35, 0.7), "black": (0.08, 0.2)}[kind]
    return from_hue(hue, dice.uniform(0.0, 0.08), dice.uniform(*value))


def random_colour(dice: Dice, weights: Mapping[str, float] = KINDS) -> Colour:
    """Colour of paint, plastic, glaze or cloth; linear."""
    return colour_of(random_kind(dice, weights), dice)


def random_dielectric(dice: Dice) -> Matter:
    """Plastic, paint, ceramic, rubber, stone: no metal, its finish as its colour has it mostly."""
    kind = random_kind(dice)
    finish = dice.choice(tuple(FINISHES), FINISH_OF[kind])
    return Matter(colour_of(kind, dice), dice.uniform(*FINISHES[finish]), 0.0)


def random_metal(dice: Dice) -> Matter:
    """Bare metal, polished, brushed or cast as that metal mostly is; seldom anodised."""
    colour, polished = dice.choice(METALS)
    if dice.chance(ANODISED_SHARE):
        colour = from_hue(dice.uniform(0.0, 1.0), dice.uniform(0.4, 0.8), dice.uniform(0.6, 0.95))
    roughness = dice.uniform(*((0.08, 0.3) if dice.chance(polished) else (0.3, 0.6)))
    return Matter(shaded(colour, dice.uniform(0.75, 1.0)), roughness, 1.0)
