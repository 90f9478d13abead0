import pytest
import torch

from svim3d.fields.sdf_grid import node_positions
from svim3d.render.occlusion import ambient_occlusion, cosine_directions

HALF = 0.55


def test_directions_are_unit_and_cosine_distributed():
    d = cosine_directions(1000)
    assert torch.allclose(d.norm(dim=1), torch.ones(1000), atol=1e-6)
    # Mean of cos over a cosine-weighted hemisphere is 2/3; of the horizontal components 0.
    assert d.mean(0).tolist() == pytest.approx([0, 0, 2 / 3], abs=1e-3)


def test_a_convex_body_sees_the_whole_sky():
    points = node_positions(64, HALF, like=torch.zeros(1))
    sdf = 0.3 - points.norm(dim=-1)
    normal = torch.nn.functional.normalize(
        torch.randn(200, 3, generator=torch.Generator().manual_seed(0)), dim=1
    )
    open_sky = ambient_occlusion(0.3 * normal, normal, sdf, half_extent=HALF, rays=64)
    assert open_sky.min() == 1


def test_points_a_little_below_a_convex_surface_see_the_whole_sky():
    points = node_positions(64, HALF, like=torch.zeros(1))
    sdf = 0.3 - points.norm(dim=-1)
    normal = torch.nn.functional.normalize(
        torch.randn(200, 3, generator=torch.Generator().manual_seed(0)), dim=1
    )
    cell = 2 * HALF / 63
    sunken = (0.3 - 0.4 * cell) * normal  # as far as the middle of a coarse mesh's edge
    open_sky = ambient_occlusion(sunken, normal, sdf, half_extent=HALF, rays=64)
    assert open_sky.min() > 0.98


def test_the_foot_of_a_wall_sees_half_of_it():
    # Floor y < -0.3 and wall x < -0.3: at the wall's foot all directions with x < 0 are blocked,
    # as far as the grid reaches.
    points = node_positions(96, HALF, like=torch.zeros(1))
    sdf = torch.maximum(-0.3 - points[..., 1], -0.3 - points[..., 0])
    up = torch.tensor([[0.0, 1, 0]])
    near = torch.tensor([[-0.28, -0.3, 0.0]])
    found = ambient_occlusion(near, up, sdf, half_extent=HALF, rays=2000)
    # Form factor of an infinitely long wall of height h from a floor point at distance d:
    # (1 - d / sqrt(d^2 + h^2)) / 2, that is (1 - cosine of the wall's elevation seen from there)
    # / 2; so d -> 0 gives one half.
    d, h = 0.02, HALF + 0.3
    expected = 1 - (1 - d / (d * d + h * h) ** 0.5) / 2
    assert float(found) == pytest.approx(expected, abs=0.03)


def test_points_next_to_the_border_of_the_grid_are_safe():
    sdf = torch.full((8, 8, 8), -1.0)
    corner = torch.tensor([[HALF, HALF, HALF], [-HALF, 0, 9.0]])
    normal = torch.tensor([[1.0, 0, 0], [0, 0, -1.0]])
    assert ambient_occlusion(corner, normal, sdf, half_extent=HALF, rays=16).min() == 1
