"""Hazards of shape and of where the cameras stand."""

from svim3d.synthesis.hazards.things import ball_on_rods, pierced, slab, toy
from svim3d.synthesis.hazards.trials import FILL, Darkroom, Hazard, Trial
from svim3d.synthesis.hazards.warps import DISAGREE

ROD_WIDTHS_PX = (8.0, 4.0, 2.0, 1.0)
SLAB_HEIGHTS = (0.8, 0.2, 0.08, 0.03)
OPENINGS = (0.7, 0.45, 0.25, 0.12)  # widths of holes in bodies of about 2
# What can be seen of each: one handle, one hole, two holes, the outside of a hidden cavity.
EULER = {"ring": 0, "mug": 0, "eight": -2, "shell": 2}
VIEW_COUNTS = (12, 6, 4, 3)
FILLS = (FILL, 1.15, 1.4, 1.8)  # of the height, by the bounding sphere: the toy is slimmer


def rods(room: Darkroom, severity: float, seed: int, variant: str) -> Trial:
    """Rods 8 to 1 pixels wide through a ball."""
    # The whole takes `FILL` of the picture; it is about as long as its bounding sphere is wide.
    width = ROD_WIDTHS_PX[int(severity)] / (FILL * room.size)
    return room.trial(ball_on_rods(width, seed), seed)


def grazing(room: Darkroom, severity: float, seed: int, variant: str) -> Trial:
    """A block, ever flatter, of which no view sees top or bottom but at a grazing angle."""
    mesh = slab(SLAB_HEIGHTS[int(severity)], seed)
    return room.trial(mesh, seed, elevations_deg=(6.0, 4.0))


def holes(room: Darkroom, severity: float, seed: int, variant: str) -> Trial:
    """Rings, handles and cavities, ever narrower."""
    mesh = pierced(variant, OPENINGS[int(severity)], seed)
    return room.trial(mesh, seed, euler=EULER[variant])


def few_views(room: Darkroom, severity: float, seed: int, variant: str) -> Trial:
    """Twelve views down to three."""
    return room.trial(toy(seed), seed, views=VIEW_COUNTS[int(severity)])


def cut_off(room: Darkroom, severity: float, seed: int, variant: str) -> Trial:
    """An object that touches the frame, then reaches beyond it."""
    return room.trial(toy(seed), seed, fill=FILLS[int(severity)])


HAZARDS = (
    Hazard(
        "thin-rods",
        "rods 8, 4, 2 and 1 pixels wide",
        "step",
        (0.0, 1.0, 2.0, 3.0),
        rods,
        notes=(DISAGREE, "inconsistent_masks"),
    ),
    Hazard(
        "grazing",
        "a flat block whose top and bottom are seen at grazing angles alone",
        "step",
        (0.0, 1.0, 2.0, 3.0),
        grazing,
        notes=(DISAGREE, "grazing_views"),
    ),
    Hazard(
        "topology",
        "a ring, a mug, two holes, and a cavity that no view sees; ever narrower",
        "step",
        (0.0, 1.0, 2.0, 3.0),
        holes,
        notes=(DISAGREE, "mesh"),
        variants=("ring", "mug", "eight", "shell"),
    ),
    Hazard(
        "few-views",
        "12, 6, 4 and 3 views",
        "step",
        (0.0, 1.0, 2.0, 3.0),
        few_views,
        notes=(DISAGREE, "few_views"),
    ),
    Hazard(
        "cut-off",
        "an object that touches the frame, then reaches beyond it",
        "step",
        (0.0, 1.0, 2.0, 3.0),
        cut_off,
        notes=(DISAGREE, "cut_off"),
    ),
)
