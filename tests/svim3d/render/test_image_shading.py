"""Relighting of one view: closed forms of what is seen, and invariance."""

import math
from dataclasses import replace

import pytest
import torch
from analytic_views import (
    LIGHT_SIZE,
    buffer_of,
    camera,
    lamp,
    plane,
    sphere,
    uniform_light,
)

from svim3d.cameras import Cameras
from svim3d.render import image_shading
from svim3d.render.gbuffer import GBuffer
from svim3d.render.image_shading import ViewPoints, shade_view
from svim3d.render.ray_light import (
    gather_hits,
    gather_hits_plainly,
    lobe_light,
    lobe_light_plainly,
    turn_about_y,
)
from svim3d.render.screen_march import Relief, march, march_plainly
from svim3d.render.screen_visibility import LobeRays, ScreenVisibility, covered_pixels
from svim3d.shading.environment import rotate_about_y
from svim3d.shading.prefilter import EnvironmentPyramid, PyramidOperator

SIZE = 96
FLOOR = (0.0, 1.0, 0.0)
# One of 64 rays is 0.016, pixels near the start of a ray are missed within the horizon's margin,
# and a ball counts as thicker than it is where it curves away from the camera.
TOLERANCE = 0.045


def ground() -> GBuffer:
    cameras = camera(SIZE)
    return buffer_of(cameras, [plane(cameras, FLOOR, 0.0, 0.5)])


def corner() -> GBuffer:
    """A floor at y = 0 and a wall at z = 0 that is 1 high, seen from the front."""
    cameras = camera(SIZE)
    floor = plane(cameras, FLOOR, 0.0, 0.5)
    wall = plane(cameras, (0.0, 0.0, 1.0), 0.0, 0.5)
    return buffer_of(cameras, [floor, wall])


def ball_on_ground(cameras: Cameras, **material: float) -> GBuffer:
    floor = plane(cameras, FLOOR, -0.2, 0.5)
    return buffer_of(cameras, [floor, sphere(cameras, (0.0, 0.0, 0.0), 0.2)], **material)


def diffuse_share(gbuffer: GBuffer, light: EnvironmentPyramid) -> torch.Tensor:
    """Shadowed over unshadowed diffuse radiance [H, W]."""
    visibility = ScreenVisibility.trace(gbuffer, 0)
    seen = shade_view(gbuffer, 0, light, visibility=visibility, bounces=0).diffuse
    return (seen / shade_view(gbuffer, 0, light).diffuse)[..., 0]


def test_a_plane_sees_everything():
    visibility = ScreenVisibility.trace(ground(), 0)
    assert (visibility.diffuse.hit == -1).all() and (visibility.specular.hit == -1).all()
    lit, plain = (
        shade_view(ground(), 0, uniform_light(), visibility=v).radiance for v in (visibility, None)
    )
    assert torch.equal(lit, plain)


def test_a_ball_does_not_shadow_itself():
    cameras = camera(SIZE)
    visibility = ScreenVisibility.trace(
        buffer_of(cameras, [sphere(cameras, (0.0, 0.0, 0.0), 0.4)]), 0
    )
    assert (visibility.diffuse.hit == -1).all()


def test_a_wall_takes_its_form_factor_from_the_floor_before_it():
    gbuffer = corner()
    share = diffuse_share(gbuffer, uniform_light())
    point = gbuffer.positions(0)
    on_floor = (gbuffer.normal_world[0, ..., 1] > 0.9) & (point[..., 0].abs() < 0.1)
    for distance in (0.05, 0.15, 0.3):
        near = on_floor & ((point[..., 2] - distance).abs() < 0.02)
        # Floor element against a wall of height h = 0.5, -a to a wide, perpendicular to it.
        # Source: Howell, catalog of configuration factors, B-3, for the element before its middle.
        h, a = 0.5, 0.5
        root = math.hypot(distance, h)
        factor = (math.atan(a / distance) - distance / root * math.atan(a / root)) / math.pi
        assert float(share[near].mean()) == pytest.approx(1.0 - factor, abs=TOLERANCE)


def test_a_ball_takes_its_form_factor_from_the_ground_below_it():
    gbuffer = ball_on_ground(camera(SIZE, elevation_deg=60.0))
    share = diffuse_share(gbuffer, uniform_light())
    point = gbuffer.positions(0)
    # Before the ball, where all that shadows the ground is in the picture.
    before = (gbuffer.normal_world[0, ..., 1] > 0.99) & (point[..., 1] < -0.19)
    before &= (point[..., 0].abs() < 0.03) & ((point[..., 2] - 0.35).abs() < 0.03)
    # A sphere above the plane: h r^2 / d^3. Source: Howell, catalog of configuration factors, B-38.
    factor = 0.2 * 0.2**2 / math.hypot(0.35, 0.2) ** 3
    assert float(share[before].mean()) == pytest.approx(1.0 - factor, abs=TOLERANCE)


def test_the_shadow_of_a_lamp_is_black():
    gbuffer = ball_on_ground(camera(SIZE, elevation_deg=60.0), roughness=0.5)
    pyramid = PyramidOperator.build(LIGHT_SIZE)(lamp((0.0, 1.0, -1.0), 0.97))
    visibility = ScreenVisibility.trace(gbuffer, 0)
    shadowed = shade_view(gbuffer, 0, pyramid, visibility=visibility, bounces=0).diffuse
    lit = shade_view(gbuffer, 0, pyramid).diffuse
    point = gbuffer.positions(0)
    ground = (gbuffer.normal_world[0, ..., 1] > 0.99) & (point[..., 1] < -0.19)
    # Light from behind at 45 degrees: the ball's centre, 0.2 high, throws its shadow 0.2 forward.
    core = ground & ((point - torch.tensor([0.0, -0.2, 0.2])).norm(dim=-1) < 0.06)
    # The light's pyramid blurs the lamp, and the 64 rays share it: what is left is no bias.
    assert float((shadowed[core] / lit[core]).median()) < 0.05
    assert float((shadowed[core] / lit[core]).mean()) < 0.1
    away = ground & (point[..., 0].abs() > 0.35)
    assert float((shadowed[away] / lit[away]).min()) > 0.9


def test_blocked_rays_bring_what_they_meet():
    gbuffer = corner()
    light = uniform_light()
    visibility = ScreenVisibility.trace(gbuffer, 0)
    dark, once = (
        shade_view(gbuffer, 0, light, visibility=visibility, bounces=b).radiance for b in (0, 1)
    )
    plain = shade_view(gbuffer, 0, light).radiance
    point = gbuffer.positions(0)
    foot = (gbuffer.normal_world[0, ..., 1] > 0.9) & (point[..., 2] < 0.05)
    assert (once[foot] > dark[foot]).all() and (once[foot] < plain[foot]).all()


def test_light_and_scene_turned_together_change_nothing():
    radiance = lamp((1.0, 1.0, 0.3), 0.9) + 0.2
    still = ball_on_ground(camera(SIZE, azimuth_deg=10.0))
    # All is turned by 90 degrees, for which turning the map is exact.
    turned = ball_on_ground(camera(SIZE, azimuth_deg=100.0))
    build = PyramidOperator.build(LIGHT_SIZE)
    here, there = build(radiance), build(rotate_about_y(radiance, 90.0))
    for traced in (False, True):
        pictures = []
        for gbuffer, light, azimuth_deg in (
            (still, here, 0.0),
            (turned, there, 0.0),
            (turned, here, 90.0),
        ):
            visibility = ScreenVisibility.trace(gbuffer, 0) if traced else None
            shaded = shade_view(gbuffer, 0, light, azimuth_deg=azimuth_deg, visibility=visibility)
            pictures.append(shaded.radiance)
        first, *others = pictures
        for other in others:
            torch.testing.assert_close(other, first, atol=1e-4, rtol=1e-4)


def test_turning_the_light_matches_a_turned_map_when_traced():
    gbuffer = ball_on_ground(camera(SIZE))
    radiance = lamp((1.0, 1.0, 0.3), 0.9) + 0.2
    build = PyramidOperator.build(LIGHT_SIZE)
    visibility = ScreenVisibility.trace(gbuffer, 0)
    exact = shade_view(gbuffer, 0, build(radiance), azimuth_deg=180.0, visibility=visibility)
    by_map = shade_view(gbuffer, 0, build(rotate_about_y(radiance, 180.0)), visibility=visibility)
    torch.testing.assert_close(exact.radiance, by_map.radiance, atol=1e-3, rtol=1e-3)


def test_plus_z_turns_to_plus_x():
    z, x = torch.eye(3)[2], torch.eye(3)[0]
    torch.testing.assert_close(turn_about_y(z, 90.0), x, atol=1e-6, rtol=0.0)


def test_the_march_agrees_with_its_twin():
    gbuffer = ball_on_ground(camera(SIZE))
    pixels = covered_pixels(gbuffer, 0)
    relief = Relief.of(gbuffer.cameras, 0, pixels, gbuffer.positions(0))
    relief = Relief(relief.focal_px, relief.owner, relief.point.double(), relief.normal.double())
    generator = torch.Generator().manual_seed(0)
    direction = torch.randn(len(pixels), 4, 3, generator=generator, dtype=torch.float64)
    direction = torch.nn.functional.normalize(direction, dim=-1)
    hit, twin = march(relief, direction), march_plainly(relief, direction)
    assert float((hit >= 0).float().mean()) > 0.02
    assert int((hit != twin).sum()) == 0


def test_light_along_rays_agrees_with_its_twin():
    generator = torch.Generator().manual_seed(0)
    shape = (50, 8)
    direction = torch.nn.functional.normalize(torch.randn(*shape, 3, generator=generator), dim=-1)
    hit = torch.randint(-1, 50, shape, generator=generator, dtype=torch.int32)
    hit[:10] = -1
    rays = LobeRays(
        direction,
        torch.rand(shape, generator=generator),
        torch.rand(shape, generator=generator),
        hit,
    )
    pyramid = PyramidOperator.build(LIGHT_SIZE)(lamp((1.0, 1.0, 0.3), 0.5))
    for ours, twin in zip(
        lobe_light(rays, pyramid, azimuth_deg=25.0),
        lobe_light_plainly(rays, pyramid, azimuth_deg=25.0),
        strict=True,
    ):
        torch.testing.assert_close(ours, twin)
    radiance = torch.rand(50, 3, generator=generator)
    torch.testing.assert_close(gather_hits(rays, radiance), gather_hits_plainly(rays, radiance))


def test_tracing_needs_depth():
    gbuffer = ground()
    images = {name: image for name, image in gbuffer.images().items() if name != "depth"}
    with pytest.raises(ValueError, match=r"depth\.Z"):
        ScreenVisibility.trace(GBuffer.of(gbuffer.cameras, images), 0)


def test_large_views_are_traced_smaller_and_shaded_in_full(monkeypatch):
    gbuffer, light = ball_on_ground(camera(SIZE)), uniform_light()
    fine = ViewPoints.occluded(gbuffer, 0)
    monkeypatch.setattr(image_shading, "TRACED_SIDE", 40)  # neither divides the other
    coarse = ViewPoints.occluded(gbuffer, 0)
    assert len(coarse.occluders.points.pixels) < 0.25 * len(fine.occluders.points.pixels)
    assert torch.equal(coarse.pixels, fine.pixels)
    one, other = (points.lit(light).radiance for points in (fine, coarse))
    open_air = ViewPoints.of(gbuffer, 0).lit(light).radiance
    # Shadows of a picture of 40 pixels lie up to a pixel beside those of 96.
    assert float((one - other).abs().mean()) < 0.2 * float((one - open_air).abs().mean())
    far = (one == open_air).all(-1) & (other == open_air).all(-1)
    assert bool(far.any())


def test_thin_coverage_is_shaded_as_in_open_air():
    gbuffer = ball_on_ground(camera(SIZE))
    thin = replace(gbuffer, mask=torch.where(gbuffer.mask > 0.0, 0.25, 0.0))
    shaded = shade_view(thin, 0, uniform_light(), visibility=ScreenVisibility.trace(thin, 0))
    assert torch.equal(shaded.radiance, shade_view(gbuffer, 0, uniform_light()).radiance)


@pytest.mark.parametrize("lamp_texel", [(3, 5), (10, 18), (17, 31), (24, 12)])
def test_a_single_lamp_makes_no_fireflies(lamp_texel):
    # Rays that miss a lamp which the prefiltered lookup saw must not turn bounces into more light
    # than there is anywhere in open air: unbounded, some came out 700,000 times as bright.
    radiance = torch.zeros(LIGHT_SIZE, LIGHT_SIZE, 3)
    radiance[lamp_texel] = 500.0
    pyramid = PyramidOperator.build(LIGHT_SIZE, "exact")(radiance)
    gbuffer = ball_on_ground(camera(SIZE), roughness=0.3, basecolor=0.9, metallic=1.0)
    visibility = ScreenVisibility.trace(gbuffer, 0)
    occluded = shade_view(gbuffer, 0, pyramid, visibility=visibility).radiance
    assert float(occluded.max()) < 1.2 * float(shade_view(gbuffer, 0, pyramid).radiance.max())
