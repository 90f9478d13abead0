import torch

from svim3d.cameras import orbit_cameras
from svim3d.mesh.marching import extract_surface
from svim3d.raster.interpolation import barycentrics, blend_corners, interpolate
from svim3d.raster.zbuffer import rasterize


def scene(size: int = 12):
    axis = torch.linspace(-0.5, 0.5, 5)
    grid = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1)
    vertices, faces = extract_surface(0.4 - grid.norm(dim=-1), 0.5)
    cameras = orbit_cameras([(25.0, 40.0)], radius=1.5, fov_y_deg=40.0, size=size)
    clip = cameras.project(vertices)[0].double()
    return clip, faces, rasterize(clip, faces, size, size)


def test_positions_land_on_the_rays_of_their_pixels():
    axis = torch.linspace(-0.5, 0.5, 9)
    grid = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1)
    vertices, faces = extract_surface(0.4 - grid.norm(dim=-1), 0.5)
    cameras = orbit_cameras([(25.0, 40.0)], radius=1.5, fov_y_deg=40.0, size=32)
    clip = cameras.project(vertices)[0]
    pixels, positions = interpolate(clip, faces, rasterize(clip, faces, 32, 32), vertices)
    origin, direction = (part[pixels] for part in cameras.rays(0))
    offset = torch.linalg.cross(positions - origin, direction).norm(dim=1)
    assert len(pixels) > 100
    assert float(offset.max()) < 1e-6


def test_attributes_linear_in_space_are_reproduced():
    clip, faces, fragments = scene()
    clip = clip.requires_grad_(False)
    linear = clip @ torch.tensor([[1.0], [-2.0], [0.0], [0.5]], dtype=torch.float64)
    _, values = interpolate(clip, faces, fragments, torch.cat([clip, linear], 1))
    expected = values[:, :1] - 2.0 * values[:, 1:2] + 0.5 * values[:, 3:4]
    assert torch.allclose(values[:, 4:], expected, atol=1e-14)


def test_gradients_match_finite_differences():
    clip, faces, fragments = scene(6)
    attributes = torch.randn(
        len(clip), 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0)
    )
    assert torch.autograd.gradcheck(
        lambda c, a: interpolate(c, faces, fragments, a)[1],
        (clip.requires_grad_(), attributes.requires_grad_()),
    )


def test_the_plain_twin_gives_the_same_values_and_gradients():
    clip, faces, fragments = scene()
    generator = torch.Generator().manual_seed(0)
    attributes = torch.randn(len(clip), 5, dtype=torch.float64, generator=generator)
    results = []
    for plain in (False, True):
        c, a = clip.clone().requires_grad_(), attributes.clone().requires_grad_()
        if plain:
            pixels, weights = barycentrics(c, faces, fragments)
            corners = faces[fragments.triangle.reshape(-1)[pixels].long()]
            values = blend_corners(weights, corners, a)
        else:
            pixels, values = interpolate(c, faces, fragments, a)
        seen = torch.linspace(-1, 1, values.numel(), dtype=torch.float64).view_as(values)
        (values * seen).sum().backward()
        results.append((pixels, values.detach(), c.grad, a.grad))
    for fast, slow in zip(*results, strict=True):
        assert torch.allclose(fast, slow, rtol=1e-10, atol=1e-12)


def test_a_view_that_sees_nothing_gives_no_values_and_zero_gradients():
    clip, faces, _ = scene()
    away = (clip * torch.tensor([1.0, 1.0, 1.0, -1.0], dtype=torch.float64)).requires_grad_()
    fragments = rasterize(away, faces, 4, 4)
    pixels, values = interpolate(away, faces, fragments, torch.ones(len(clip), 3).double())
    values.sum().backward()
    assert values.shape == (len(pixels), 3) == (0, 3)
    assert float(away.grad.abs().sum()) == 0.0
