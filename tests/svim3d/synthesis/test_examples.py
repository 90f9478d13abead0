"""Whole training examples: channels against closed forms, cameras, exposure, repeatability."""

import json
import math

import pytest
import torch

from svim3d.cameras import orbit_cameras
from svim3d.color import linear_from_srgb, luminance, srgb_from_linear
from svim3d.mesh.source_mesh import SourceMaterial, complete
from svim3d.shading.prefilter import PyramidOperator
from svim3d.synthesis.dice import Dice
from svim3d.synthesis.examples import FOV_DEG, photograph, render_example
from svim3d.synthesis.lights import random_light
from svim3d.synthesis.materials import Layer, SolidMaterial
from svim3d.synthesis.matter import Matter
from svim3d.synthesis.objects import SyntheticObject
from svim3d.synthesis.patterns import Decal
from svim3d.synthesis.scenes import mesh_quality, scene_of, scene_of_mesh
from svim3d.synthesis.shapes import assemble, superquadric
from svim3d.synthesis.trajectories import Trajectory
from svim3d.synthesis.views import EXPOSED_QUANTILE, exposure_for

RED, GREY = Matter((0.8, 0.02, 0.02), 0.3, 1.0), Matter((0.4, 0.4, 0.4), 0.8, 0.0)
AROUND = Trajectory((0.0,) * 4, (90.0, 180.0, 270.0, 0.0))
SIZE = 48


@pytest.fixture(scope="module")
def operator():
    return PyramidOperator.build(16)


def sphere_with_spot_on_plus_x():
    assembly = assemble([superquadric(1.0, 1.0, 64).placed(scale=(0.5, 0.5, 0.5))])
    spot = Layer(RED, Decal((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0), 0.3, "disc"))
    faces = torch.zeros(len(assembly.faces), dtype=torch.long)
    return SyntheticObject("ball", assembly, faces, (SolidMaterial(GREY, (spot,)),), "good")


def picture(operator, *, yaw_deg=0.0, light_seed=0, trajectory=AROUND, displays=(0.7, 0.7)):
    lights = [(f"l{i}", random_light(Dice.of(light_seed, i), 16)) for i in range(2)]
    return photograph(
        scene_of(sphere_with_spot_on_plus_x(), yaw_deg),
        trajectory,
        lights,
        displays,
        operator,
        size=SIZE,
        seed="test",
    )


@pytest.fixture(scope="module")
def ball(operator):
    return picture(operator)


def centre_of_spot(example, view):
    """Column and row of the red patch, in pixels; None where it is not seen."""
    red = example.orm[view, ..., 2] > 64
    if not bool(red.any()):
        return None
    row, column = torch.nonzero(red).float().mean(0) + 0.5
    return float(column), float(row)


def test_shapes_and_metadata(ball):
    assert ball.rgb.shape == (2, 4, SIZE, SIZE, 3)
    assert ball.basecolor.shape == ball.orm.shape == ball.normal.shape == (4, SIZE, SIZE, 3)
    assert ball.mask.shape == (4, SIZE, SIZE, 1)
    assert ball.azimuth_deg.tolist() == [90.0, 180.0, 270.0, 0.0]
    assert float(ball.metadata["fov_deg"]) == FOV_DEG
    assert ball.metadata["quality"] == "good" and ball.metadata["transfer"] == "srgb"
    assert json.loads(ball.metadata["environments"]) == ["l0", "l1"]


def test_backgrounds_are_exactly_white_or_black(ball):
    empty = ball.mask[..., 0] == 0
    assert bool((ball.rgb[:, empty] == 255).all())
    assert bool((ball.basecolor[empty] == 255).all())
    assert bool((ball.orm[empty] == 0).all())
    assert bool((ball.normal[empty] == 0).all())


def test_the_mask_has_the_area_of_a_sphere(ball):
    radius = float(ball.metadata["radius"])
    # The outline is a circle of tan(asin(R / r)) on the plane at distance 1.
    tangent = 0.5 / math.sqrt(radius**2 - 0.25)
    share = math.pi * (tangent / (2.0 * math.tan(math.radians(FOV_DEG) / 2.0))) ** 2
    measured = ball.mask.float().mean((1, 2, 3)) / 255.0
    # Four samples a pixel along an outline of about 140 pixels.
    torch.testing.assert_close(measured, torch.full((4,), share), atol=0.004, rtol=0.0)


def test_normals_are_those_of_a_sphere_in_the_cameras_frame(ball):
    radius = float(ball.metadata["radius"])
    camera = orbit_cameras([(0.0, 0.0)], radius=radius, fov_y_deg=FOV_DEG, size=SIZE)
    origin, direction = camera.rays(0)
    along = (origin * direction).sum(-1)
    hit = along**2 - radius**2 + 0.25
    distance = -along - hit.clamp_min(0.0).sqrt()
    # At azimuth 0 and elevation 0 the camera's axes are the world's.
    expected = (origin + distance[:, None] * direction) / 0.5
    inner = expected[:, 2] > 0.35  # a pixel at the rim averages over much of the sphere
    inner &= hit > 0.0
    inner &= ball.mask[3].reshape(-1) == 255  # others are blends with black
    for view in range(4):
        measured = ball.normal[view].reshape(-1, 3)[inner].float() / 127.5 - 1.0
        cosine = (torch.nn.functional.normalize(measured, dim=1) * expected[inner]).sum(1)
        # Eight bits are good for half a degree; flat poles and averages for another.
        assert float(cosine.min()) > math.cos(math.radians(2.0))


def test_materials_are_encoded_as_agreed(ball):
    grey = (ball.mask[2, ..., 0] == 255) & (ball.orm[2, ..., 2] == 0)  # the spot is behind
    expected = round(float(srgb_from_linear(torch.tensor(0.4))) * 255.0)
    assert bool((ball.basecolor[2][grey] == expected).all())
    assert bool((ball.orm[2][grey] == torch.tensor([0, 204, 0])).all())
    middle = SIZE // 2
    assert ball.orm[0, middle, middle].tolist() == [0, 76, 255]  # 0.3 and 1 of 255


def test_the_spot_on_plus_x_is_ahead_at_azimuth_90_and_to_the_right_at_0(ball):
    column, row = centre_of_spot(ball, 0)
    assert (column, row) == pytest.approx((SIZE / 2, SIZE / 2), abs=0.6)
    column, row = centre_of_spot(ball, 3)
    assert column > 0.85 * SIZE and row == pytest.approx(SIZE / 2, abs=0.6)
    column, _ = centre_of_spot(ball, 1)
    assert column < 0.15 * SIZE
    assert centre_of_spot(ball, 2) is None


def test_yaw_turns_the_object_counter_clockwise_from_above(operator):
    turned = picture(operator, yaw_deg=-90.0)
    # From +x by -90 degrees about y: to +z, in front of the camera at azimuth 0.
    column, row = centre_of_spot(turned, 3)
    assert (column, row) == pytest.approx((SIZE / 2, SIZE / 2), abs=0.6)


def test_materials_do_not_depend_on_the_light(operator, ball):
    other = picture(operator, light_seed=5)
    for name in ("basecolor", "orm", "normal", "mask"):
        assert torch.equal(getattr(other, name), getattr(ball, name))
    assert not torch.equal(other.rgb, ball.rgb)


def test_exposure_brings_the_bright_tenth_to_its_value():
    generator = torch.Generator().manual_seed(0)
    mask = (torch.rand(3, 20, 20, 1, generator=generator) > 0.4).float()
    radiance = torch.rand(3, 20, 20, 3, generator=generator) * 7.0 * mask
    exposed = radiance * exposure_for(radiance, mask, 0.75)
    values = luminance(exposed[mask[..., 0] > 0.5])
    bright = torch.quantile(values, EXPOSED_QUANTILE)
    assert float(srgb_from_linear(bright)) == pytest.approx(0.75, abs=1e-4)


def test_pictures_are_exposed_as_asked(operator):
    example = picture(operator, displays=(0.55, 0.85))
    covered = example.mask[..., 0] == 255
    for rgb, display in zip(example.rgb, (0.55, 0.85), strict=True):
        linear = linear_from_srgb(rgb[covered].float() / 255.0)
        bright = torch.quantile(luminance(linear), EXPOSED_QUANTILE)
        # Bytes and clipped channels; pixels of the rim are left out here.
        assert float(srgb_from_linear(bright)) == pytest.approx(display, abs=0.03)


def test_an_example_is_a_function_of_seed_and_index(operator):
    wanted = {"size": 24, "views": 5, "lights": 1}
    first, again = (render_example(3, 8, operator, **wanted) for _ in range(2))
    assert first.metadata == again.metadata
    for name, tensor in first.tensors().items():
        assert torch.equal(tensor, again.tensors()[name])
    other = render_example(3, 9, operator, **wanted)
    assert not torch.equal(other.rgb, first.rgb)
    assert not torch.equal(render_example(4, 8, operator, **wanted).rgb, first.rgb)


@pytest.mark.parametrize("index", range(8))
def test_no_view_cuts_the_object_off(operator, index):
    example = render_example(11, index, operator, size=64, views=7, lights=1)
    mask = example.mask[..., 0]
    border = torch.cat([mask[:, 0], mask[:, -1], mask[:, :, 0], mask[:, :, -1]], 1)
    assert int(border.max()) == 0
    assert int(mask.sum((1, 2)).min()) > 0
    assert example.azimuth_deg[-1] == 0.0


def test_lights_from_files_are_turned_and_named(operator):
    maps = [("park", random_light(Dice.of(0, 0), 16))]
    example = render_example(0, 1, operator, size=16, views=3, lights=4, maps=maps)
    names = json.loads(example.metadata["environments"])
    assert [name.split()[0] for name in names] == ["invented", "park", "invented", "park"]


def mesh_with(**material):
    shape = superquadric(0.3, 0.3, 8).placed(scale=(0.5, 0.5, 0.5))
    return complete(
        shape.vertices, shape.faces, material=0, materials=(SourceMaterial(**material),)
    )


def test_meshes_are_photographed_with_their_own_materials(operator):
    mesh = mesh_with(basecolor_factor=(0.2, 0.5, 0.1), roughness_factor=0.6, metallic_factor=0.0)
    example = render_example(0, 0, operator, size=24, views=3, lights=1, mesh=("crate", mesh))
    assert example.metadata["name"] == "crate"
    assert example.metadata["quality"] == "low"  # one value everywhere
    covered = example.mask[..., 0] == 255
    assert bool((example.orm[covered] == torch.tensor([0, 153, 0])).all())


def test_a_mesh_is_good_where_colour_and_roughness_vary():
    noisy = torch.rand(4, 4, 3, generator=torch.Generator().manual_seed(0))
    assert mesh_quality(mesh_with()) == "low"
    assert mesh_quality(mesh_with(basecolor=noisy)) == "low"
    assert mesh_quality(mesh_with(basecolor=noisy, roughness_metallic=noisy[..., :2])) == "good"
    flat = torch.full((4, 4, 2), 0.5)
    assert mesh_quality(mesh_with(basecolor=noisy, roughness_metallic=flat)) == "low"


def test_a_turned_mesh_keeps_its_tangents_with_its_normals():
    mesh = mesh_with()
    scene = scene_of_mesh("crate", mesh, 90.0)
    # From +z by 90 degrees about y: to +x.
    torch.testing.assert_close(scene.geometry.vertices[:, 0], mesh.vertices[:, 2])
    torch.testing.assert_close(scene.geometry.normals[:, 0], mesh.normals[:, 2])
