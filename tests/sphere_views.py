"""Views of a painted sphere, exact but for the noise that is asked for."""

import torch
from torch.nn import functional

from stages.artifacts import FittedField, MaterialViews
from svim3d.cameras import orbit_angles, orbit_cameras
from svim3d.fields.material_field import MaterialField, MaterialFieldSpec
from svim3d.fields.sdf_grid import node_positions
from svim3d.numerics import dot, normalize

RADIUS, HALF = 0.4, 0.55
SPEC = MaterialFieldSpec(levels=2, log2_entries=10, coarsest=4, finest=8, hidden=8)
SAMPLES = 3  # per pixel and axis
GOLD = (1.0, 0.71, 0.29, 0.3, 1.0)  # basecolor, roughness, metallic
RED_PLASTIC = (0.6, 0.05, 0.04, 0.5, 0.0)


def of_one_material(point):
    return torch.tensor(GOLD).expand(len(point), 5)


def of_two_materials(point):
    """Gold on the left, red plastic on the right."""
    left = point[:, :1] < 0.0
    return torch.where(left, torch.tensor(GOLD), torch.tensor(RED_PLASTIC))


def with_a_pattern(point):
    """All channels vary by their own waves."""
    phase = torch.tensor([0.0, 1.0, 2.0, 3.0, 4.0])
    height, side = point[:, 1:2], point[:, :1]
    return 0.5 + 0.2 * torch.sin(40.0 * height + phase) + 0.2 * torch.cos(35.0 * side - phase)


def with_a_pattern_in_colour(point):
    """Roughness and metallic are even."""
    return torch.cat([with_a_pattern(point)[:, :3], of_one_material(point)[:, 3:]], 1)


def sphere_views(paint, *, views=8, size=64, noise=0.0, blur_px=0.0):
    """`paint` gives basecolor, roughness and metallic of points; noise is added to each view.

    With `blur_px` the noise is smooth, at the same strength.
    """
    cameras = orbit_cameras(orbit_angles(views, 0.0, 20.0), radius=2.2, fov_y_deg=33.8, size=size)
    images = []
    for view in range(views):
        origin, ray = cameras.resized(size * SAMPLES, size * SAMPLES).rays(view)
        along = -dot(origin, ray)
        gap = RADIUS**2 - (dot(origin, origin) - along**2)
        point = origin + (along - gap.clamp_min(0).sqrt()) * ray
        hit = (gap > 0).float()
        image = hit * torch.cat([paint(point), normalize(point), torch.ones_like(hit)], 1)
        images.append(image.view(size, SAMPLES, size, SAMPLES, 9).mean((1, 3)))
    values, mask = torch.stack(images).split([8, 1], -1)
    straight = values / mask.clamp_min(1e-3)
    materials = (straight[..., :5] + noise * smooth_noise(views, size, blur_px)).clamp(0.0, 1.0)
    materials = materials * (mask > 0)
    return MaterialViews(
        cameras=cameras,
        radiance=materials[..., :3] * mask,
        mask=mask,
        basecolor=materials[..., :3],
        roughness=materials[..., 3:4],
        metallic=materials[..., 4:5],
        normal_world=normalize(straight[..., 5:8]) * (mask > 0),
        reference=views - 1,
    )


def smooth_noise(views, size, blur_px):
    """Unit noise [V, H, W, 5], independent between views and channels."""
    generator = torch.Generator().manual_seed(3)
    noise = torch.randn(views * 5, 1, size, size, generator=generator)
    if blur_px:
        reach = round(3 * blur_px)
        window = torch.exp(-0.5 * (torch.arange(-reach, reach + 1) / blur_px) ** 2)
        for shape in ((1, 1, -1, 1), (1, 1, 1, -1)):
            padding = [reach if n == -1 else 0 for n in shape[2:]]
            noise = functional.conv2d(noise, window.view(shape), padding=padding)
        noise = noise / noise.std()
    return noise.view(views, 5, size, size).permute(0, 2, 3, 1)


def grey_sphere(nodes=32):
    """A fitted field whose surface is the sphere, and whose materials are nearly even."""
    field = MaterialField(SPEC)
    field.reset(torch.Generator().manual_seed(0))
    sdf = RADIUS - node_positions(nodes, HALF, like=torch.zeros(1)).norm(dim=-1)
    return FittedField(sdf, HALF, SPEC, field.state_dict(), torch.ones(8, 8, 3))
