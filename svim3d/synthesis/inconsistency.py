"""Views that contradict each other, as a poor generator draws them: a seeded model of its faults.

True views of one object are displaced (a homography for each view and a smooth warp on top of it),
blurred and discoloured, more so at grazing angles and far from the reference view; some of the
light is baked into the basecolor, outlines bulge and shrink, normals waver. Every fault has a
strength of its own. All random draws depend on the seed, the view and the kind of fault alone:
with another strength the same fault is larger or smaller, and one kind alone is the one of the
mixture. The reference view, which a generator is given, stays as it is.

Source: SViM3D, section 4 names the faults; their sizes are ours.
"""

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Self

import torch
from jaxtyping import Float
from torch import Tensor

from svim3d.cameras import Cameras
from svim3d.numerics import dot, normalize, saturate
from svim3d.synthesis.dice import Dice
from svim3d.synthesis.displacements import (
    nominal_px,
    random_homography,
    resample,
    smooth_field,
    source_points,
)
from svim3d.synthesis.view_defects import (
    MIN_COVERAGE,
    blurred,
    drifted,
    spread_outward,
    with_baked_light,
    with_moved_silhouette,
    with_tilted_normals,
)

WORST = 5.0  # the largest severity
RADIANCE, MASK, NORMAL = "radiance", "mask", "normal_world"
APPEARANCE = ("basecolor", "roughness", "metallic")
# Fields of faults bend this often across the picture: an object takes about half of its width.
WARP_CELLS, COLOUR_CELLS, OUTLINE_CELLS, DENT_CELLS, GRAIN_CELLS = 6, 4, 10, 6, 32
NEAR_SHARE = 0.25  # of blur and drift that views beside the reference already have
FRONTAL_SHARE = 0.5  # of blur and drift that a surface seen from the front has
EVEN_SHARE = 0.5  # of drift, silhouette and normal faults that is the same over a whole view
LEAST_BAKED = 0.5  # of the share of baked light, that a view has at least

Images = Mapping[str, Float[Tensor, "V H W _"]]
View = dict[str, Float[Tensor, "H W _"]]


@dataclass(frozen=True)
class Strengths:
    """The largest size of each fault; lengths in pixels of a picture 256 wide.

    Attributes:
        homography_px: displacement of the corners of the object's box.
        smooth_warp_px: displacement by the smooth warp that is added.
        blur_px: standard deviation of the Gaussian, reached at grazing angles behind the object.
        colour_stops: exposure of a colour channel, reached likewise.
        baked_light: share of the lit picture in the basecolor, at most 1.
        outline_px: how far the silhouette moves in or out.
        normal_deg: tilt of normals, below 90.

    Raises:
        ValueError: a strength is negative or not finite, or one of the two bounded ones too large.
    """

    homography_px: float = 0.0
    smooth_warp_px: float = 0.0
    blur_px: float = 0.0
    colour_stops: float = 0.0
    baked_light: float = 0.0
    outline_px: float = 0.0
    normal_deg: float = 0.0

    def __post_init__(self) -> None:
        limits = {"baked_light": 1.0, "normal_deg": 89.0}
        for name, value in dataclasses.asdict(self).items():
            highest = limits.get(name, math.inf)
            if not (0.0 <= value <= highest and math.isfinite(value)):
                raise ValueError(f"wanted {name} from 0 to {highest}, got {value}")

    @classmethod
    def at(cls, severity: float) -> Self:
        """All faults of a severity, 0 (none) to 5; they grow in proportion to it.

        Raises:
            ValueError: the severity lies outside.
        """
        if not 0.0 <= severity <= WORST:
            raise ValueError(f"wanted a severity from 0 to {WORST:g}, got {severity}")
        worst = dataclasses.asdict(AT_WORST)
        return cls(**{name: value * severity / WORST for name, value in worst.items()})

    def only(self, *kinds: str) -> Self:
        """The faults of the named kinds alone.

        Raises:
            ValueError: there is no such kind.
        """
        unknown = set(kinds) - set(KINDS)
        if unknown:
            raise ValueError(f"wanted kinds among {', '.join(KINDS)}, got {sorted(unknown)}")
        return dataclasses.replace(self, **{name: 0.0 for name in KINDS if name not in kinds})


KINDS = tuple(field.name for field in dataclasses.fields(Strengths))
AT_WORST = Strengths(
    homography_px=8.0,
    smooth_warp_px=2.0,
    blur_px=3.0,
    colour_stops=1.2,
    baked_light=0.6,
    outline_px=3.0,
    normal_deg=35.0,
)


@dataclass(frozen=True)
class InconsistentViews:
    """What became of true views.

    Attributes:
        images: as the true ones were given.
        homography: per view, from points of the true picture to where they are displaced, in
            normalised coordinates (x right, y down, -1 to 1 between the picture's edges); the
            smooth warp comes on top of it. The identity where nothing moved.
    """

    images: dict[str, Float[Tensor, "V H W _"]]
    homography: Float[Tensor, "V 3 3"]


def make_inconsistent(
    cameras: Cameras, images: Images, reference: int, strengths: Strengths, seed: int
) -> InconsistentViews:
    """Give every view but the reference faults of its own.

    Args:
        cameras: V poses.
        images: those of an orbit (`svim3d.io.orbit.CHANNELS`), and its optional ones: radiance is
            linear and premultiplied, all others are straight.
        reference: index of the view that is not touched.
        strengths: largest size of each fault; one of size zero changes no bit.
        seed: of all random draws.
    """
    changed: dict[str, list[Tensor]] = {name: [] for name in images}
    homographies = []
    for index in range(len(cameras)):
        view = {name: image[index] for name, image in images.items()}
        homography = torch.eye(3, dtype=torch.float64)
        if index != reference and bool((view[MASK] > MIN_COVERAGE).any()):
            faults = _Faults(cameras, index, reference, strengths, seed)
            view, homography = faults.upon(view)
        homographies.append(homography)
        for name, image in view.items():
            changed[name].append(image)
    stacked = {name: torch.stack(views) for name, views in changed.items()}
    return InconsistentViews(stacked, torch.stack(homographies).to(cameras.c2w))


@dataclass(frozen=True)
class _Faults:
    """The faults of one view."""

    cameras: Cameras
    index: int
    reference: int
    strengths: Strengths
    seed: int

    def upon(self, view: View) -> tuple[View, Float[Tensor, "3 3"]]:
        """The view with its faults, and where its points went."""
        weight = self._weight(view)
        if self.strengths.baked_light:
            view = self._baked(view)
        if self.strengths.colour_stops:
            view = self._discoloured(view, weight)
        if self.strengths.normal_deg:
            view = self._dented(view)
        if self.strengths.blur_px:
            view = self._blurred(view, weight)
        homography = torch.eye(3, dtype=torch.float64)
        if self.strengths.homography_px or self.strengths.smooth_warp_px:
            view, homography = self._displaced(view)
        if self.strengths.outline_px:
            view = self._trimmed(view)
        return view, homography

    def _dice(self, kind: str) -> Dice:
        return Dice.of(self.seed, self.index * len(KINDS) + KINDS.index(kind))

    def _weight(self, view: View) -> Float[Tensor, "H W 1"]:
        """Share of blur and drift: grows with the angle to the reference and towards grazing."""
        backward = normalize(self.cameras.positions)
        apart = 0.5 - 0.5 * float(dot(backward[self.index], backward[self.reference]))
        normal = view[NORMAL]
        wo = -self.cameras.rays(self.index)[1].to(normal).view_as(normal)
        grazing = 1.0 - saturate(dot(normal, wo))
        by_view = NEAR_SHARE + (1.0 - NEAR_SHARE) * apart
        return by_view * (FRONTAL_SHARE + (1.0 - FRONTAL_SHARE) * grazing)

    def _baked(self, view: View) -> View:
        share = self.strengths.baked_light * self._dice("baked_light").uniform(LEAST_BAKED, 1.0)
        basecolor = with_baked_light(view["basecolor"], view[RADIANCE], view[MASK], share)
        return view | {"basecolor": basecolor}

    def _discoloured(self, view: View, weight: Float[Tensor, "H W 1"]) -> View:
        dice = self._dice("colour_stops")
        even = dice.uniforms(-1.0, 1.0, 3)
        uneven = smooth_field(dice, 3, COLOUR_CELLS, _shape(view))
        mixed = (EVEN_SHARE * even + (1.0 - EVEN_SHARE) * uneven).to(weight)
        stops = self.strengths.colour_stops * weight * mixed
        return view | {
            RADIANCE: drifted(view[RADIANCE], stops),
            "basecolor": saturate(drifted(view["basecolor"], stops)),
        }

    def _dented(self, view: View) -> View:
        dice = self._dice("normal_deg")
        dents = smooth_field(dice, 3, DENT_CELLS, _shape(view))
        grain = smooth_field(dice, 3, GRAIN_CELLS, _shape(view))
        noise = (EVEN_SHARE * dents + (1.0 - EVEN_SHARE) * grain).to(view[NORMAL])
        tilted = with_tilted_normals(view[NORMAL], noise, self.strengths.normal_deg)
        return view | {NORMAL: tilted}

    def _blurred(self, view: View, weight: Float[Tensor, "H W 1"]) -> View:
        mask, spread = view[MASK], self.strengths.blur_px * weight
        straight = view | {RADIANCE: view[RADIANCE] / mask.clamp_min(MIN_COVERAGE)}
        names = [name for name in (RADIANCE, *APPEARANCE, NORMAL) if name in view]
        soft = {name: blurred(straight[name], mask, spread) for name in names}
        soft[RADIANCE] = torch.where(mask > MIN_COVERAGE, soft[RADIANCE] * mask, view[RADIANCE])
        return view | soft | {NORMAL: normalize(soft[NORMAL])}

    def _displaced(self, view: View) -> tuple[View, Float[Tensor, "3 3"]]:
        homography = torch.eye(3, dtype=torch.float64)
        if self.strengths.homography_px:
            homography = random_homography(
                view[MASK], self.strengths.homography_px, self._dice("homography_px")
            )
        field = smooth_field(self._dice("smooth_warp_px"), 2, WARP_CELLS, _shape(view))
        flow = self.strengths.smooth_warp_px * nominal_px(_shape(view)) * field
        points = source_points(homography, flow.to(view[MASK]))
        moved = {name: resample(plane, points) for name, plane in _premultiplied(view).items()}
        return _straight(moved), homography

    def _trimmed(self, view: View) -> View:
        dice = self._dice("outline_px")
        even = dice.uniform(-1.0, 1.0)
        uneven = smooth_field(dice, 1, OUTLINE_CELLS, _shape(view))
        mixed = (EVEN_SHARE * even + (1.0 - EVEN_SHARE) * uneven).to(view[MASK])
        mask = with_moved_silhouette(view[MASK], self.strengths.outline_px * mixed)
        straight = view | {RADIANCE: view[RADIANCE] / view[MASK].clamp_min(MIN_COVERAGE)}
        grown = {n: spread_outward(p, view[MASK]) for n, p in straight.items() if n != MASK}
        return _straight({n: p * mask for n, p in grown.items()} | {MASK: mask})


def _premultiplied(view: View) -> View:
    """All planes times coverage, as radiance is already."""
    kept = (MASK, RADIANCE)
    return {name: p if name in kept else p * view[MASK] for name, p in view.items()}


def _straight(view: View) -> View:
    """Planes divided by coverage but for radiance; unit normals; zero where nothing is covered."""
    covered = view[MASK] > MIN_COVERAGE
    mask = torch.where(covered, view[MASK], 0.0)
    planes = {n: torch.where(covered, p / view[MASK], 0.0) for n, p in view.items()}
    radiance = torch.where(covered, view[RADIANCE], 0.0)
    return planes | {MASK: mask, RADIANCE: radiance, NORMAL: normalize(planes[NORMAL])}


def _shape(view: View) -> tuple[int, int]:
    return view[MASK].shape[0], view[MASK].shape[1]
