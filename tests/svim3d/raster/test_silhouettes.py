import pytest
import torch
from torch.nn.functional import avg_pool2d

from svim3d.cameras import orbit_cameras
from svim3d.mesh.marching import extract_surface
from svim3d.mesh.mesh import face_adjacency
from svim3d.raster.interpolation import interpolate
from svim3d.raster.silhouettes import antialias, find_edge_pairs, walk_edges
from svim3d.raster.zbuffer import rasterize

SIZE, OVERSAMPLING, STEP = 96, 8, 3e-3


def extracted(distance, nodes: int):
    axis = torch.linspace(-0.5, 0.5, nodes)
    grid = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1)
    return extract_surface(distance(grid), 0.5)


def sphere(nodes: int = 17):
    return extracted(lambda p: 0.3 - p.norm(dim=-1), nodes)


def torus(nodes: int = 33):
    return extracted(
        lambda p: 0.1 - torch.hypot(torch.hypot(p[..., 0], p[..., 1]) - 0.28, p[..., 2]), nodes
    )


def box():
    corners = torch.tensor([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * 0.2
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [f for a, b, c, d in quads for f in ((a, b, c), (a, c, d))]
    return corners, torch.tensor(faces, dtype=torch.int32)


def render(vertices, faces, color, size: int, *, smooth: bool) -> torch.Tensor:
    cameras = orbit_cameras([(20.0, 30.0)], radius=2.0, fov_y_deg=33.8, size=size)
    clip = cameras.project(vertices)[0]
    fragments = rasterize(clip, faces, size, size)
    pixels, values = interpolate(clip, faces, fragments, color)
    image = torch.zeros(size * size, 3).index_copy(0, pixels, values).view(size, size, 3)
    if smooth:
        image = antialias(image, clip, faces, fragments, face_adjacency(faces))
    return image


def loss(image: torch.Tensor) -> torch.Tensor:
    y, x = torch.meshgrid(*[(torch.arange(SIZE) + 0.5) / SIZE] * 2, indexing="ij")
    target = torch.stack(
        [0.5 + 0.5 * torch.sin(6 * x), 0.5 + 0.5 * torch.cos(5 * y), 0.3 + 0 * x], -1
    )
    return (image - target).square().sum()


def reference(vertices, faces, color) -> float:
    fine = render(vertices, faces, color, SIZE * OVERSAMPLING, smooth=False)
    coarse = avg_pool2d(fine.permute(2, 0, 1)[None], OVERSAMPLING)[0].permute(1, 2, 0)
    return float(loss(coarse))


def deformations(vertices) -> list[torch.Tensor]:
    """Three translations, a scaling, and two smooth random fields."""
    generator = torch.Generator().manual_seed(0)
    waves = [
        torch.sin(vertices @ (6 * torch.randn(3, 3, generator=generator)) + phase)
        for phase in (0.0, 1.0)
    ]
    return [*torch.eye(3)[:, None].expand(3, len(vertices), 3), vertices, *waves]


@pytest.mark.parametrize("mesh", [sphere, torus, box])
def test_the_gradient_follows_finite_differences_of_a_supersampled_picture(mesh):
    vertices, faces = mesh()
    color = 0.6 + 0.3 * torch.sin(4.0 * vertices + torch.tensor([0.0, 1.0, 2.0]))
    moving = vertices.clone().requires_grad_()
    loss(render(moving, faces, color, SIZE, smooth=True)).backward()
    directions = deformations(vertices)
    ours = torch.tensor([float((moving.grad * d).sum()) for d in directions])
    truth = torch.tensor(
        [
            (
                reference(vertices + STEP * d, faces, color)
                - reference(vertices - STEP * d, faces, color)
            )
            / (2 * STEP)
            for d in directions
        ]
    )
    cosine = float(ours @ truth / (ours.norm() * truth.norm()))
    assert cosine >= 0.97
    assert 0.75 < float(ours.norm() / truth.norm()) < 1.25  # counting both axes fully gives 2


def test_the_covered_area_moves_smoothly_with_the_object():
    vertices, faces = sphere(33)
    adjacency = face_adjacency(faces)
    cameras = orbit_cameras([(0.0, 0.0)], radius=2.0, fov_y_deg=33.8, size=SIZE)
    for shift_px in (0.0, 0.25, 0.5, 0.75):
        moved = vertices + torch.tensor([shift_px * 2.0 / cameras.focal_px, 0.0, 0.0])
        clip = cameras.project(moved)[0]
        fragments = rasterize(clip, faces, SIZE, SIZE)
        mask = (fragments.triangle >= 0).float()[..., None]
        area = float(antialias(mask, clip, faces, fragments, adjacency).sum())
        fine = rasterize(clip, faces, 16 * SIZE, 16 * SIZE)
        assert area == pytest.approx(len(fine.pixels) / 16**2, rel=1e-3)


def test_half_covered_pixels_of_a_straight_edge_are_exact():
    # A square whose right side runs 0.3 pixels into column 6 of 8, its left side 0.1 into column 2.
    left, right, top, bottom = -1 + 2 * 2.9 / 8, -1 + 2 * 6.3 / 8, 1.0, -1.0
    clip = torch.tensor(
        [
            [left, 2 * bottom, 0, 1],
            [right, 2 * bottom, 0, 1],
            [right, 2 * top, 0, 1],
            [left, 2 * top, 0, 1],
        ]
    )
    faces = torch.tensor([[0, 1, 2], [0, 2, 3]])
    fragments = rasterize(clip, faces, 8, 8)
    mask = (fragments.triangle >= 0).float()[..., None]
    smooth = antialias(mask, clip, faces, fragments, face_adjacency(faces))[..., 0]
    expected = torch.tensor([0, 0, 0.1, 1, 1, 1, 0.3, 0])
    assert torch.allclose(smooth, expected.expand(8, 8), atol=1e-6)


@pytest.mark.parametrize("mesh", [sphere, torus, box])
def test_the_torch_twin_finds_the_same_pairs_in_the_same_order(mesh):
    vertices, faces = mesh()
    adjacency = face_adjacency(faces)
    found = 0
    for radius in (2.0, 0.5):  # from outside; and with parts behind the camera
        cameras = orbit_cameras([(20.0, 30.0)], radius=radius, fov_y_deg=33.8, size=64)
        clip = cameras.project(vertices)[0]
        fragments = rasterize(clip, faces, 64, 64)
        fast = find_edge_pairs(clip, faces, fragments, adjacency)
        plain = walk_edges(clip, faces, fragments, adjacency)
        found += len(fast.near)
        for name in ("near", "far", "edge", "axis"):
            assert torch.equal(getattr(fast, name), getattr(plain, name))
    assert found > 100


def test_an_image_without_silhouettes_is_returned_as_it_is():
    clip = torch.tensor([[-9.0, -9, 0, 1], [9, -9, 0, 1], [0, 9, 0, 1]])
    faces = torch.tensor([[0, 1, 2]])
    image = torch.rand(4, 4, 3, generator=torch.Generator().manual_seed(0))
    fragments = rasterize(clip, faces, 4, 4)
    assert torch.equal(antialias(image, clip, faces, fragments, face_adjacency(faces)), image)
