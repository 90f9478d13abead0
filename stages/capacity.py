"""How much model the views ask for: read off them before any work, a bound for all later stages.

Reads MaterialViews, writes a CapacityPlan. Every size follows from a measure of the views: how far
each map can be averaged before it shows (Nyquist), how thin the silhouettes are, the sharpest
highlight, how many values a material has, how well the masks agree. Sources: Mueller et al. 2022
(a hash grid's finest level is that of the data); a GGX lobe damps degree l of the light's spherical
harmonics by exp(-l^2 alpha^2), so 1 % is left at l = 2.15 / alpha, which takes twice as many rows.
"""

import math
from dataclasses import dataclass

from torch import Tensor

from stages.artifacts import MaterialViews
from stages.base import Context, Stage
from stages.capacity_plan import CapacityPlan, Choice
from stages.settings.capacity import CapacityConfig
from svim3d.color import srgb_from_linear
from svim3d.numerics import normalize
from svim3d.render.view_evidence import (
    HullEvidence,
    Outline,
    averaging_room,
    count_modes,
    frontal_pixels,
    hull_evidence,
    outline,
)
from svim3d.shading.tonemap import agx

LIGHT_SIZES = (16, 32, 64, 128, 256)  # texels per side
LOBE_CUT = 2.15  # sqrt(ln 100): at this degree times alpha a lobe has damped light to 1 %
SHARP_SHARE = 0.05  # of the visible pixels that may be glossier than the light is made for
GROWTH = 1.6  # of hash lattices from level to level, at most; Mueller et al. 2022: 1.26 to 2
COARSEST = 16  # cells per side of the first hash lattice, `nerf.hash_coarsest`
CELLS_PER_ROOM = 1.5  # hash cells lie askew to pixels and collide: one is too few
NODES_PER_CELL = 2.0  # lattice nodes that a cell of surface touches and shares with no other
CELLS_PER_THICKNESS = 3.0  # two for the walls, one between
NORMALS_PER_CELL = 2.0  # a grid's gradient is a step where an averaged picture is a slope
TEXELS_USED = 0.5  # share of an atlas that shows surface
TEXELS_PER_ROOM = 4.0  # two along each axis: what is baked is averaged down once more
SEEN_EVERY = 64  # steps of phase 1 in which each pixel of the object is seen once
LOOKS_PER_VIEW = 15  # of phase 2 at one view a step: 300 steps for the usual 21 views
FACES_PER_ROOM = 4.0  # triangles for a square of the side that normals can be averaged over
MOST_AVERAGED = 4  # pixels; beyond that pictures say too little of the outline
LEAST_TEXTURE, LEAST_FACES, LEAST_RAYS = 64, 1000, 512
NEAR_SIDE = 0.5  # from the origin to the object's near side, half of its longest one

Proposal = tuple[str, float, str]  # a setting, what is enough of it, and why


@dataclass(frozen=True)
class _Evidence:
    """All that choices are made of: rooms in pixels, see `svim3d.render.view_evidence`."""

    room: dict[str, int]
    modes: dict[str, int]
    sharpest_alpha: float
    shape: Outline
    hull: HullEvidence
    views: int
    longest_px: int
    covered: float  # pixels of all views that show the object
    pixel: float  # side of the smallest pixel, where the object is nearest, world units

    @property
    def surface_room(self) -> int:
        """Pixels over which every map of the surface can be averaged."""
        return min(room for name, room in self.room.items() if name != "radiance")

    @property
    def surface_pixels(self) -> float:
        """Area of the object in pixels seen head on."""
        return self.hull.area / self.pixel**2


def run(views: MaterialViews, *, config: CapacityConfig, ctx: Context) -> CapacityPlan:
    """Read the evidence and choose."""
    evidence = _read(views, config)
    choices = tuple(
        Choice(setting, value, because)
        for setting, value, because in (
            *_light_choices(evidence),
            *_image_choices(evidence, config),
            *_shape_choices(evidence, config),
            *_paint_choices(evidence, config),
        )
    )
    for choice in choices:
        ctx.event("capacity", f"{choice.setting} {choice.value:g}: {choice.because}", tell=False)
    figures = {
        **{f"room_{name}_px": float(room) for name, room in evidence.room.items()},
        **{f"modes_{name}": float(modes) for name, modes in evidence.modes.items()},
        "sharpest_alpha": evidence.sharpest_alpha,
        "extent_px": evidence.shape.extent_px,
        "outline_complexity": evidence.shape.complexity,
        "thickness_px": evidence.shape.thickness_px,
        "hull_area": evidence.hull.area,
        **{f"hull_overlap_{k}": overlap for k, overlap in enumerate(evidence.hull.overlap)},
    }
    return CapacityPlan(choices, figures)


def _read(views: MaterialViews, config: CapacityConfig) -> _Evidence:
    """Look at the pictures."""
    chosen = list(range(0, len(views.cameras), max(1, len(views.cameras) // config.views)))
    cameras, mask = views.cameras[chosen], views.mask[chosen]
    normal = normalize(views.normal_world[chosen])
    counted = frontal_pixels(cameras, mask, normal)
    if views.confidence is not None:
        counted &= views.confidence[chosen] > 0.0
    lost, lost_radiance = (10.0 ** (-db / 20.0) for db in (config.lost_db, config.lost_radiance_db))
    straight = views.radiance[chosen] / mask.clamp_min(1e-3)
    colours = math.sqrt(3.0)  # a tolerance is of one channel, the difference has three
    seen: dict[str, tuple[Tensor, float]] = {
        "basecolor": (srgb_from_linear(views.basecolor[chosen].clamp(0.0, 1.0)), lost * colours),
        "roughness": (views.roughness[chosen], lost),
        "metallic": (views.metallic[chosen], lost),
        "normal": (normal, math.radians(config.lost_normal_deg)),
        "radiance": (agx(straight), lost_radiance * colours),
    }
    distance = views.cameras.positions.norm(dim=1)
    roughness, metallic = (seen[name][0][counted[..., 0]] for name in ("roughness", "metallic"))
    return _Evidence(
        room={name: averaging_room(image, counted, most) for name, (image, most) in seen.items()},
        modes={"roughness": count_modes(roughness, lost), "metallic": count_modes(metallic, lost)},
        sharpest_alpha=_quantile(roughness.square()[:, 0], SHARP_SHARE),
        shape=outline(views.mask),
        hull=hull_evidence(views.cameras, views.mask, config.half_extent),
        views=len(views.cameras),
        covered=float(views.mask.double().sum()),
        longest_px=max(views.cameras.height, views.cameras.width),
        pixel=float(distance.mean() - NEAR_SIDE) / views.cameras.focal_px,
    )


def _quantile(values: Tensor, share: float) -> float:
    """Of any number of values; 1, the roughest, of none."""
    if not len(values):
        return 1.0
    return float(values.sort().values[int(share * (len(values) - 1))])


def _light_choices(evidence: _Evidence) -> list[Proposal]:
    rows = 2.0 * LOBE_CUT / max(evidence.sharpest_alpha, 1e-3)
    size = next((size for size in LIGHT_SIZES if size >= rows), LIGHT_SIZES[-1])
    because = (
        f"95 % of what is seen is of roughness {math.sqrt(evidence.sharpest_alpha):.2f} or more, "
        f"which shows {rows:.0f} rows of light"
    )
    return [("env_preopt.size", size, because), ("nerf.environment_size", size, because)]


def _image_choices(evidence: _Evidence, config: CapacityConfig) -> list[Proposal]:
    room = min(evidence.surface_room, evidence.room["radiance"])
    thin = int(evidence.shape.thickness_px / CELLS_PER_THICKNESS)
    factor = max(1, min(room, thin, MOST_AVERAGED))
    size = max(-(-evidence.longest_px // factor), config.least_image)
    because = (
        f"maps can be averaged over {evidence.surface_room} px and radiance over "
        f"{evidence.room['radiance']} px; the thinnest part has "
        f"{evidence.shape.thickness_px:.0f} px"
    )
    pixels = evidence.covered * (size / evidence.longest_px) ** 2
    rays = 4 * math.ceil(pixels / SEEN_EVERY / 4)
    return [
        ("nerf.image_size", size, because),
        ("dmtet.image_size", size, because),
        (
            "nerf.rays_per_step",
            max(LEAST_RAYS, rays),
            f"{pixels:.0f} pixels show the object, each of them once in {SEEN_EVERY} steps",
        ),
        (
            "dmtet.steps",
            LOOKS_PER_VIEW * evidence.views,
            f"{evidence.views} views, each of them looked at {LOOKS_PER_VIEW} times",
        ),
    ]


def _shape_choices(evidence: _Evidence, config: CapacityConfig) -> list[Proposal]:
    room, thickness = evidence.room["normal"], evidence.shape.thickness_px
    cell = max(1.0, min(room / NORMALS_PER_CELL, thickness / CELLS_PER_THICKNESS))
    across = 2.0 * config.half_extent / evidence.pixel
    nodes = max(config.least_grid, 16 * math.ceil((across / cell + 1) / 16))
    because = (
        f"normals can be averaged over {room} px and the thinnest part has {thickness:.0f} px: "
        f"cells of {cell:.1f} px"
    )
    faces = FACES_PER_ROOM * evidence.surface_pixels / room**2
    return [
        ("nerf.grid_nodes", nodes, because),
        ("dmtet.cells", max(config.least_grid, nodes) // 2, because),
        (
            "uv_bake.max_faces",
            max(LEAST_FACES, round(faces)),
            f"{evidence.surface_pixels:.0f} px of surface, of which normals can be averaged over "
            f"squares of {room} px",
        ),
    ]


def _paint_choices(evidence: _Evidence, config: CapacityConfig) -> list[Proposal]:
    room = evidence.surface_room
    across = 2.0 * config.half_extent / (evidence.pixel * room)
    finest = max(COARSEST, math.ceil(CELLS_PER_ROOM * across))
    levels = max(2, 1 + math.ceil(math.log(finest / COARSEST) / math.log(GROWTH)))
    cells = evidence.hull.area * (finest / (2.0 * config.half_extent)) ** 2
    entries = max(8, math.ceil(math.log2(max(NODES_PER_CELL * cells, 2.0))))
    rooms = ", ".join(
        f"{name} {room}" for name, room in evidence.room.items() if name != "radiance"
    )
    because = f"pixels that maps can be averaged over: {rooms}"
    texels = TEXELS_PER_ROOM * evidence.surface_pixels / room**2 / TEXELS_USED
    size = 2 ** math.ceil(0.5 * math.log2(max(texels, 1.0)))
    return [
        ("nerf.hash_finest", finest, because),
        ("nerf.hash_levels", levels, f"lattices that grow by {GROWTH} at most, to {finest}"),
        ("nerf.hash_log2_entries", entries, f"{cells:.0f} cells of {finest} across hold surface"),
        (
            "uv_bake.texture_size",
            max(LEAST_TEXTURE, size),
            f"{evidence.surface_pixels:.0f} px of surface; {because}",
        ),
    ]


CAPACITY = Stage(run)
