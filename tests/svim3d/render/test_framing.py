import math

import pytest
import torch
from scored_sphere import ball
from sphere_orbit import sphere_cameras, sphere_images

from svim3d.cameras import orbit_angles, orbit_cameras
from svim3d.mesh.source_mesh import SourceMaterial, SourceMesh
from svim3d.render.framing import Framing

VIEWS, SIZE = 4, 96


def seen_ball(radius, distance):
    """Silhouettes of a ball about the origin, exact at pixel centres."""
    cameras = orbit_cameras(
        orbit_angles(VIEWS, 10.0, 20.0), radius=distance, fov_y_deg=33.8, size=SIZE
    )
    masks = []
    for view in range(VIEWS):
        origin, direction = cameras.rays(view)
        along = -(origin * direction).sum(-1)
        hit = origin.square().sum(-1) - along**2 < radius**2
        masks.append(hit.float().view(SIZE, SIZE, 1))
    return cameras, torch.stack(masks)


def test_the_silhouette_tells_the_scale():
    cameras, mask = seen_ball(0.4, 2.2)
    true_cameras, true_mask = seen_ball(0.5, 2.6)
    framing = Framing.fit(cameras[[3]], mask[3], true_cameras[[3]], true_mask[3])
    # A silhouette's half angle is asin(r / d): the plane through the origin sees d tan of it.
    seen, true = (d * math.tan(math.asin(r / d)) for r, d in ((0.4, 2.2), (0.5, 2.6)))
    assert framing.scale == pytest.approx(true / seen, rel=0.02)  # a pixel of about 60
    assert float(framing.shift.norm()) < 0.01


def test_equal_silhouettes_are_left_where_they_are():
    cameras, mask = seen_ball(0.5, 2.2)
    framing = Framing.fit(cameras[[3]], mask[3], cameras[[3]], mask[3])
    assert framing.scale == 1.0
    assert float(framing.shift.norm()) == 0.0
    images = sphere_images(sphere_cameras(VIEWS, SIZE))
    shown = framing.resample(cameras, images, cameras)
    assert torch.allclose(shown["radiance"], images["radiance"], atol=1e-5)
    inside = images["mask"].expand_as(images["basecolor"]) > 0
    assert torch.allclose(shown["basecolor"][inside], images["basecolor"][inside], atol=1e-5)


def test_a_shift_is_seen_in_the_plane_of_the_photo():
    cameras, mask = seen_ball(0.4, 2.2)
    moved = mask[3].roll((-6, 9), (0, 1))  # up and to the right
    framing = Framing.fit(cameras[[3]], mask[3], cameras[[3]], moved)
    pixel = 2.2 / cameras.focal_px
    right, up, back = cameras.c2w[3, :3, :3].unbind(1)
    assert float(framing.shift @ right) == pytest.approx(9 * pixel, abs=1e-5)
    assert float(framing.shift @ up) == pytest.approx(6 * pixel, abs=1e-5)
    assert float(framing.shift @ back) == pytest.approx(0.0, abs=1e-6)
    shown = framing.resample(cameras[[3]], {"mask": mask[[3]]}, cameras[[3]])["mask"]
    assert torch.allclose(shown[0], moved, atol=1e-3)


def test_pictures_from_farther_away_are_enlarged():
    cameras, mask = seen_ball(0.5, 4.0)
    true_cameras, true_mask = seen_ball(0.5, 2.2)
    shown = Framing.none().resample(cameras, {"mask": mask}, true_cameras)["mask"] > 0.5
    true = true_mask > 0.5
    overlap = float((shown & true).sum() / (shown | true).sum())
    # What is left is the nearer camera's view of less than half of the ball.
    nearer, farther = (d * math.tan(math.asin(0.5 / d)) for d in (2.2, 4.0))
    assert overlap == pytest.approx((farther / nearer) ** 2, abs=0.02)


def test_a_mesh_goes_where_its_silhouette_does():
    body = ball(0.4)
    material = SourceMaterial(basecolor=None, roughness_metallic=None, normal_tangent=None)
    count = len(body.vertices)
    mesh = SourceMesh(
        vertices=body.vertices,
        faces=body.faces,
        normals=body.normals,
        uv=torch.zeros(count, 2),
        tangents=torch.zeros(count, 4),
        colors=torch.ones(count, 3),
        face_material=torch.zeros(len(body.faces), dtype=torch.int32),
        materials=(material,),
    )
    placed = Framing(1.25, torch.tensor([0.1, 0.0, 0.0])).place(mesh)
    assert placed.vertices[:, 0].max() == pytest.approx(0.6, abs=1e-3)
    assert placed.vertices[:, 1].max() == pytest.approx(0.5, abs=1e-3)


def test_an_empty_view_is_refused():
    cameras, mask = seen_ball(0.4, 2.2)
    with pytest.raises(ValueError, match="silhouette"):
        Framing.fit(cameras[[3]], 0.0 * mask[3], cameras[[3]], mask[3])
