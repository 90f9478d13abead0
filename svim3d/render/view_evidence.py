"""What views say, before any work, of how much model their object needs.

The *averaging room* of a picture is how far it can be averaged down, in pixels, until reading it
back bilinearly shows a difference: a lattice of cells of that size holds all that the views show
(Nyquist). Beside it stand how many values a material has, how narrow the sharpest visible
highlight is, how thin the object is and how well the masks agree about it.

Only pixels that the object fills and that see it from the front count: at a silhouette a picture is
steep because the surface turns away, and another view sees the same place head on.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from scipy import ndimage
from torch import Tensor
from torch.nn.functional import adaptive_avg_pool2d, interpolate

from svim3d.cameras import Cameras
from svim3d.mesh.marching import extract_surface
from svim3d.numerics import dot, normalize
from svim3d.raster.zbuffer import BACKGROUND, rasterize
from svim3d.render.hull import INSIDE_COVERAGE, coverage_votes
from svim3d.render.palettes import growing_palettes

ROOMS = (1, 2, 3, 4, 6, 8, 12, 16)  # pixels that may be averaged, per axis
SOLID = 0.99  # coverage of a pixel that holds no background
MIN_FACING = 0.5  # cosine from which on a picture's steepness is the surface's own
MOST_MODES = 4  # values of a material that are told apart; more are a texture
MODE_PIXELS = 20_000  # every so many pixels tell the modes as well as all of them
LOST_OUTLINE = 0.005  # share of a silhouette that thin parts and corners may hold unnoticed
HULL_NODES = 96  # per side: finer than the outlines of 128 px views
MOST_REJECTIONS = 3  # masks of 21 that may be wrong about a point
WORTH_REJECTING = 0.004  # IoU that one more rejected mask must bring
TINY = 1e-8  # keeps the quotient of two empty averages finite


def frontal_pixels(
    cameras: Cameras, mask: Float[Tensor, "V H W 1"], normal_world: Float[Tensor, "V H W 3"]
) -> Bool[Tensor, "V H W 1"]:
    """Pixels that the object fills, seen at `MIN_FACING` or more."""
    facing = [
        dot(normalize(normal_world[view].reshape(-1, 3)), -cameras.rays(view)[1])
        for view in range(len(cameras))
    ]
    return (torch.stack(facing).view_as(mask) >= MIN_FACING) & (mask >= SOLID)


def averaging_room(
    images: Float[Tensor, "V H W C"], counted: Bool[Tensor, "V H W 1"], tolerance: float
) -> int:
    """Largest of `ROOMS` at which averages, read back, are within a tolerance of the pictures.

    Averages are normalised: pixels that do not count weigh nothing, so that a constant has room
    without end up to any outline.

    Args:
        images: encoded as differences of them are seen.
        counted: pixels that are averaged and compared.
        tolerance: RMS length of the difference that may go unnoticed.
    """
    best = ROOMS[0]
    for room in ROOMS[1:]:
        if room * 2 > min(images.shape[1:3]):
            break
        if read_back_error(images, counted, room) > tolerance:
            break
        best = room
    return best


def read_back_error(
    images: Float[Tensor, "V H W C"], counted: Bool[Tensor, "V H W 1"], room: int
) -> float:
    """RMS length of what averages over `room` x `room` pixels, read bilinearly, lose; 0 if empty.

    A lattice that does not divide the picture is stretched to it by less than a cell.
    """
    weight = counted.to(images)
    stacked = torch.cat([images * weight, weight], -1).permute(0, 3, 1, 2)
    height, width = images.shape[1:3]
    coarse = adaptive_avg_pool2d(stacked, (max(1, height // room), max(1, width // room)))
    means, share = coarse.split([images.shape[-1], 1], 1)
    # Cells take their own mean first: what is read between two cells is a mean of means.
    filled = torch.cat([means / share.clamp_min(TINY), torch.ones_like(share)], 1) * (share > 0)
    fine = interpolate(filled, size=(height, width), mode="bilinear", align_corners=False)
    values, known = fine.permute(0, 2, 3, 1).split([images.shape[-1], 1], -1)
    squared = (values / known.clamp_min(TINY) - images).square().sum(-1, keepdim=True)
    total = float((squared * weight).double().sum()) / max(float(weight.sum()), 1.0)
    return math.sqrt(total)


def count_modes(values: Float[Tensor, "P 1"], tolerance: float) -> int:
    """Fewest clusters whose values are the pixels' own to an RMS tolerance.

    Returns:
        1 for a constant, up to `MOST_MODES`; one more where a picture is needed.
    """
    chosen = values[:: max(1, len(values) // MODE_PIXELS)]
    if not len(chosen) or float(chosen.std(correction=0)) <= tolerance:
        return 1
    for palette in growing_palettes(chosen, torch.ones(len(chosen)), MOST_MODES):
        offset = chosen - palette.values[palette.labels(chosen)]
        if float(offset.square().mean().sqrt()) <= tolerance:
            return len(palette.values)
    return MOST_MODES + 1


@dataclass(frozen=True)
class Outline:
    """A silhouette in numbers, the mean or the least of all views.

    Attributes:
        extent_px: longest side of the box around it, the largest of all views.
        complexity: perimeter^2 / area; 4 pi for a disc.
        thickness_px: diameter of the largest disc that can be rolled inside along the whole
            outline, but for `LOST_OUTLINE` of the area; the least of all views.
    """

    extent_px: float
    complexity: float
    thickness_px: float


def outline(mask: Float[Tensor, "V H W 1"]) -> Outline:
    """What the silhouettes say; views that show nothing are left out."""
    shown = [m[..., 0] for m in mask if float(m.max()) >= INSIDE_COVERAGE]
    if not shown:
        return Outline(0.0, 4.0 * math.pi, 0.0)
    return Outline(
        extent_px=max(_extent(m) for m in shown),
        complexity=sum(_complexity(m) for m in shown) / len(shown),
        thickness_px=min(_thickness(m) for m in shown),
    )


def _extent(mask: Float[Tensor, "H W"]) -> float:
    """Longest side of the box around the covered pixels."""
    inside = mask >= INSIDE_COVERAGE
    return float(max(inside.any(0).sum(), inside.any(1).sum()))


def _complexity(mask: Float[Tensor, "H W"]) -> float:
    """Perimeter^2 / area; the perimeter is the total variation (coarea formula)."""
    padded = torch.nn.functional.pad(mask, (1, 1, 1, 1)).double()
    # Central differences of an area-filtered edge sum to its contrast in every direction.
    down, right = (padded[2:, 1:-1] - padded[:-2, 1:-1]), (padded[1:-1, 2:] - padded[1:-1, :-2])
    perimeter = 0.5 * (down.square() + right.square()).sqrt().sum()
    return float(perimeter**2 / mask.double().sum())


def _thickness(mask: Float[Tensor, "H W"]) -> float:
    """Largest diameter whose opening still covers the silhouette but for `LOST_OUTLINE`."""
    inside = (mask >= INSIDE_COVERAGE).numpy()
    depth = ndimage.distance_transform_edt(inside)
    low, high = 0, max(1, math.ceil(2.0 * float(depth.max())))
    while high - low > 1:
        middle = (low + high) // 2
        core = depth >= 0.5 * middle
        away = ndimage.distance_transform_edt(~core) if core.any() else depth * math.inf
        # Distances are between pixel centres: a disc covers half a pixel more on either side.
        opened = inside & (away - 1.0 < 0.5 * middle)
        if opened.sum() >= (1.0 - LOST_OUTLINE) * inside.sum():
            low = middle
        else:
            high = middle
    return float(low)


@dataclass(frozen=True)
class HullEvidence:
    """How well hulls of the masks show the masks again.

    Attributes:
        overlap: mean IoU over the views for 0, 1, ... rejected masks.
        rejections: the fewest that one more would not improve on by `WORTH_REJECTING`.
        area: of the chosen hull's surface, world units squared.
    """

    overlap: Sequence[float]
    rejections: int
    area: float


def hull_evidence(
    cameras: Cameras, mask: Float[Tensor, "V H W 1"], half_extent: float
) -> HullEvidence:
    """Carve hulls with more and more masks overruled, and hold each against the masks.

    Exact masks are shown best by the strict hull: whatever is added shows beside them. Masks that
    disagree carve it thin, and what they took away is missing.
    """
    hulls: list[tuple[float, float]] = []
    for rejections in range(min(MOST_REJECTIONS, len(cameras) - 2) + 1):
        votes = coverage_votes(
            mask[..., 0],
            cameras.clip_from_world(),
            nodes=HULL_NODES,
            half_extent=half_extent,
            rejections=rejections,
        )
        vertices, faces = extract_surface(votes - INSIDE_COVERAGE, half_extent)
        hulls.append((_overlap(vertices, faces, cameras, mask), _area(vertices, faces)))
        if rejections and hulls[-1][0] < hulls[-2][0] + WORTH_REJECTING:
            break
    best = len(hulls) - 1
    while best and hulls[best][0] < hulls[best - 1][0] + WORTH_REJECTING:
        best -= 1
    return HullEvidence(tuple(overlap for overlap, _ in hulls), best, hulls[best][1])


def _overlap(
    vertices: Float[Tensor, "N 3"],
    faces: Tensor,
    cameras: Cameras,
    mask: Float[Tensor, "V H W 1"],
) -> float:
    """Mean IoU of a surface's silhouettes and the masks."""
    if not len(faces):
        return 0.0
    clip, total = cameras.project(vertices), 0.0
    for view in range(len(cameras)):
        fragments = rasterize(clip[view], faces, cameras.height, cameras.width)
        shown = fragments.triangle != BACKGROUND
        wanted = mask[view, ..., 0] >= INSIDE_COVERAGE
        total += float((shown & wanted).sum() / (shown | wanted).sum().clamp_min(1))
    return total / len(cameras)


def _area(vertices: Float[Tensor, "N 3"], faces: Tensor) -> float:
    """Sum of the triangles' areas."""
    a, b, c = vertices[faces.long()].unbind(1)
    return float(0.5 * torch.linalg.cross(b - a, c - a).norm(dim=1).sum())
