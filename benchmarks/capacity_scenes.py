"""Scenes of the capacity benchmark: orbits with a known truth, from the simplest to the hardest.

Procedural ones are rendered by `stages.invented_orbit`; orbits of the data folder are averaged down
to the size asked for.
"""

from collections.abc import Callable
from pathlib import Path

import torch

from benchmarks.inconsistent_orbit import corrupted_orbit
from stages.invented_orbit import SEED, invented_orbit
from stages.keys import digest_file
from svim3d.synthesis.dice import Dice
from svim3d.synthesis.inconsistency import Strengths
from svim3d.synthesis.materials import SolidMaterial, patterned
from svim3d.synthesis.matter import Matter
from svim3d.synthesis.objects import SyntheticObject
from svim3d.synthesis.shapes import Shape, assemble, superquadric

CLAY = Matter(basecolor=(0.45, 0.12, 0.08), roughness=0.5, metallic=0.0)


def _ball() -> Shape:
    """A sphere whose longest side is 1."""
    return superquadric(1.0, 1.0, 128).placed(scale=[0.5] * 3)


def _of(name: str, material: SolidMaterial, shape: Shape) -> SyntheticObject:
    """One body of one material."""
    assembly = assemble([shape])
    faces = torch.zeros(len(assembly.faces), dtype=torch.long)
    return SyntheticObject(name, assembly, faces, (material,), "good")


def _sphere() -> SyntheticObject:
    return _of("sphere", SolidMaterial(CLAY), _ball())


def _painted() -> SyntheticObject:
    return _of("patterned", patterned(Dice.of(SEED, 1000)), _ball())


SIMPLE: dict[str, Callable[[], SyntheticObject]] = {"sphere": _sphere, "patterned": _painted}


def scene_orbit(name: str, data: Path | None, parent: Path, size: int) -> tuple[Path, Path]:
    """The views of a scene, and the folder of its truth, made if they are not there.

    Args:
        name: one of `SIMPLE`, `random-K` for an invented object, or an orbit of the data folder.
        data: holds `orbits`.
        parent: where folders are kept.
        size: side of the views, pixels.
    """
    if name in SIMPLE or name.startswith("random-"):
        number = int(name.partition("-")[2] or 0)
        # Its name tells of the code that makes it, which for simple ones is this file.
        kept = parent / digest_file(Path(__file__))[:8] if name in SIMPLE else parent
        folder = invented_orbit(number, kept, size, name=name, thing=SIMPLE.get(name))
        return folder, folder
    if data is None:
        raise SystemExit(f"scene {name} is none of {', '.join(SIMPLE)}, random-K; give --data")
    truth = data / "orbits" / name
    views = corrupted_orbit(truth, parent, size=size, strengths=Strengths.at(0.0), seed=0)
    return views, truth
