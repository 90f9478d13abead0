"""The declared table of what `svim3d chart` turns: one knob at a time, and all steps together.

A full product of all values is too dear; so each point differs from the base by one knob, and
points of joint scaling lie along the diagonal. Values that the base has already are left out by
themselves: they are the base.
"""

from collections.abc import Sequence
from dataclasses import dataclass

PHOTO, VIEWS = "photo", "views"  # what a knob's input must be; empty: any
SCALES = (0.25, 0.5, 2.0, 4.0)  # of the steps of phases 0, 1 and 2 together


@dataclass(frozen=True)
class Turn:
    """One value of a knob.

    Attributes:
        label: for a person; short.
        overrides: as `--set` takes them.
        views: of the orbit, that are given; None is all of them.
        size: longest side that the views are averaged down to before they are given, pixels.
    """

    label: str
    overrides: tuple[str, ...] = ()
    views: int | None = None
    size: int | None = None


@dataclass(frozen=True)
class Knob:
    """Something that can be turned.

    Attributes:
        name: on the command line.
        about: what it changes.
        turns: its values, from cheap to dear.
        stage: that must run for it, if the base leaves it out.
        steps: of that stage then, so that the knob is turned on something; None leaves its own.
        input: what it is for.
        is_quick: whether `--quick` keeps it (its first and last value).
    """

    name: str
    about: str
    turns: tuple[Turn, ...]
    stage: str = ""
    steps: int | None = None
    input: str = ""
    is_quick: bool = False


def _values(setting: str, *values: object) -> tuple[Turn, ...]:
    """A turn for each value of one setting."""
    return tuple(Turn(str(value).replace(" ", ""), (f"{setting}={value}",)) for value in values)


def _both(name: str, *values: object) -> tuple[Turn, ...]:
    """A turn for each value of a setting that phases 1 and 2 both have."""
    return tuple(Turn(str(v), (f"nerf.{name}={v}", f"dmtet.{name}={v}")) for v in values)


SURFACE_RATES = {"sdf_rate": 0.01, "offset_rate": 0.01}
MATERIAL_RATES = {"field_rate": 4e-4, "network_rate": 2e-4}


def _rates(what: str, rates: dict[str, float], factor: float) -> Turn:
    """Rates of phase 2 by a factor of what they are."""
    changes = tuple(f"dmtet.{name}={rate * factor:.3g}" for name, rate in rates.items())
    return Turn(f"{what}x{factor:g}", changes)


REMEDIES_OFF = (
    "nerf.warp_start=1",
    "nerf.weigh_views=false",
    "dmtet.warp_start=1",
    "dmtet.weigh_views=false",
    "uv_bake.correct_views=false",
)
GRIDS = {
    "64": "[48, 64]",
    "96": "[64, 96]",
    "128": "[64, 96, 128]",
    "192": "[64, 96, 128, 192]",
}
SHARES = {2: "[0.0, 0.5]", 3: "[0.0, 0.4, 0.7]", 4: "[0.0, 0.4, 0.65, 0.8]"}


def _grid(nodes: str) -> tuple[str, ...]:
    return (f"nerf.grid_nodes={nodes}", f"nerf.grid_shares={SHARES[nodes.count(',') + 1]}")


PHASE_2_STEPS = 150  # that its other knobs are turned at, where the base leaves it out

KNOBS = (
    Knob(
        "views",
        "how many of the orbit's views are given",
        tuple(Turn(str(count), views=count) for count in (8, 12, 16)),
        input=VIEWS,
    ),
    Knob(
        "size",
        "pixels that the given views have",
        tuple(Turn(str(pixels), size=pixels) for pixels in (64, 128, 256)),
        input=VIEWS,
    ),
    Knob(
        "sampler-steps",
        "steps from noise to views",
        _values("generation.sampler_steps", 1, 4, 12, 25),
        input=PHOTO,
        is_quick=True,
    ),
    Knob(
        "guidance-interval",
        "noise levels between which guidance acts, at a strength of 2",
        tuple(
            Turn(
                label,
                (
                    "generation.sampler_steps=12",
                    "generation.guidance_max=2.0",
                    *([f"generation.guidance_interval={interval}"] if interval else []),
                ),
            )
            for label, interval in (("0.3-2", "[0.3, 2.0]"), ("0.3-20", "[0.3, 20.0]"), ("all", ""))
        ),
        input=PHOTO,
    ),
    Knob(
        "samples",
        "orbits drawn, of which the most agreed-on one is kept",
        _values("generation.samples", 1, 2, 4),
        input=PHOTO,
    ),
    Knob("phase0-steps", "steps of phase 0", _values("env_preopt.steps", 25, 50, 100, 200, 400)),
    Knob(
        "prefilter",
        "how phase 0 filters the light: exact lobes, with samples, or the paper's few samples",
        _values("env_preopt.prefilter", "sampled", "hybrid", "exact"),
    ),
    Knob("light-size", "texels of the light's side", _values("env_preopt.size", 32, 64, 128)),
    Knob(
        "phase1-steps",
        "steps of phase 1",
        _values("nerf.steps", 100, 200, 400, 800, 1200),
        is_quick=True,
    ),
    Knob(
        "rays", "rays of a step of phase 1", _values("nerf.rays_per_step", 1024, 2048, 4096, 8192)
    ),
    Knob(
        "image-size",
        "pixels that phases 1 and 2 average the views down to",
        _both("image_size", 64, 128, 256),
    ),
    Knob(
        "grid",
        "nodes of the finest grid of phase 1",
        tuple(Turn(n, _grid(g)) for n, g in GRIDS.items()),
    ),
    Knob(
        "hash",
        "binary logarithm of the nodes of a level of the material field",
        _values("nerf.hash_log2_entries", 13, 15, 17),
    ),
    Knob(
        "remedies",
        "homographies and weights against views that disagree",
        (Turn("off", REMEDIES_OFF),),
    ),
    Knob(
        "phase2-steps",
        "steps of phase 2",
        _values("dmtet.steps", 50, 150, 400, 800, 1500),
        stage="dmtet",
        is_quick=True,
    ),
    Knob(
        "phase2-views",
        "views of a step of phase 2, at 150 steps",
        _values("dmtet.views_per_step", 2, 4),
        stage="dmtet",
        steps=PHASE_2_STEPS,
    ),
    Knob(
        "phase2-rates",
        "step sizes of surface and materials in phase 2, at 150 steps",
        (
            _rates("surface-", SURFACE_RATES, 0.3),
            _rates("surface-", SURFACE_RATES, 3.0),
            _rates("materials-", MATERIAL_RATES, 0.3),
            _rates("materials-", MATERIAL_RATES, 3.0),
        ),
        stage="dmtet",
        steps=PHASE_2_STEPS,
    ),
    Knob(
        "tets",
        "cells of the tetrahedral lattice along each side, at 150 steps",
        _values("dmtet.cells", 64, 96, 128),
        stage="dmtet",
        steps=PHASE_2_STEPS,
    ),
    Knob(
        "perceptual",
        "whether phases 1 and 2 compare crops as pictures, too",
        _both("perceptual", "dssim"),
    ),
    Knob(
        "faces", "triangles of the asset at most", _values("uv_bake.max_faces", 4000, 8000, 16000)
    ),
    Knob(
        "texture",
        "texels of the textures' side",
        _values("uv_bake.texture_size", 256, 512, 1024, 2048),
        is_quick=True,
    ),
    Knob(
        "texture-fit",
        "steps that sharpen the textures against the views",
        _values("uv_bake.fit_iterations", 0, 6, 12, 20, 40),
    ),
    Knob(
        "evidence",
        "faces, forms of materials and sizes of textures as the views ask for",
        (
            Turn(
                "on",
                (
                    "uv_bake.faces=evidence",
                    "uv_bake.materials=nested",
                    "uv_bake.materials_lost_db=0.5",
                    "uv_bake.texture_sizes=evidence",
                ),
            ),
        ),
    ),
)


def quick(knobs: Sequence[Knob]) -> list[Knob]:
    """The knobs that matter most, with their ends alone."""
    return [
        Knob(
            **{**vars(knob), "turns": tuple(dict.fromkeys((knob.turns[0], knob.turns[-1])))},
        )
        for knob in knobs
        if knob.is_quick
    ]
