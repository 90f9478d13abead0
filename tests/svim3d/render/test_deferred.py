"""Renders of a sphere, a textured quad and a mirrored one, against closed forms."""

import math
from dataclasses import replace

import pytest
import torch

from svim3d.cameras import orbit_cameras
from svim3d.fields.material_field import Materials
from svim3d.mesh.marching import extract_surface
from svim3d.numerics import normalize
from svim3d.render.deferred import (
    Geometry,
    TextureMaterials,
    environment_shader,
    render_mesh,
    vertex_materials,
)
from svim3d.shading.prefilter import PyramidOperator

RADIUS, DISTANCE, SIZE = 0.4, 2.2, 48


def position_materials(points) -> Materials:
    return Materials(
        basecolor=points.position * 0.5 + 0.5,
        roughness=points.position[:, :1] * 0.5 + 0.5,
        metallic=points.position[:, 1:2] * 0.5 + 0.5,
        bump=torch.zeros_like(points.normal),
    )


@pytest.fixture(scope="module")
def sphere() -> Geometry:
    axis = torch.linspace(-0.5, 0.5, 41)
    grid = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1)
    vertices, faces = extract_surface(RADIUS - grid.norm(dim=-1), 0.5)
    vertices = RADIUS * normalize(vertices)
    return replace(Geometry.smooth(vertices, faces, silhouettes=True), normals=normalize(vertices))


@pytest.fixture(scope="module")
def cameras():
    return orbit_cameras([(20.0, 30.0), (-10.0, 200.0)], radius=DISTANCE, fov_y_deg=33.8, size=SIZE)


def exact_sphere(cameras, view: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Hit positions, depth along -z, and which pixel centres hit, [H, W, ...]."""
    origin, direction = cameras.rays(view)
    along = (origin * direction).sum(-1)
    gap = along**2 - origin.square().sum(-1) + RADIUS**2
    position = origin + (-along - gap.clamp_min(0).sqrt())[:, None] * direction
    depth = (position - origin) @ -cameras.c2w[view, :3, 2]
    return position.view(SIZE, SIZE, 3), depth.view(SIZE, SIZE), (gap > 0).view(SIZE, SIZE)


@pytest.mark.parametrize("view", [0, 1])
def test_depth_normal_and_materials_of_a_sphere_match_closed_forms(sphere, cameras, view: int):
    rendered = render_mesh(replace(sphere, adjacency=None), position_materials, cameras, view=view)
    position, depth, hit = exact_sphere(cameras, view)
    inner = hit & (rendered.mask[..., 0] == 1)
    facing = (normalize(position) * normalize(cameras.positions[view] - position)).sum(-1)
    inner &= facing > 0.3  # at the rim a chord leaves the sphere by many times its sagitta
    assert int(inner.sum()) > 500
    assert float((rendered.depth[..., 0] - depth)[inner].abs().max()) < 2e-3
    cosine = (rendered.normal_world * normalize(position)).sum(-1)[inner]
    assert float(cosine.min()) > math.cos(math.radians(0.5))
    truth = position * 0.5 + 0.5
    assert float((rendered.basecolor - truth)[inner].abs().max()) < 1e-3
    assert float((rendered.roughness - truth[..., :1])[inner].abs().max()) < 1e-3
    assert float((rendered.metallic - truth[..., 1:2])[inner].abs().max()) < 1e-3


@pytest.mark.parametrize("mode", ["walk", "supersampled"])
def test_the_covered_area_is_that_of_the_projected_sphere(sphere, cameras, mode: str):
    if mode == "walk":
        rendered = render_mesh(sphere, position_materials, cameras, view=0)
    else:
        flat = replace(sphere, adjacency=None)
        rendered = render_mesh(flat, position_materials, cameras, view=0, supersample=4)
    radius_px = cameras.focal_px * math.tan(math.asin(RADIUS / DISTANCE))
    assert float(rendered.mask.sum()) == pytest.approx(math.pi * radius_px**2, rel=5e-3)
    partial = (rendered.mask > 0) & (rendered.mask < 1)
    assert int(partial.sum()) > 50


def test_images_are_premultiplied_and_straight_divides_again(sphere, cameras):
    def constant(points) -> Materials:
        one = torch.ones_like(points.facing)
        color = one * torch.tensor([0.8, 0.4, 0.2])
        return Materials(color, 0.5 * one, 0.25 * one, torch.zeros_like(points.normal))

    flat = replace(sphere, adjacency=None)
    rendered = render_mesh(flat, constant, cameras, view=0, supersample=3)
    color = torch.tensor([0.8, 0.4, 0.2])
    assert torch.allclose(rendered.basecolor, rendered.mask * color, atol=1e-6)
    straight = rendered.straight()
    covered = rendered.mask[..., 0] > 0
    assert torch.allclose(straight.basecolor[covered], color.expand(int(covered.sum()), 3))
    assert torch.allclose(straight.normal_world[covered].norm(dim=-1), torch.tensor(1.0))
    assert float(straight.basecolor[~covered].abs().max()) == 0.0


def test_a_white_furnace_returns_the_light(sphere, cameras):
    def white(points) -> Materials:
        one = torch.ones_like(points.facing)
        return Materials(one.expand(-1, 3), 0.6 * one, one, torch.zeros_like(points.normal))

    pyramid = PyramidOperator.build(16)(torch.full((16, 16, 3), 0.7))
    rendered = render_mesh(sphere, white, cameras, view=0, shader=environment_shader(pyramid))
    assert torch.allclose(rendered.radiance, 0.7 * rendered.mask.expand(-1, -1, 3), atol=5e-3)


def test_the_picture_of_a_plain_colour_has_the_gradient_of_its_area(sphere, cameras):
    scale = torch.ones((), requires_grad=True)
    moving = replace(sphere, vertices=sphere.vertices * scale)
    render_mesh(moving, position_materials, cameras, view=0).mask.sum().backward()
    # d/ds of pi (f tan asin(s r / D))^2 at s = 1.
    sine = RADIUS / DISTANCE
    expected = 2 * math.pi * cameras.focal_px**2 * sine**2 / (1 - sine**2) ** 2
    assert float(scale.grad) == pytest.approx(expected, rel=0.03)


def quad(uv: list[list[float]]) -> Geometry:
    """A unit square in the plane z = 0, seen from +z, with normal +z and tangent +x."""
    corners = torch.tensor([[-0.5, -0.5, 0], [0.5, -0.5, 0], [0.5, 0.5, 0], [-0.5, 0.5, 0]])
    tangent = torch.tensor([1.0, 0.0, 0.0, 1.0]).expand(4, 4)
    return Geometry(
        vertices=corners,
        faces=torch.tensor([[0, 1, 2], [0, 2, 3]], dtype=torch.int32),
        normals=torch.tensor([0.0, 0.0, 1.0]).expand(4, 3),
        attributes=torch.cat([torch.tensor(uv), tangent], 1),
        two_sided=True,
    )


GLTF_UV = [[0.0, 1.0], [1.0, 1.0], [1.0, 0.0], [0.0, 0.0]]  # v grows downwards


def test_a_textured_quad_shows_its_texture_upright():
    # A camera whose field of view is just the quad: pixel centres meet texel centres.
    texture = torch.rand(8, 8, 3, generator=torch.Generator().manual_seed(0))
    fov = 2 * math.degrees(math.atan(0.5 / 2.0))
    camera = orbit_cameras([(0.0, 0.0)], radius=2.0, fov_y_deg=fov, size=8)
    orm = texture.flip(0)
    rendered = render_mesh(quad(GLTF_UV), TextureMaterials(texture, orm), camera, view=0)
    assert torch.allclose(rendered.basecolor, texture, atol=1e-5)
    assert torch.allclose(rendered.roughness, orm[..., 1:2], atol=1e-5)
    assert torch.allclose(rendered.metallic, orm[..., 2:], atol=1e-5)
    assert torch.allclose(rendered.depth, torch.tensor(2.0), atol=1e-5)


@pytest.mark.parametrize(("azimuth_deg", "side"), [(0.0, 1.0), (180.0, -1.0)])
def test_a_normal_map_tilts_towards_tangent_and_green_up_on_either_side(azimuth_deg, side):
    tilt = normalize(torch.tensor([0.3, 0.2, 0.9]))
    maps = TextureMaterials(
        torch.ones(2, 2, 3), torch.ones(2, 2, 3), normal_tangent=tilt.expand(2, 2, 3)
    )
    camera = orbit_cameras([(0.0, azimuth_deg)], radius=2.0, fov_y_deg=20.0, size=4)
    rendered = render_mesh(quad(GLTF_UV), maps, camera, view=0)
    # Tangent +x, bitangent +y, normal +z; the whole frame turns for the back.
    assert torch.allclose(rendered.normal_world, (side * tilt).expand(4, 4, 3), atol=1e-5)


def test_a_one_sided_quad_is_not_seen_from_behind():
    camera = orbit_cameras([(0.0, 180.0)], radius=2.0, fov_y_deg=20.0, size=4)
    hidden = replace(quad(GLTF_UV), two_sided=False)
    materials = TextureMaterials(torch.ones(2, 2, 3), torch.ones(2, 2, 3))
    assert float(render_mesh(hidden, materials, camera, view=0).mask.sum()) == 0.0


def test_vertex_colours_are_interpolated():
    colored = replace(
        quad(GLTF_UV),
        attributes=torch.tensor([[0, 0, 0, 1, 0.0, 1.0], [1, 0, 0, 1, 1, 1]] * 2)[[0, 1, 1, 0]],
    )
    camera = orbit_cameras([(0.0, 0.0)], radius=2.0, fov_y_deg=10.0, size=4)
    rendered = render_mesh(colored, vertex_materials, camera, view=0)
    x = (torch.arange(4) + 0.5 - 2) / camera.focal_px * 2.0 + 0.5
    assert torch.allclose(rendered.basecolor[..., 0], x.expand(4, 4), atol=1e-5)
    assert torch.allclose(rendered.roughness[..., 0], x.expand(4, 4), atol=1e-5)
    assert torch.allclose(rendered.metallic, torch.tensor(1.0))


def test_supersampling_and_the_edge_walk_exclude_each_other(sphere, cameras):
    with pytest.raises(ValueError, match="supersampling or by the edge walk"):
        render_mesh(sphere, position_materials, cameras, view=0, supersample=2)
