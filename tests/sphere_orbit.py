"""An analytic object seen from an orbit: a painted sphere, exact at every pixel."""

import torch

from svim3d.cameras import Cameras, orbit_angles, orbit_cameras
from svim3d.numerics import dot, normalize

RADIUS = 0.5


def sphere_cameras(views: int = 4, size: int = 16) -> Cameras:
    return orbit_cameras(orbit_angles(views, 10.0, 20.0), radius=2.2, fov_y_deg=33.8, size=size)


def sphere_images(cameras: Cameras) -> dict[str, torch.Tensor]:
    """The six images of an orbit; material values are exact in half precision."""
    views = [_sphere_view(cameras, view) for view in range(len(cameras))]
    return {name: torch.stack([view[name] for view in views]) for name in views[0]}


def _sphere_view(cameras: Cameras, view: int) -> dict[str, torch.Tensor]:
    origin, direction = cameras.rays(view)
    along = -dot(origin, direction)
    gap = RADIUS**2 - (dot(origin, origin) - along**2)
    hit = (gap > 0).float()
    normal = normalize(origin + (along - gap.clamp_min(0).sqrt()) * direction) * hit
    basecolor = torch.where(normal[:, :1] > 0, 0.75, 0.25) * torch.tensor([1.0, 0.5, 0.25]) * hit
    flat = {
        "radiance": basecolor * (0.5 + 0.5 * normal[:, 1:2]),
        "mask": hit,
        "basecolor": basecolor,
        "roughness": 0.5 * hit,
        "metallic": torch.where(normal[:, 1:2] > 0, 1.0, 0.0) * hit,
        "normal_world": normal,
    }
    shape = (cameras.height, cameras.width, -1)
    return {name: image.reshape(shape).half().float() for name, image in flat.items()}
