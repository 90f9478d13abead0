"""Random objects: shapes put together as things are, each part of its own material."""

from dataclasses import dataclass, replace
from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

from svim3d.mesh.source_mesh import MIN_EXTENT
from svim3d.synthesis.bodies import Part
from svim3d.synthesis.dice import Dice
from svim3d.synthesis.materials import (
    Layer,
    SolidMaterial,
    random_material,
    with_decal,
)
from svim3d.synthesis.matter import Matter, random_colour
from svim3d.synthesis.recipes import RECIPES
from svim3d.synthesis.shapes import Assembly, assemble

Quality = Literal["good", "low"]
LOW_QUALITY_SHARE = 0.12  # of objects whose materials are not to be learnt from
DECAL_SHARE = 0.55  # of the other objects
THINNEST = 0.12  # shortest over longest side of an object below which it is drawn anew
EXPORTED = Matter((0.5, 0.5, 0.5), 0.5, 0.0)  # what files say whose author set nothing


@dataclass(frozen=True)
class SyntheticObject:
    """An invented thing, centred, its longest side 1.

    Attributes:
        name: the recipe.
        assembly: its surface.
        face_material: index into `materials` for each face.
        materials: functions of object-space position and normal.
        quality: "low" where the materials are not to be learnt from.
    """

    name: str
    assembly: Assembly
    face_material: Int[Tensor, "F"]
    materials: tuple[SolidMaterial, ...]
    quality: Quality

    def material_rows(
        self,
        position: Float[Tensor, "P 3"],
        normal: Float[Tensor, "P 3"],
        face: Int[Tensor, "P"],
    ) -> Float[Tensor, "P 5"]:
        """Linear basecolor, roughness, metallic at points of the surface, object frame."""
        material_of = self.face_material[face]
        rows = position.new_zeros(len(position), 5)
        for index, material in enumerate(self.materials):
            chosen = torch.nonzero(material_of == index)[:, 0]
            if len(chosen):
                rows[chosen] = material(position[chosen], normal[chosen])
        return rows


def random_object(dice: Dice) -> SyntheticObject:
    """An object of a random recipe with random materials."""
    while True:
        recipe = dice.choice([r for r, _ in RECIPES], [w for _, w in RECIPES])
        parts = recipe(dice)
        low, high = _bounds(parts)
        extent = high - low
        if float(extent.min()) >= THINNEST * float(extent.max()) > MIN_EXTENT:
            break
    parts = _centred(parts, low, high)
    count = max(part.material for part in parts) + 1
    is_low = dice.chance(LOW_QUALITY_SHARE)
    materials = low_quality_materials(dice, count) if is_low else good_materials(dice, count)
    assembly = assemble([part.shape for part in parts])
    of_part = torch.tensor([part.material for part in parts])
    return SyntheticObject(
        name=recipe.__name__,
        assembly=assembly,
        face_material=of_part[assembly.face_part],
        materials=materials,
        quality="low" if is_low else "good",
    )


def good_materials(dice: Dice, count: int) -> tuple[SolidMaterial, ...]:
    """A material for each kind of part, one of them often with a figure on one side."""
    materials = [random_material(dice) for _ in range(count)]
    if dice.chance(DECAL_SHARE):
        index = dice.integer(0, count - 1)
        materials[index] = with_decal(materials[index], dice)
    return tuple(materials)


def low_quality_materials(dice: Dice, count: int) -> tuple[SolidMaterial, ...]:
    """Materials as careless files have them: grey all over, one colour a part, or colour alone."""
    kind = dice.choice(("grey", "uniform", "colour only"))
    if kind == "grey":
        return (SolidMaterial(EXPORTED),) * count
    if kind == "uniform":
        return tuple(
            SolidMaterial(replace(EXPORTED, basecolor=random_colour(dice))) for _ in range(count)
        )
    return tuple(_colour_only(material) for material in good_materials(dice, count))


def _colour_only(material: SolidMaterial) -> SolidMaterial:
    """The same colours, but roughness and metallic of nothing in particular."""

    def flat(matter: Matter) -> Matter:
        return replace(EXPORTED, basecolor=matter.basecolor)

    layers = tuple(
        Layer(flat(layer.matter), layer.pattern, layer.opacity) for layer in material.layers
    )
    return SolidMaterial(flat(material.base), layers)


def _bounds(parts: list[Part]) -> tuple[Tensor, Tensor]:
    points = torch.cat([part.shape.vertices for part in parts])
    return points.amin(0), points.amax(0)


def _centred(parts: list[Part], low: Tensor, high: Tensor) -> list[Part]:
    """The parts moved so that their box is centred and its longest side is 1."""
    centre, extent = (low + high) / 2, float((high - low).max())
    return [
        replace(part, shape=replace(part.shape, vertices=(part.shape.vertices - centre) / extent))
        for part in parts
    ]
