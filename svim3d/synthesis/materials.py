"""Solid materials: what a point of an object is made of, as a function of where it lies.

A material is a base and layers over it. A layer changes colour, roughness and metallic together, as
matter does: rust on steel is brown, rough and no metal, a scratch in paint shows bright bare steel.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from svim3d.numerics import saturate
from svim3d.synthesis.dice import Dice
from svim3d.synthesis.matter import (
    EARTH,
    QUIET,
    RUST,
    WOODS,
    Matter,
    random_colour,
    random_dielectric,
    random_metal,
    shaded,
    srgb,
)
from svim3d.synthesis.patterns import (
    Bands,
    Checks,
    Decal,
    Dots,
    Half,
    Patches,
    Pattern,
    Rings,
    Settled,
    Veins,
    unit,
)

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Layer:
    """Stuff over other stuff.

    Attributes:
        matter: what it is made of.
        pattern: where it lies.
        opacity: how much of what lies below it hides.
    """

    matter: Matter
    pattern: Pattern
    opacity: float = 1.0


@dataclass(frozen=True)
class SolidMaterial:
    """A base and the layers over it, in order."""

    base: Matter
    layers: tuple[Layer, ...] = ()

    def __call__(
        self, position: Float[Tensor, "P 3"], normal: Float[Tensor, "P 3"]
    ) -> Float[Tensor, "P 5"]:
        """Linear basecolor, roughness and metallic at points of the surface, object frame."""
        values = _row(self.base, position).expand(len(position), 5)
        for layer in self.layers:
            cover = layer.opacity * layer.pattern(position, normal)
            values = torch.lerp(values, _row(layer.matter, position).expand_as(values), cover)
        return saturate(values)


def _row(matter: Matter, like: Tensor) -> Float[Tensor, "5"]:
    return like.new_tensor([*matter.basecolor, matter.roughness, matter.metallic])


def random_material(dice: Dice) -> SolidMaterial:
    """A material of a random family, with layers that belong to it."""
    makers = (
        (painted, 3.0),
        (metal, 2.5),
        (wooden, 1.5),
        (stone, 1.5),
        (patterned, 2.5),
        (ceramic, 1.2),
        (cloth, 1.0),
    )
    maker = dice.choice([maker for maker, _ in makers], [weight for _, weight in makers])
    material = maker(dice)
    if dice.chance(0.25):
        material = with_dirt(material, dice)
    return material


def painted(dice: Dice) -> SolidMaterial:
    """Paint or plastic, often two-tone, sometimes chipped down to metal."""
    paint = random_dielectric(dice)
    layers = [mottled(paint, dice)]
    if dice.chance(0.4):
        layers.append(Layer(random_dielectric(dice), half(dice)))
    if dice.chance(0.35):
        bare = random_metal(dice)
        chips = patches(dice, frequency=dice.uniform(4.0, 12.0), share=dice.uniform(0.1, 0.3))
        layers.append(Layer(bare, replace(chips, softness=0.04)))
    return SolidMaterial(paint, tuple(layers))


def metal(dice: Dice) -> SolidMaterial:
    """Metal: brushed, scratched, tarnished or rusted."""
    bare = random_metal(dice)
    layers = [
        Layer(
            replace(bare, roughness=min(1.0, bare.roughness + dice.uniform(0.1, 0.35))),
            patches(dice, frequency=dice.uniform(2.0, 8.0), share=0.5),
        )
    ]
    if dice.chance(0.4):
        layers.append(scratches(bare, dice))
    if dice.chance(0.4):
        rust = Matter(srgb(dice.choice(RUST)), dice.uniform(0.75, 0.95), 0.0)
        spread = patches(dice, frequency=dice.uniform(2.0, 7.0), share=dice.uniform(0.15, 0.5))
        layers.append(Layer(rust, spread, dice.uniform(0.7, 1.0)))
        bright = replace(rust, basecolor=shaded(rust.basecolor, 2.2))
        layers.append(Layer(bright, replace(spread, threshold=spread.threshold + 0.09), 0.6))
    elif dice.chance(0.4):
        layers.append(Layer(random_dielectric(dice), half(dice)))
    return SolidMaterial(bare, tuple(layers))


def wooden(dice: Dice) -> SolidMaterial:
    """Wood: year rings, fine grain along the log, sometimes varnished or painted in part."""
    wood, varnished = dice.choice(WOODS)
    colour = srgb(wood)
    gloss = dice.uniform(*((0.15, 0.35) if dice.chance(varnished) else (0.5, 0.8)))
    base = Matter(colour, gloss, 0.0)
    axis = random_axis(dice)
    dark = Matter(shaded(colour, dice.uniform(0.3, 0.6)), min(1.0, gloss + 0.1), 0.0)
    rings = Rings(axis, vector(dice, 0.4), dice.uniform(8.0, 18.0), dice.integer(0, 1 << 20))
    along = tuple(3.0 if abs(a) > 0.5 else 40.0 for a in axis)
    grain = Patches((along[0], along[1], along[2]), 2, 0.55, 0.3, dice.integer(0, 1 << 20))
    layers = [Layer(dark, rings, dice.uniform(0.5, 0.9)), Layer(dark, grain, 0.35)]
    if dice.chance(0.25):
        layers.append(Layer(random_dielectric(dice), half(dice)))
    return SolidMaterial(base, tuple(layers))


def stone(dice: Dice) -> SolidMaterial:
    """Raw stone and clay, or coloured stone that is mostly polished: mottled, veined, speckled."""
    is_raw = dice.chance(0.5)
    colour = srgb(dice.choice(EARTH)) if is_raw else random_colour(dice)
    is_polished = dice.chance(0.15 if is_raw else 0.75)
    base = Matter(colour, dice.uniform(*((0.1, 0.3) if is_polished else (0.6, 0.95))), 0.0)
    light, dark = shaded(colour, dice.uniform(1.3, 2.2)), shaded(colour, dice.uniform(0.25, 0.6))
    mottling = patches(dice, frequency=dice.uniform(3.0, 9.0), share=0.45)
    layers = [Layer(replace(base, basecolor=light), mottling)]
    if dice.chance(0.5):
        f = dice.uniform(2.0, 5.0)
        veins = Veins((f, f, f), 4, dice.uniform(0.03, 0.08), dice.integer(0, 1 << 20))
        layers.append(Layer(Matter(dark, base.roughness, 0.0), veins))
    if dice.chance(0.5):
        layers.append(Layer(Matter(dark, min(1.0, base.roughness + 0.1), 0.0), dots(dice)))
    return SolidMaterial(base, tuple(layers))


def patterned(dice: Dice) -> SolidMaterial:
    """Stripes, checks, dots or lines of a second stuff, which may be metal (inlay, foil)."""
    base = random_dielectric(dice)
    other = random_metal(dice) if dice.chance(0.25) else random_dielectric(dice)
    kind = dice.choice(("bands", "checks", "dots", "bands"))
    pattern: Pattern
    if kind == "bands":
        pattern = bands(dice)
    elif kind == "checks":
        line = dice.uniform(0.1, 0.25) if dice.chance(0.4) else None
        pattern = Checks(rotation_rows(dice), dice.uniform(4.0, 9.0), line)
    else:
        pattern = dots(dice)
    layers = [mottled(base, dice), Layer(other, pattern)]
    if dice.chance(0.3):
        layers.append(Layer(random_dielectric(dice), half(dice)))
    return SolidMaterial(base, tuple(layers))


def ceramic(dice: Dice) -> SolidMaterial:
    """Glaze that runs over rough clay, often with painted rings."""
    glaze = Matter(random_colour(dice), dice.uniform(0.06, 0.2), 0.0)
    clay = Matter(
        srgb(dice.choice(("#b5764c", "#8c5a3c", "#c8b090"))), dice.uniform(0.7, 0.95), 0.0
    )
    second = replace(glaze, basecolor=random_colour(dice))
    border = Half((0.0, -1.0, 0.0), dice.uniform(0.1, 0.4), 0.25, 0.03, dice.integer(0, 1 << 20))
    layers = [mottled(glaze, dice)]
    if dice.chance(0.6):
        layers.append(Layer(second, bands(dice)))
    return SolidMaterial(glaze, (*layers, Layer(clay, border)))


def cloth(dice: Dice) -> SolidMaterial:
    """Rough weave, mottled, often striped."""
    base = Matter(random_colour(dice, QUIET), dice.uniform(0.8, 1.0), 0.0)
    f = dice.uniform(20.0, 40.0)
    weave = Patches((f, f, f), 1, 0.5, 0.4, dice.integer(0, 1 << 20))
    layers = [Layer(replace(base, basecolor=shaded(base.basecolor, 0.7)), weave)]
    if dice.chance(0.5):
        layers.append(Layer(replace(base, basecolor=random_colour(dice, QUIET)), bands(dice), 0.9))
    return SolidMaterial(base, tuple(layers))


def with_dirt(material: SolidMaterial, dice: Dice) -> SolidMaterial:
    """Dust that settled from above, or grime in patches: rough and no metal."""
    dirt = Matter(srgb(dice.choice(EARTH)), dice.uniform(0.8, 1.0), 0.0)
    pattern: Pattern = patches(
        dice, frequency=dice.uniform(3.0, 8.0), share=dice.uniform(0.15, 0.4)
    )
    if dice.chance(0.5):
        pattern = Settled((0.0, 1.0, 0.0), dice.uniform(0.3, 0.7), dice.integer(0, 1 << 20))
    return replace(
        material, layers=(*material.layers, Layer(dirt, pattern, dice.uniform(0.5, 0.9)))
    )


def with_decal(material: SolidMaterial, dice: Dice) -> SolidMaterial:
    """A figure on one side, of paint or foil."""
    stuff = random_metal(dice) if dice.chance(0.15) else random_dielectric(dice)
    angle = dice.uniform(-3.1416, 3.1416)
    sideways = torch.tensor([angle]).sin().item(), torch.tensor([angle]).cos().item()
    decal = Decal(
        (sideways[0], 0.0, sideways[1]),
        (0.0, 1.0, 0.0),
        (dice.uniform(-0.15, 0.15), dice.uniform(-0.2, 0.2)),
        dice.uniform(0.1, 0.28),
        dice.choice(("disc", "ring", "square", "cross", "triangle", "star", "text", "text")),
    )
    return replace(material, layers=(*material.layers, Layer(stuff, decal)))


def mottled(matter: Matter, dice: Dice) -> Layer:
    """Slight unevenness of one stuff: colour and roughness move together."""
    uneven = Matter(
        shaded(matter.basecolor, dice.uniform(0.7, 1.25)),
        min(1.0, max(0.05, matter.roughness + dice.uniform(-0.15, 0.2))),
        matter.metallic,
    )
    return Layer(
        uneven, patches(dice, frequency=dice.uniform(2.0, 10.0), share=0.5), dice.uniform(0.1, 0.9)
    )


def scratches(bare: Matter, dice: Dice) -> Layer:
    """Fine lines along one direction, rougher and duller than the rest."""
    fine = [dice.uniform(25.0, 60.0)] * 3
    fine[dice.integer(0, 2)] = dice.uniform(1.0, 4.0)
    worn = Matter(shaded(bare.basecolor, 0.7), min(1.0, bare.roughness + 0.3), bare.metallic)
    return Layer(worn, Veins((fine[0], fine[1], fine[2]), 2, 0.06, dice.integer(0, 1 << 20)))


def patches(dice: Dice, *, frequency: float, share: float) -> Patches:
    """Patches over about `share` of the surface."""
    f = (frequency, frequency * dice.uniform(0.6, 1.4), frequency)
    # Noise of four octaves deviates by about 0.13 from its mean.
    threshold = 0.5 + 0.45 * (0.5 - share)
    return Patches(f, 4, threshold, dice.uniform(0.06, 0.3), dice.integer(0, 1 << 20))


def half(dice: Dice) -> Half:
    """A side of the object, mostly along an axis."""
    direction = random_axis(dice) if dice.chance(0.7) else as_vector(dice.direction())
    if dice.chance(0.5):
        direction = unit(*(-d for d in direction))
    fray = 0.0 if dice.chance(0.6) else dice.uniform(0.1, 0.4)
    return Half(direction, dice.uniform(-0.2, 0.2), fray, 0.02, dice.integer(0, 1 << 20))


def bands(dice: Dice) -> Bands:
    """Stripes, mostly along an axis."""
    return Bands(
        random_axis(dice) if dice.chance(0.7) else as_vector(dice.direction()),
        dice.logarithmic(1.5, 9.0),
        dice.uniform(0.0, 1.0),
        dice.uniform(0.2, 0.6),
        dice.choice((0.03, dice.uniform(0.1, 0.4))),
        0.0 if dice.chance(0.6) else dice.uniform(0.05, 0.3),
        dice.integer(0, 1 << 20),
    )


def dots(dice: Dice) -> Dots:
    """Dots or speckles."""
    return Dots(
        dice.logarithmic(3.0, 10.0),
        dice.uniform(0.25, 0.45),
        dice.uniform(0.0, 0.3),
        dice.integer(0, 1 << 20),
    )


def random_axis(dice: Dice) -> Vector:
    """One of the object's axes, most often the upright one."""
    return dice.choice(((0.0, 1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)), (2.0, 1.0, 1.0))


def rotation_rows(dice: Dice) -> tuple[Vector, Vector, Vector]:
    """Three perpendicular directions, mostly the object's own."""
    if dice.chance(0.6):
        return (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
    q, _ = torch.linalg.qr(torch.stack([dice.direction() for _ in range(3)]))
    a, b, c = (as_vector(row) for row in q)
    return a, b, c


def vector(dice: Dice, reach: float) -> Vector:
    """A point of the cube of half side `reach`."""
    return as_vector(dice.uniforms(-reach, reach, 3))


def as_vector(values: Float[Tensor, "3"]) -> Vector:
    """Plain numbers of a vector."""
    x, y, z = values.tolist()
    return x, y, z
