"""The path tracer against our rasteriser where both must agree: convex objects, no shadows."""

import math

import pytest
import torch

from svim3d.cameras import orbit_cameras
from svim3d.mesh.source_mesh import SourceMaterial, SourceMesh, complete
from svim3d.render.deferred import environment_shader
from svim3d.render.path_tracing import render_path_traced
from svim3d.render.pictures import render_pictures
from svim3d.shading.environment import (
    direction_from_latlong,
    octahedral_from_latlong,
    rotate_about_y,
)
from svim3d.shading.prefilter import PyramidOperator

pytest.importorskip("mitsuba", reason="the extra svim3d[path] is not installed")
ROWS, COLUMNS = 48, 96


def sphere(material: SourceMaterial, radius: float = 0.5) -> SourceMesh:
    """A lat-long sphere with smooth normals; u runs around, v down."""
    v, u = torch.meshgrid(
        torch.linspace(0.0, 1.0, ROWS + 1), torch.linspace(0.0, 1.0, COLUMNS + 1), indexing="ij"
    )
    uv = torch.stack([u, v], -1).view(-1, 2)
    normals = direction_from_latlong(uv)
    row, column = torch.meshgrid(torch.arange(ROWS), torch.arange(COLUMNS), indexing="ij")
    a = (row * (COLUMNS + 1) + column).reshape(-1)
    b, c, d = a + 1, a + COLUMNS + 1, a + COLUMNS + 2
    faces = torch.cat([torch.stack([a, b, c], 1), torch.stack([b, d, c], 1)])
    centre = normals[faces].mean(1)
    e1, e2 = (normals[faces[:, i]] - normals[faces[:, 0]] for i in (1, 2))
    outward = (torch.linalg.cross(e1, e2) * centre).sum(1) > 0
    faces = torch.where(outward[:, None], faces, faces[:, [0, 2, 1]]).int()
    return complete(
        radius * normals, faces, material=0, materials=(material,), normals=normals, uv=uv
    )


def light(height: int = 32) -> torch.Tensor:
    """A soft sky, a broad warm lamp on +x, a weak one on +z."""
    v, u = torch.meshgrid(
        (torch.arange(height) + 0.5) / height,
        (torch.arange(2 * height) + 0.5) / (2 * height),
        indexing="ij",
    )
    d = direction_from_latlong(torch.stack([u, v], -1))
    sky = 0.3 + 0.2 * d[..., 1:2]
    lamp = torch.exp(4.0 * (d[..., :1] - 1.0)) * torch.tensor([3.0, 2.0, 1.0])
    return sky + lamp + 0.5 * torch.exp(4.0 * (d[..., 2:] - 1.0))


def both(mesh: SourceMesh, latlong: torch.Tensor, samples: int = 256):
    cameras = orbit_cameras([(15.0, 30.0)], radius=2.2, fov_y_deg=33.8, size=24)
    traced = render_path_traced(mesh, cameras, latlong, samples=samples, seed=0)
    pyramid = PyramidOperator.build(64, "exact")(octahedral_from_latlong(latlong, 64))
    shader = environment_shader(pyramid, multiple_scattering=False)
    ours = render_pictures(mesh, cameras, shader, supersample=4)
    return traced, ours


def checker() -> torch.Tensor:
    squares = (torch.arange(8)[:, None] + torch.arange(16)) % 2
    return torch.stack([0.2 + 0.6 * squares, 0.5 - 0.2 * squares, 0.3 + 0.0 * squares], -1)


def bumps() -> torch.Tensor:
    """A normal map that leans along u in one half and along v in the other."""
    normal = torch.zeros(8, 16, 3)
    normal[..., 2] = math.cos(0.2)
    normal[:, :8, 0] = normal[:, 8:, 1] = math.sin(0.2)
    return normal


@pytest.mark.parametrize(
    ("material", "tolerance"),
    [
        # Noise is 2 %; the rest is the split sum's, which is larger the rougher the metal.
        (SourceMaterial((0.9, 0.6, 0.3), 0.3, 1.0), 0.03),
        (SourceMaterial(roughness_factor=0.6, metallic_factor=1.0, basecolor=checker()), 0.08),
        (SourceMaterial((0.7, 0.7, 0.7), 0.4, 1.0, normal_tangent=bumps()), 0.05),
        # Mitsuba's base has glTF's albedo, but another spread over angles: 2 % at this roughness.
        (SourceMaterial((0.5, 0.4, 0.3), 0.5, 0.0), 0.04),
    ],
    ids=["metal", "texture", "bumps", "plastic"],
)
def test_both_engines_agree_on_a_convex_object(material, tolerance):
    traced, ours = both(sphere(material), light())
    # Four standard deviations of 256 coin tosses.
    torch.testing.assert_close(traced["mask"], ours["mask"], rtol=0, atol=0.125)
    assert relative_difference(traced["radiance"], ours) < tolerance


@pytest.mark.parametrize("roughness", [0.0, 0.3, 1.0])
def test_dielectrics_reflect_the_same_share_of_even_light(roughness):
    # The mean over a far sphere's disc is the mean over all directions, weighted by the cosine.
    mesh = sphere(SourceMaterial((0.5, 0.5, 0.5), roughness, 0.0))
    cameras = orbit_cameras([(15.0, 30.0)], radius=40.0, fov_y_deg=1.6, size=24)
    even = torch.ones(8, 16, 3)
    traced = render_path_traced(mesh, cameras, even, samples=256, seed=0)
    pyramid = PyramidOperator.build(64, "exact")(octahedral_from_latlong(even, 64))
    shader = environment_shader(pyramid, multiple_scattering=False)
    ours = render_pictures(mesh, cameras, shader, supersample=4)
    # Noise is 0.1 %; then there are Schlick's reflectance and 48 flat rings.
    assert float(traced["radiance"].mean() / ours["radiance"].mean()) == pytest.approx(1, abs=0.01)


def test_normal_maps_lean_the_same_way():
    plain, leaning = (
        sphere(SourceMaterial((0.7, 0.7, 0.7), 0.4, 1.0, normal_tangent=normal))
        for normal in (None, bumps())
    )
    _, ours = both(plain, light(), samples=1)
    traced, _ = both(leaning, light(), samples=64)
    assert relative_difference(traced["radiance"], ours) > 0.15


def relative_difference(radiance, picture) -> float:
    covered = (picture["mask"] > 0.99).expand(-1, -1, -1, 3)
    difference = (radiance - picture["radiance"]).abs()[covered]
    return float(difference.mean() / picture["radiance"][covered].mean())


def test_turned_lights_agree():
    latlong = light()
    mesh = sphere(SourceMaterial((1.0, 1.0, 1.0), 0.3, 1.0))
    cameras = orbit_cameras([(0.0, 0.0)], radius=2.2, fov_y_deg=33.8, size=16)
    octahedral = rotate_about_y(octahedral_from_latlong(latlong, 64), 90.0)
    shader = environment_shader(
        PyramidOperator.build(64, "exact")(octahedral), multiple_scattering=False
    )
    ours = render_pictures(mesh, cameras, shader, supersample=2)
    # Counter-clockwise seen from above moves what shone from +x (u = 0.75) to -z (u = 0.5).
    turned = latlong.roll(-latlong.shape[1] // 4, 1)
    for latlong_now, is_turned in ((turned, True), (latlong, False)):
        traced = render_path_traced(mesh, cameras, latlong_now, samples=128, seed=0)
        difference = relative_difference(traced["radiance"], ours)
        assert difference < 0.05 if is_turned else difference > 0.3


def test_equal_seeds_give_equal_pictures():
    mesh = sphere(SourceMaterial((0.8, 0.8, 0.8), 1.0, 0.0))
    cameras = orbit_cameras([(0.0, 0.0)], radius=2.2, fov_y_deg=33.8, size=12)
    first, again, other = (
        render_path_traced(mesh, cameras, light(), samples=8, seed=seed)["radiance"]
        for seed in (1, 1, 2)
    )
    assert torch.equal(first, again)
    assert not torch.equal(first, other)


def test_vertex_colours_multiply_the_factor():
    mesh = sphere(SourceMaterial((0.8, 0.8, 0.8), 0.5, 0.0))
    mesh.colors[:] = torch.tensor([0.5, 0.75, 1.0])
    same = sphere(SourceMaterial((0.4, 0.6, 0.8), 0.5, 0.0))
    cameras = orbit_cameras([(0.0, 0.0)], radius=2.2, fov_y_deg=33.8, size=12)
    coloured, plain = (
        render_path_traced(m, cameras, light(), samples=4, seed=0)["radiance"] for m in (mesh, same)
    )
    torch.testing.assert_close(coloured, plain)


def test_textures_of_two_sizes_belong_together():
    # The rough half's basecolor is scaled by 4 % more, whichever texture is the finer one.
    surface = torch.zeros(8, 16, 2)
    surface[:, 8:, 0] = 1.0
    coarse, fine = (
        SourceMaterial(basecolor=torch.full((size, 2 * size, 3), 0.5), roughness_metallic=surface)
        for size in (4, 8)
    )
    cameras = orbit_cameras([(0.0, 0.0)], radius=2.2, fov_y_deg=33.8, size=12)
    first, second = (
        render_path_traced(sphere(material), cameras, light(), samples=16, seed=0)["radiance"]
        for material in (coarse, fine)
    )
    assert float((first - second).abs().mean() / second.mean()) < 0.004


def test_coloured_texture_is_refused():
    mesh = sphere(SourceMaterial(basecolor=checker()))
    mesh.colors[:] = 0.5
    cameras = orbit_cameras([(0.0, 0.0)], radius=2.2, fov_y_deg=33.8, size=8)
    with pytest.raises(ValueError, match="textures or vertex colours, not their product"):
        render_path_traced(mesh, cameras, light(), samples=1, seed=0)
