"""Poses, projection and rays agree with each other and with written-down orbits."""

import math

import pytest
import torch

from svim3d.cameras import CameraPath, look_at_origin, orbit_angles, orbit_cameras


def an_orbit(size: int = 32):
    return orbit_cameras(orbit_angles(5, 10.0, 20.0), radius=2.9, fov_y_deg=33.8, size=size)


def test_azimuth_zero_stands_on_plus_z_and_ninety_on_plus_x():
    assert torch.allclose(look_at_origin(0.0, 0.0, 2.0)[:3, 3], torch.tensor([0.0, 0.0, 2.0]))
    ninety = look_at_origin(0.0, 90.0, 2.0)[:3, 3]
    assert torch.allclose(ninety, torch.tensor([2.0, 0.0, 0.0]), atol=1e-6)


def test_pose_matches_an_orbit_written_by_another_renderer():
    # View 5 of the path-traced boombox orbit (see README, Data).
    c2w = look_at_origin(29.498558244, 102.857142857, 2.9)
    expected = torch.tensor(
        [
            [-0.2225209339538835, -0.48005612121625, 0.8485461416063952, 2.460783810658546],
            [0.0, 0.8703680867100447, 0.49240165884844067, 1.4279648106604779],
            [-0.9749279121823784, 0.10956967700739655, -0.19367511953837382, -0.561657846661284],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )
    assert torch.allclose(c2w, expected, atol=1e-6)


def test_orbit_ends_at_the_reference_view():
    angles = orbit_angles(21, 10.0, 20.0)
    assert len(angles) == 21
    assert angles[-1] == (10.0, 0.0)
    assert angles[5][0] == pytest.approx(29.498558244)


def test_poses_are_rigid():
    rotation = an_orbit().c2w[:, :3, :3]
    identity = torch.eye(3).expand(5, 3, 3)
    assert torch.allclose(rotation @ rotation.transpose(1, 2), identity, atol=1e-6)
    assert torch.allclose(torch.linalg.det(rotation), torch.ones(5), atol=1e-6)


def test_points_on_a_ray_project_to_its_pixel():
    cameras = an_orbit()
    origins, directions = cameras.rays(2)
    clip = cameras.project(origins + 1.7 * directions)[2]
    x = (clip[:, 0] / clip[:, 3] * 0.5 + 0.5) * cameras.width
    y = (0.5 - clip[:, 1] / clip[:, 3] * 0.5) * cameras.height
    pixels = torch.arange(cameras.height * cameras.width)
    assert torch.allclose(x, pixels % cameras.width + 0.5, atol=1e-3)
    assert torch.allclose(y, pixels // cameras.width + 0.5, atol=1e-3)


def test_focal_length_matches_field_of_view():
    assert an_orbit(256).focal_px == pytest.approx(128 / math.tan(math.radians(16.9)))


def test_pole_is_refused():
    with pytest.raises(ValueError, match="elevation"):
        look_at_origin(90.0, 0.0, 2.0)


def test_static_path_keeps_its_elevation_and_ends_at_the_reference_view():
    elevation, azimuth = CameraPath.orbit(21, 10.0).tensors()
    assert elevation.tolist() == [10.0] * 21
    expected = torch.tensor([360.0 * k / 21 for k in range(1, 21)] + [0.0])
    assert torch.allclose(azimuth, expected)


def test_swinging_path_rises_as_the_sine_of_its_azimuth():
    elevation, azimuth = CameraPath.orbit(12, -5.0, 30.0).tensors()
    assert torch.allclose(elevation, -5.0 + 30.0 * torch.sin(torch.deg2rad(azimuth)), atol=1e-4)
    assert elevation[-1] == -5.0
    assert float(elevation.max()) == pytest.approx(25.0, abs=1e-4)


def test_any_list_of_angles_is_a_path():
    path = CameraPath(((20.0, -90.0), (0.0, 725.0), (-1e-3, -1e-20), (7.0, 360.0)))
    assert path.angles == ((20.0, 270.0), (0.0, 5.0), (-1e-3, 0.0), (7.0, 0.0))
    assert len(path) == 4
    assert len(orbit_cameras(list(path.angles), radius=2.0, fov_y_deg=33.8, size=8)) == 4


@pytest.mark.parametrize(
    ("angles", "wanted"),
    [
        ((), "at least 2 frames"),
        (((0.0, 0.0),), "at least 2 frames"),
        (((90.0, 10.0), (0.0, 0.0)), r"\(-90, 90\)"),
        (((float("nan"), 10.0), (0.0, 0.0)), r"\(-90, 90\)"),
        (((0.0, float("inf")), (0.0, 0.0)), "finite"),
        (((0.0, 0.0), (10.0, 90.0)), "azimuth 0"),
    ],
)
def test_impossible_paths_are_refused(angles, wanted):
    with pytest.raises(ValueError, match=wanted):
        CameraPath(angles)
