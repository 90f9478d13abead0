"""Geometry buffers of scenes with a formula: each ray's nearest hit, one camera."""

import math

import torch
from torch import Tensor

from svim3d.cameras import Cameras, look_at_origin
from svim3d.numerics import normalize
from svim3d.render.gbuffer import GBuffer
from svim3d.shading.octahedral import texel_directions
from svim3d.shading.prefilter import EnvironmentPyramid, PyramidOperator

LIGHT_SIZE = 32


def camera(size: int, elevation_deg: float = 40.0, azimuth_deg: float = 0.0) -> Cameras:
    pose = look_at_origin(elevation_deg, azimuth_deg, 3.0)[None]
    return Cameras(pose, 30.0, size, size)


def buffer_of(
    cameras: Cameras, surfaces: list[tuple[Tensor, Tensor]], **material: float
) -> GBuffer:
    """From (distance along each ray, normal) of every surface; infinite where a ray misses it."""
    size = cameras.height
    distance = torch.stack([s[0] for s in surfaces])
    nearest, which = distance.min(0)
    normal = torch.stack([s[1] for s in surfaces])[which, torch.arange(size * size)]
    hit = nearest.isfinite()
    _, direction = cameras.rays(0)
    along = -(direction @ cameras.c2w[0, :3, 2])
    depth = torch.where(hit, nearest * along, 0.0)
    flat = torch.ones(size * size, 1)
    images = {
        "mask": hit.float()[:, None],
        "basecolor": flat.expand(-1, 3) * material.get("basecolor", 0.5),
        "roughness": flat * material.get("roughness", 0.5),
        "metallic": flat * material.get("metallic", 0.0),
        "normal_world": torch.where(hit[:, None], normal, 0.0),
        "depth": depth[:, None],
    }
    shaped = {k: v.reshape(1, size, size, -1).contiguous() for k, v in images.items()}
    return GBuffer.of(cameras, shaped)


def plane(
    cameras: Cameras, normal: tuple[float, float, float], offset: float, half: float
) -> tuple[Tensor, Tensor]:
    """Square-ish patch of the plane n.x = offset: points within `half` of the origin by axis."""
    origin, direction = cameras.rays(0)
    n = normalize(torch.tensor(normal))
    t = (offset - origin @ n) / (direction @ n)
    inside = (t > 0) & ((origin + t[:, None] * direction).abs().amax(-1) <= half)
    facing = (direction @ n) < 0
    return torch.where(inside & facing, t, math.inf), n.expand_as(direction)


def sphere(cameras: Cameras, centre: tuple[float, float, float], radius: float):
    origin, direction = cameras.rays(0)
    to = origin - torch.tensor(centre)
    b = (to * direction).sum(-1)
    root = b * b - (to * to).sum(-1) + radius * radius
    t = torch.where(root > 0, -b - root.clamp_min(0.0).sqrt(), math.inf)
    point = origin + torch.where(t.isfinite(), t, 0.0)[:, None] * direction
    return t, normalize(point - torch.tensor(centre))


def uniform_light(radiance: float = 1.0) -> EnvironmentPyramid:
    return PyramidOperator.build(LIGHT_SIZE)(torch.full((LIGHT_SIZE, LIGHT_SIZE, 3), radiance))


def lamp(direction: tuple[float, float, float], cosine: float) -> Tensor:
    """A map that is black but for a cap about a direction."""
    towards = texel_directions(LIGHT_SIZE) @ normalize(torch.tensor(direction))
    return (towards > cosine).float()[..., None].expand(-1, -1, 3) * 10.0
