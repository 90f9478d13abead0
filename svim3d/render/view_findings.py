"""What views themselves say against an asset that is made of them, before anything is fitted.

Each finding is an honest note, no fault: the views are used as they are.
"""

import math
from collections.abc import Iterator, Mapping

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from svim3d.cameras import Cameras
from svim3d.color import luminance
from svim3d.numerics import normalize

SOFT_MASKS = "soft_masks"  # kind of the finding
COVERED = 0.5  # mask above which a pixel counts as the object
FEW_VIEWS = 7  # fewer leave gaps of more than a right angle on one of two sides
WIDE_GAP_DEG = 100.0  # between neighbours in azimuth; what faces its middle is seen at 50 degrees
CUT_SHARE = 0.1  # of a side of the frame, covered by the object
PLATEAU = 1e-3  # relative distance to the largest value, within which highlights are one value
CLIPPED_SHARE = 0.01  # of the covered pixels, on that plateau
GLARE = 300.0  # times what a twentieth of the object exceeds: sparkles of noise, or a bare lamp
# Luminance of the basecolor below which a dielectric shows more of its surroundings (F0 is 0.04,
# more towards the rim) than of itself, and the share of the pixels that lie below it.
DARK, DARK_SHARE = 0.06, 0.5
# Brushed steel (0.35) already loses 9 dB under a light that is found at 32 x 32 texels.
MIRROR_ROUGHNESS, MIRROR_SHARE = 0.4, 0.25
SOFT_PX = 2.0  # width of the ramp of coverage; sound views stay below 1.1, thin rods among them
FAINT = 0.03  # coverage nearer to 0 or 1 counts as none or whole
GRAZING, GRAZING_SHARE = 0.35, 0.1  # best cosine of any view, and share of the pixels below it
NORMAL_BINS = 12  # per side of the cube that normals are sorted into

# Transfer curves: log radiance follows log basecolor with slope 1 where surfaces are dull and
# face alike. A display curve on the basecolor makes it about 2.2, on the radiance 0.45.
DULL_ROUGHNESS, DULL_METALLIC = 0.35, 0.1
MIN_COLOUR, MAX_COLOUR = 0.03, 0.98  # darker ones are ruled by highlights, brighter ones clip
MIN_SPREAD = 0.07  # deviation of log basecolor among like normals, below which nothing is told
MIN_PIXELS = 200
MIN_CORRELATION = 0.7  # of the two logarithms; below it something else rules the radiance
STEEP, FLAT = 1.5, 0.65

Images = Mapping[str, Float[Tensor, "V H W _"]]
Finding = tuple[str, str]  # kind, and a sentence for the operator


def view_findings(cameras: Cameras, images: Images) -> list[Finding]:
    """All findings on an orbit's images (`svim3d.io.orbit.CHANNELS`); radiance is premultiplied."""
    covered = images["mask"][..., 0] > COVERED
    if not bool(covered.any()):
        return []
    return [
        *_few(cameras),
        *_cut_off(covered),
        *_soft(images["mask"]),
        *_clipped(images, covered),
        *_glaring(images, covered),
        *_dark(images, covered),
        *_mirror(images, covered),
        *_grazing(cameras, images, covered),
        *_curve(images, covered),
    ]


def _few(cameras: Cameras) -> Iterator[Finding]:
    gap = widest_gap_deg(cameras)
    if len(cameras) < FEW_VIEWS or gap > WIDE_GAP_DEG:
        yield (
            "few_views",
            f"{len(cameras)} views, up to {gap:.0f} degrees apart: what none of them sees from "
            "near its front is guessed; give more views around the object",
        )


def widest_gap_deg(cameras: Cameras) -> float:
    """Largest difference in azimuth between neighbouring cameras; 360 for one."""
    azimuth = cameras.azimuths.sort().values
    steps = torch.diff(azimuth, append=azimuth[:1] + math.tau)
    return math.degrees(float(steps.max()))


def _cut_off(covered: Bool[Tensor, "V H W"]) -> Iterator[Finding]:
    sides = (covered[:, 0], covered[:, -1], covered[:, :, 0], covered[:, :, -1])
    share = torch.stack([side.float().mean(1) for side in sides]).amax(0)
    cut = torch.nonzero(share > CUT_SHARE)[:, 0].tolist()
    if cut:
        yield (
            "cut_off",
            f"the object reaches the frame in {len(cut)} of {len(covered)} views: what lies beyond "
            "is cut off or guessed; frame it with a margin",
        )


def _soft(mask: Float[Tensor, "V H W 1"]) -> Iterator[Finding]:
    width = ramp_width_px(mask)
    if width > SOFT_PX:
        yield (
            SOFT_MASKS,
            f"masks fade over about {width:.1f} pixels: the outline is uncertain by as much, and "
            "colours along it may hold background; give sharper masks",
        )


def ramp_width_px(mask: Float[Tensor, "V H W 1"]) -> float:
    """Mean width over which coverage fades across outlines."""
    covered = mask[..., 0] > COVERED
    partial = (mask > FAINT) & (mask < 1.0 - FAINT)
    inside = torch.nn.functional.max_pool2d((~covered).float()[:, None], 3, 1, 1)[:, 0] > 0.0
    return int(partial.sum()) / max(int((covered & inside).sum()), 1)


def _clipped(images: Images, covered: Bool[Tensor, "V H W"]) -> Iterator[Finding]:
    whole = covered & (images["mask"][..., 0] > 1.0 - FAINT)
    values = images["radiance"][whole].amax(-1)
    if not len(values):
        return
    top = float(values.max())
    share = float((values > top * (1.0 - PLATEAU)).float().mean())
    if top > 0.0 and share > CLIPPED_SHARE:
        yield (
            "clipped_highlights",
            f"{share:.1%} of the object has the one brightest value {top:.3g}: highlights are cut "
            "off, and the light comes out too dim; give radiance before it is clipped",
        )


def _glaring(images: Images, covered: Bool[Tensor, "V H W"]) -> Iterator[Finding]:
    values = images["radiance"].amax(-1)
    bright = torch.sort(values[covered]).values
    usual = float(bright[int(0.95 * (len(bright) - 1))])
    count = int((values > GLARE * usual).sum())
    if usual > 0.0 and count:
        yield (
            "glaring_pixels",
            f"{count} pixels are up to {float(values.max()) / usual:.3g} times as bright as the "
            "bright part of the object: they lead the light astray if they are noise",
        )


def _dark(images: Images, covered: Bool[Tensor, "V H W"]) -> Iterator[Finding]:
    share = float((luminance(images["basecolor"][covered]) < DARK).float().mean())
    if share > DARK_SHARE:
        yield (
            "dark_basecolor",
            f"{share:.0%} of the object has a basecolor below {DARK:g}: only highlights tell its "
            "roughness, its metallic and the light",
        )


def _mirror(images: Images, covered: Bool[Tensor, "V H W"]) -> Iterator[Finding]:
    metal = images["metallic"][covered] > 0.5
    smooth = images["roughness"][covered] < MIRROR_ROUGHNESS
    share = float((metal & smooth).float().mean())
    if share > MIRROR_SHARE:
        yield (
            "mirror_like",
            f"{share:.0%} of the object is metal of roughness below {MIRROR_ROUGHNESS:g}: it shows "
            "its surroundings, which are found no sharper than the light's texels",
        )


def _grazing(cameras: Cameras, images: Images, covered: Bool[Tensor, "V H W"]) -> Iterator[Finding]:
    normal = normalize(images["normal_world"][covered])
    best = (normal @ normalize(cameras.positions).T).amax(1)
    share = float((best < GRAZING).float().mean())
    # A convex object has its rims in every view; what counts is how little of it is seen well.
    if share > GRAZING_SHARE:
        angle = math.degrees(math.acos(GRAZING))
        yield (
            "grazing_views",
            f"{share:.0%} of what the views show faces all of them at more than {angle:.0f} "
            "degrees: its texture is smeared; add views that look at it",
        )


def _curve(images: Images, covered: Bool[Tensor, "V H W"]) -> Iterator[Finding]:
    slopes = colour_slopes(images, covered)
    if slopes is None:
        return
    least, most = slopes
    if least > STEEP:
        what = "basecolor seems to be display-encoded (sRGB) or radiance linearised twice"
    elif most < FLAT:
        what = "basecolor seems to be linearised twice or radiance display-encoded (sRGB)"
    else:
        return
    yield (
        "colour_space",
        f"{what}: radiance goes with the power {least:.1f} to {most:.1f} of basecolor instead of "
        "1; both must be scene-linear",
    )


def colour_slopes(images: Images, covered: Bool[Tensor, "V H W"]) -> tuple[float, float] | None:
    """Power of the basecolor that radiance goes with, among dull pixels whose normals are alike.

    Under one light, diffuse radiance is basecolor times a function of the normal. What else moves
    the radiance (shadows), or spoils the basecolor, makes the regression flatter than the power
    and the inverse one steeper: the two bounds. None where the colours do not tell.
    """
    dull = (
        covered
        & (images["mask"][..., 0] > 1.0 - FAINT)
        & (images["roughness"][..., 0] > DULL_ROUGHNESS)
        & (images["metallic"][..., 0] < DULL_METALLIC)
    )
    colour, radiance = images["basecolor"][dull], images["radiance"][dull]
    usable = ((colour > MIN_COLOUR) & (colour < MAX_COLOUR) & (radiance > 0.0)).all(1)
    if int(usable.sum()) < MIN_PIXELS:
        return None
    cells = ((normalize(images["normal_world"][dull][usable]) + 1.0) * (0.5 * NORMAL_BINS)).long()
    cells = cells.clamp(0, NORMAL_BINS - 1)
    group = torch.unique(cells, dim=0, return_inverse=True)[1]
    x = _about_group_means(colour[usable].double().log(), group).flatten()
    y = _about_group_means(radiance[usable].double().log(), group).flatten()
    xx, xy, yy = float(x @ x), float(x @ y), float(y @ y)
    if xx < MIN_SPREAD**2 * len(x) or xy < MIN_CORRELATION * math.sqrt(xx * yy):
        return None
    return xy / xx, yy / xy


def _about_group_means(
    values: Float[Tensor, "P 3"], group: Int[Tensor, "P"]
) -> Float[Tensor, "P 3"]:
    """Values minus the mean of their group, for each channel."""
    count = int(group.max()) + 1
    total = values.new_zeros(count, values.shape[1]).index_add_(0, group, values)
    number = torch.bincount(group, minlength=count)[:, None]
    return values - (total / number)[group]
