"""All hazards by name."""

from svim3d.synthesis.hazards import faults, forms, surfaces, torture, warps
from svim3d.synthesis.hazards.things import toy
from svim3d.synthesis.hazards.trials import Darkroom, Hazard, Trial


def plain_toy(room: Darkroom, severity: float, seed: int, variant: str) -> Trial:
    """The toy, harmless."""
    return room.trial(toy(seed), seed)


ON_THEIR_OWN = (
    Hazard(
        "uv-torture",
        "noisy, sliver, non-manifold and zero-area meshes, for cleanup and atlas",
        "faces: 200, 2,000, 20,000, 100,000",
        (0.0, 1.0, 2.0, 3.0),
        plain_toy,
        variants=torture.KINDS,
        measured="atlas",
    ),
    Hazard(
        "repeatability",
        "the same run twice gives equal bytes; another seed moves the surface by so much",
        "none",
        (0.0,),
        plain_toy,
        measured="repeat",
    ),
)

HAZARDS: dict[str, Hazard] = {
    hazard.name: hazard
    for hazard in (
        *warps.HAZARDS,
        *surfaces.HAZARDS,
        *forms.HAZARDS,
        *faults.HAZARDS,
        *ON_THEIR_OWN,
    )
}
