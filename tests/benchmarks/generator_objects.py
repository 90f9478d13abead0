"""Objects whose views from all around are known in closed form."""

import torch

from benchmarks.generator_views import Case, Views, over_white
from benchmarks.generator_warp import Ellipsoid
from svim3d.cameras import orbit_angles, orbit_cameras
from svim3d.numerics import dot, normalize

SIZE, FOV_DEG, RADIUS, SAMPLES = 48, 33.8, 2.9, 2


def body_views(body, paint, angles):
    """An ellipsoid whose colour is a function of the point on the unit sphere, [P, 3]."""
    cameras = orbit_cameras(angles, radius=RADIUS, fov_y_deg=FOV_DEG, size=SIZE * SAMPLES)
    planes = []
    for view in range(len(angles)):
        origin, direction = cameras.rays(view)
        o, d = (origin - body.centre) / body.half_axes, direction / body.half_axes
        a, b, c = dot(d, d), dot(o, d), dot(o, o) - 1.0
        root = b * b - a * c
        point = normalize(o + (-b - root.clamp(min=0.0).sqrt()) / a * d)
        hit = (root > 0.0).float()
        normal = normalize(point / body.half_axes) @ cameras.c2w[view, :3, :3]
        flat = torch.cat([paint(point) * hit, normal * hit, hit], 1)
        blocks = flat.view(SIZE, SAMPLES, SIZE, SAMPLES, 7)
        planes.append(blocks.mean((1, 3)))
    colour, normal, mask = torch.stack(planes).split([3, 3, 1], -1)
    shown = over_white(colour / mask.clamp(min=1e-6), mask)
    normal = normalize(normal) * (mask > 0)
    return Views(shown, shown, 0.4 * torch.ones_like(mask), torch.zeros_like(mask), normal, mask)


def body_case(body, paint, *, elevation_deg=10.0, swing_deg=0.0):
    angles = orbit_angles(21, elevation_deg, swing_deg)
    truth = body_views(body, paint, angles)
    elevation, azimuth = torch.tensor(angles).unbind(-1)
    return Case("body", truth.rgb[-1], truth.mask[-1], elevation, azimuth, FOV_DEG, truth)


def ball(radius=0.6):
    return Ellipsoid(torch.zeros(3), torch.full((3,), radius))


def plain(point):
    return torch.tensor([0.2, 0.5, 0.7]).expand(len(point), 3)


def mirrored_waves(point):
    """Smooth, and equal in front (+z) and behind."""
    x, y, _ = point.unbind(-1)
    return torch.stack([0.5 + 0.3 * (4 * x).sin(), 0.5 + 0.3 * (5 * y).cos(), 0.5 + 0.2 * x * y], 1)


def one_sided(point):
    """Another colour at every azimuth."""
    x, _, z = point.unbind(-1)
    return torch.stack([0.5 + 0.4 * x, 0.5 + 0.4 * z, torch.full_like(x, 0.3)], 1)
