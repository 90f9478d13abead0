import pytest
import torch

from svim3d.cameras import orbit_cameras
from svim3d.mesh.source_mesh import SourceMaterial, SourceMesh
from svim3d.numerics import normalize
from svim3d.render.deferred import environment_shader
from svim3d.render.pictures import render_gbuffer, render_pictures
from svim3d.shading.prefilter import PyramidOperator


def unlit(normal, wo, materials):
    return materials.basecolor


def square(materials, *, z=0.0, material=0, tangents=None, colors=None, normal=(0.0, 0.0, 1.0)):
    """A unit square that faces +z, uv with the origin at its top left."""
    corners = torch.tensor([[-0.5, -0.5, z], [0.5, -0.5, z], [0.5, 0.5, z], [-0.5, 0.5, z]])
    return SourceMesh(
        vertices=corners,
        faces=torch.tensor([[0, 1, 2], [0, 2, 3]], dtype=torch.int32),
        normals=torch.tensor(normal).expand(4, 3).contiguous(),
        uv=torch.tensor([[0.0, 1.0], [1.0, 1.0], [1.0, 0.0], [0.0, 0.0]]),
        tangents=torch.zeros(4, 4) if tangents is None else tangents,
        colors=torch.ones(4, 3) if colors is None else colors,
        face_material=torch.full((2,), material, dtype=torch.int32),
        materials=tuple(materials),
    )


def front(size=64, azimuth=0.0):
    return orbit_cameras([(0.0, azimuth)], radius=3.0, fov_y_deg=33.8, size=size)


def test_texture_shows_the_right_way_up_and_round():
    texture = torch.tensor([[[1.0, 0, 0], [0, 1.0, 0]], [[0, 0, 1.0], [1.0, 1.0, 0]]])
    texture = texture.repeat_interleave(8, 0).repeat_interleave(8, 1)
    pictures = render_pictures(
        square([SourceMaterial(basecolor=texture)]), front(), unlit, supersample=1
    )
    image = pictures["basecolor"][0]
    for row, column, colour in (
        (24, 24, [1.0, 0, 0]),
        (24, 40, [0, 1.0, 0]),
        (40, 24, [0, 0, 1.0]),
        (40, 40, [1.0, 1.0, 0]),
    ):
        assert image[row, column].tolist() == pytest.approx(colour, abs=1e-5)


def test_factors_and_vertex_colours_multiply():
    material = SourceMaterial(
        basecolor_factor=(0.5, 0.25, 1.0), roughness_factor=0.5, metallic_factor=0.25
    )
    colors = torch.tensor([0.5, 0.5, 0.1]).expand(4, 3).contiguous()
    pictures = render_pictures(square([material], colors=colors), front(), unlit, supersample=2)
    inside = pictures["mask"][0, ..., 0] == 1.0
    assert bool(inside.any())
    for name, value in (
        ("basecolor", [0.25, 0.125, 0.1]),
        ("roughness", [0.5]),
        ("metallic", [0.25]),
        ("normal_world", [0.0, 0.0, 1.0]),
        ("radiance", [0.25, 0.125, 0.1]),
    ):
        image = pictures[name][0][inside]
        torch.testing.assert_close(image, torch.tensor(value).expand_as(image))


def test_each_face_shows_its_own_material():
    both = (SourceMaterial(basecolor_factor=(1.0, 0.0, 0.0)), SourceMaterial(roughness_factor=0.25))
    mesh = square(both)
    mesh.face_material[1] = 1
    pictures = render_pictures(mesh, front(), unlit, supersample=1)
    # The first triangle is the lower right half.
    assert pictures["basecolor"][0, 38, 42].tolist() == pytest.approx([1.0, 0.0, 0.0])
    assert pictures["roughness"][0, 38, 42].item() == pytest.approx(1.0)
    assert pictures["basecolor"][0, 26, 22].tolist() == pytest.approx([1.0, 1.0, 1.0])
    assert pictures["roughness"][0, 26, 22].item() == pytest.approx(0.25)


def test_seen_from_behind_the_normal_turns_to_the_viewer():
    pictures = render_pictures(
        square([SourceMaterial()]), front(azimuth=180.0), unlit, supersample=1
    )
    assert pictures["normal_world"][0, 32, 32].tolist() == pytest.approx([0.0, 0.0, -1.0], abs=1e-6)


@pytest.mark.parametrize("handedness", [1.0, -1.0])
def test_normal_map_tilts_along_tangent_and_bitangent(handedness):
    tilt = normalize(torch.tensor([0.3, 0.4, 1.0]))
    material = SourceMaterial(normal_tangent=tilt.expand(4, 4, 3).contiguous())
    tangents = torch.tensor([1.0, 0.0, 0.0, handedness]).expand(4, 4).contiguous()
    pictures = render_pictures(square([material], tangents=tangents), front(), unlit, supersample=1)
    expected = normalize(torch.tensor([0.3, 0.4 * handedness, 1.0]))
    torch.testing.assert_close(pictures["normal_world"][0, 32, 32], expected)


def test_coverage_of_a_square_is_its_projected_area():
    pictures = render_pictures(square([SourceMaterial()]), front(), unlit, supersample=4)
    side_px = front().focal_px / 3.0
    assert float(pictures["mask"].sum()) == pytest.approx(side_px**2, rel=0.01)
    # Straight values keep their size at the rim, premultiplied ones fade with coverage.
    rim = (pictures["mask"] > 0) & (pictures["mask"] < 1)
    torch.testing.assert_close(
        pictures["basecolor"][rim.expand_as(pictures["basecolor"])], torch.ones(3 * int(rim.sum()))
    )
    torch.testing.assert_close(
        pictures["radiance"], pictures["mask"].expand_as(pictures["radiance"])
    )


def test_a_mirror_shows_the_light_in_its_place():
    light = torch.zeros(64, 64, 3)
    light[..., 1] = 2.0
    shader = environment_shader(PyramidOperator.build(64)(light), multiple_scattering=False)
    mirror = SourceMaterial(roughness_factor=0.0, metallic_factor=1.0)
    pictures = render_pictures(square([mirror]), front(), shader, supersample=1)
    assert pictures["radiance"][0, 32, 32].tolist() == pytest.approx([0.0, 2.0, 0.0], abs=2e-3)


def test_buffers_hold_what_the_picture_was_shaded_from():
    basecolor = torch.rand(4, 4, 3, generator=torch.Generator().manual_seed(1))
    mesh = square([SourceMaterial(basecolor=basecolor, roughness_factor=0.4, metallic_factor=0.2)])
    camera = front()

    def shader(normal, wo, material):
        return material.basecolor * normal[..., 2:] + wo * material.roughness + material.metallic

    picture = render_pictures(mesh, camera, shader, supersample=1)
    gbuffer = render_gbuffer(mesh, camera)
    shaded = shader(gbuffer.normal_world[0], gbuffer.view_directions(0), gbuffer.take([0]))
    torch.testing.assert_close((shaded * gbuffer.mask)[0], picture["radiance"][0])
    covered = gbuffer.mask[0, ..., 0] > 0
    # The square lies in the plane z = 0.
    assert float(gbuffer.positions(0)[covered][:, 2].abs().max()) < 1e-5
