"""A reference view on an ellipsoid, seen from all around; and normals of an inflated mask."""

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt
from scipy.sparse import diags
from scipy.sparse.linalg import spsolve
from torch import Tensor
from torch.nn import functional

from benchmarks.generator_views import COVERED, Case
from svim3d.cameras import Cameras, orbit_cameras
from svim3d.numerics import dot, normalize

SAMPLES = 2  # per pixel and axis
FITTING_ROUNDS = 60  # of a fixed point that gains about a digit every five
# The scale of a picture is free: only the ratio of the body's size to the distance shows.
RADIUS = 2.9
FLATTEST = 0.05  # share of its width that a body keeps in height, seen from far above


@dataclass(frozen=True)
class Warp:
    """A variant.

    Attributes:
        scale: of the ellipsoid about what fits the mask.
        carves: whether the reference mask is part of the texture, rather than the outline of the
            ellipsoid being the mask of the new view.
    """

    scale: float
    carves: bool


@dataclass(frozen=True)
class Ellipsoid:
    """A body that is round seen from above.

    Attributes:
        centre: in world space, [3].
        half_axes: along x, y and z, the first and last equal, [3].
    """

    centre: Tensor
    half_axes: Tensor

    def scaled(self, scale: float) -> "Ellipsoid":
        """Larger about the centre."""
        return replace(self, half_axes=self.half_axes * scale)


@dataclass(frozen=True)
class Seen:
    """An ellipsoid in K views, straight colours and camera-space normals, [K, H, W, C]."""

    colours: Tensor
    normal: Tensor
    mask: Tensor


def outline_box(body: Ellipsoid, camera: Cameras) -> Tensor:
    """Left, right, bottom and top of a body's outline, as slopes from the camera's axis.

    A plane n through the camera touches the body where n^T S n = (n . c)^2, with S the body's
    quadric and c its centre in camera space. The line x = u of the picture is n = (1, 0, u).
    """
    rotation = camera.c2w[0, :3, :3].double()
    shape = rotation.T @ torch.diag(body.half_axes.double().square()) @ rotation
    centre = rotation.T @ (body.centre.double() - camera.positions[0].double())
    quadric = shape - torch.outer(centre, centre)
    edges = []
    for axis in (0, 1):
        a, b, c = quadric[2, 2], quadric[axis, 2], quadric[axis, axis]
        root = (b * b - a * c).sqrt()
        edges.extend(sorted([float((-b - root) / a), float((-b + root) / a)]))
    return torch.tensor(edges)


def mask_box(mask: Tensor, fov_deg: float) -> Tensor:
    """Left, right, bottom and top of a mask, as slopes from the camera's axis."""
    height, width = mask.shape[:2]
    focal = 0.5 * height / math.tan(math.radians(fov_deg) / 2)
    left, right = _extent(mask[..., 0].amax(0))
    top, bottom = _extent(mask[..., 0].amax(1))
    edges = [left - width / 2, right - width / 2, height / 2 - bottom, height / 2 - top]
    return torch.tensor(edges) / focal


def _extent(profile: Tensor) -> tuple[float, float]:
    """Where a row of coverages begins and ends, to a fraction of a pixel.

    Of the first covered pixel and of the one before it, the covered shares count.
    """
    inside = torch.nonzero(profile > COVERED)[:, 0]
    first, last = int(inside[0]), int(inside[-1])
    shares = functional.pad(profile, (1, 1))  # share i is that of pixel i - 1
    begin = first + 1.0 - float(shares[first + 1] + shares[first])
    end = last + float(shares[last + 1] + shares[last + 2])
    return begin, end


def fit_ellipsoid(mask: Tensor, elevation_deg: float, fov_deg: float) -> Ellipsoid:
    """The body whose outline in the reference view has the box of the mask."""
    size = mask.shape[0]
    camera = orbit_cameras([(elevation_deg, 0.0)], radius=RADIUS, fov_y_deg=fov_deg, size=size)
    right, up = camera.c2w[0, :3, 0], camera.c2w[0, :3, 1]
    goal = mask_box(mask, fov_deg)
    width, height = goal[1] - goal[0], goal[3] - goal[2]
    across, tall = 0.5 * RADIUS * width, 0.5 * RADIUS * height
    centre = torch.zeros(3)
    for _ in range(FITTING_ROUNDS):
        now = outline_box(Ellipsoid(centre, torch.stack([across, tall, across])), camera)
        across = across * width / (now[1] - now[0])
        tall = (tall * height / (now[3] - now[2])).clamp(min=FLATTEST * float(across))
        centre = centre + 0.5 * RADIUS * (goal[0] + goal[1] - now[0] - now[1]) * right
        centre = centre + 0.5 * RADIUS * (goal[2] + goal[3] - now[2] - now[3]) * up
    return Ellipsoid(centre, torch.stack([across, tall, across]))


def warp_views(case: Case, body: Ellipsoid, colours: Tensor, *, carves: bool) -> Seen:
    """The body, textured by the reference view, from all cameras of a case.

    Args:
        case: its cameras and its reference mask.
        body: in world space.
        colours: straight, of the reference view, [H, W, C].
        carves: see `Warp`.
    """
    size = case.mask.shape[0]
    angles = list(zip(case.elevation_deg.tolist(), case.azimuth_deg.tolist(), strict=True))
    cameras = orbit_cameras(angles, radius=RADIUS, fov_y_deg=case.fov_deg, size=size * SAMPLES)
    texture = torch.cat([fill_outside(colours, case.mask), case.mask], -1)
    views = [_warp_view(cameras, view, body, texture, carves) for view in range(len(cameras))]
    stacked = torch.stack(views)
    stacked = stacked.view(len(views), size, SAMPLES, size, SAMPLES, -1).mean((2, 4))
    premultiplied, normal, mask = stacked.split([colours.shape[-1], 3, 1], -1)
    seen = (mask > 0.0).to(mask)
    return Seen(premultiplied / mask.clamp(min=1e-6), normalize(normal) * seen, mask)


def _warp_view(
    cameras: Cameras, view: int, body: Ellipsoid, texture: Tensor, carves: bool
) -> Tensor:
    """Premultiplied colours, normals and coverage of every sample of one view."""
    origin, direction = cameras.rays(view)
    point, hit = _first_hit((origin - body.centre) / body.half_axes, direction / body.half_axes)
    reference = cameras[len(cameras) - 1]
    eye = (reference.positions[0] - body.centre) / body.half_axes
    source = body.centre + body.half_axes * visible_twin(point, eye)
    clip = reference.project(source)[0]
    place = clip[:, :2] / clip[:, 3:] * torch.tensor([1.0, -1.0])
    sampled = functional.grid_sample(
        texture.movedim(-1, 0)[None], place[None, None], align_corners=False, padding_mode="border"
    )[0, :, 0].T
    coverage = hit * sampled[:, -1:] if carves else hit
    world = normalize(point / body.half_axes)
    normal = world @ cameras.c2w[view, :3, :3]
    flat = torch.cat([sampled[:, :-1] * coverage, normal * coverage, coverage], -1)
    return flat.view(cameras.height, cameras.width, -1)


def _first_hit(origin: Tensor, direction: Tensor) -> tuple[Tensor, Tensor]:
    """Where rays meet the unit sphere first, [P, 3], and whether they do, [P, 1] of 0 and 1."""
    a, b = dot(direction, direction), dot(origin, direction)
    discriminant = b * b - a * (dot(origin, origin) - 1.0)
    t = (-b - discriminant.clamp(min=0.0).sqrt()) / a
    return normalize(origin + t * direction), (discriminant > 0.0).to(origin)


def visible_twin(point: Tensor, eye: Tensor) -> Tensor:
    """For points of the unit sphere, points that an eye sees and that lend them their colour.

    What the eye sees lends its own; the back takes the mirrored front (z is towards the
    reference view); what is seen neither way takes the nearest of the rim.

    Args:
        point: [P, 3].
        eye: outside the sphere, [3].
    """
    distance = torch.linalg.vector_norm(eye)
    mirrored = torch.cat([point[:, :2], -point[:, 2:]], -1)
    towards = eye / distance
    own, other = point @ towards, mirrored @ towards
    rim = 1.0 / distance
    chosen = torch.where((own >= rim)[:, None], point, mirrored)
    # The better of both, where neither is seen.
    chosen = torch.where(((own < rim) & (other < rim) & (own > other))[:, None], point, chosen)
    along = (chosen @ towards)[:, None]
    across = normalize(chosen - along * towards)
    on_rim = rim * towards + (1.0 - rim * rim).sqrt() * across
    return torch.where(along >= rim, chosen, on_rim)


def fill_outside(colours: Tensor, mask: Tensor) -> Tensor:
    """Colours of the nearest covered pixel where the mask is empty, [H, W, C]."""
    empty = (mask[..., 0] <= COVERED).numpy()
    rows, columns = distance_transform_edt(empty, return_distances=False, return_indices=True)
    return colours[torch.from_numpy(rows).long(), torch.from_numpy(columns).long()]


def inflated_normals(mask: Tensor) -> Tensor:
    """Camera-space normals of a mask blown up like a cushion, [H, W, 3]; a disc gives a sphere.

    The square u of the height solves laplace u = -4 with u = 0 outside: for a disc r^2 - x^2 - y^2.
    The normal is (-du/dx, -du/dy, 2 sqrt u), finite at the rim.
    """
    inside = (mask[..., 0] > COVERED).numpy()
    height, width = inside.shape
    inside = np.pad(inside, 1)
    flat = inside.ravel()
    stride = width + 2
    offsets = [0, 1, -1, stride, -stride]
    count = flat.size
    entries = [np.full(count, 4.0)] + [np.full(count - abs(o), -1.0) for o in offsets[1:]]
    matrix = diags(entries, offsets, format="csr")[flat][:, flat]
    u = np.zeros(count)
    u[flat] = spsolve(matrix.tocsc(), np.full(int(flat.sum()), 4.0))
    square = torch.from_numpy(u).view(height + 2, stride).float()
    du_dx = 0.5 * (square[1:-1, 2:] - square[1:-1, :-2])
    du_dy = 0.5 * (square[:-2, 1:-1] - square[2:, 1:-1])
    normal = torch.stack([-du_dx, -du_dy, 2.0 * square[1:-1, 1:-1].clamp(min=0.0).sqrt()], -1)
    outward = normalize(normal)
    # Edge pixels beyond the threshold take their neighbour's normal.
    return fill_outside(outward, mask)
