"""The size of drawn objects: exact for a sphere, near for boxes, told where it is not."""

import pytest
import torch
from sphere_orbit import sphere_images

from svim3d.cameras import Cameras, orbit_angles, orbit_cameras
from svim3d.render.orbit_scale import longest_side


def orbit(radius: float, elevation_deg: float = 10.0, swing_deg: float = 0.0) -> Cameras:
    angles = orbit_angles(21, elevation_deg, swing_deg)
    return orbit_cameras(angles, radius=radius, fov_y_deg=33.8, size=64)


def in_camera(cameras: Cameras, normal_world: torch.Tensor) -> torch.Tensor:
    return torch.einsum("vij,vhwi->vhwj", cameras.c2w[:, :3, :3], normal_world)


def sphere_side(cameras: Cameras) -> float:
    images = sphere_images(cameras)
    return longest_side(cameras, images["mask"], in_camera(cameras, images["normal_world"]))


def box_side(cameras: Cameras, half: tuple[float, float, float]) -> float:
    """Of an upright box, by the nearer slabs that each ray meets."""
    masks, normals = [], []
    for view in range(len(cameras)):
        origin, direction = cameras.rays(view)
        size = torch.tensor(half)
        one, two = (-size - origin) / direction, (size - origin) / direction
        enters, axis = torch.minimum(one, two).max(1)
        hit = (enters < torch.maximum(one, two).amin(1)).float()[:, None]
        face = torch.nn.functional.one_hot(axis, 3) * -direction.sign() * hit
        masks.append(hit.view(64, 64, 1))
        normals.append(face.view(64, 64, 3))
    return longest_side(cameras, torch.stack(masks), in_camera(cameras, torch.stack(normals)))


@pytest.mark.parametrize(("elevation_deg", "swing_deg"), [(10.0, 0.0), (10.0, 20.0), (-5.0, 0.0)])
def test_a_sphere_has_its_diameter_whatever_the_distance(elevation_deg, swing_deg):
    for radius in (1.9, 3.0):
        side = sphere_side(orbit(radius, elevation_deg, swing_deg)) * radius
        # A pixel in 57, and in 35: each side is known to half of one.
        assert side == pytest.approx(1.0, abs=0.03)


@pytest.mark.parametrize(
    ("half", "excess"),
    [
        ((0.25, 0.5, 0.25), 0.03),  # tall: upper and lower edges are told from curves
        ((0.5, 0.1, 0.3), 0.06),  # flat
        ((0.5, 0.5, 0.5), 0.15),  # no camera looks along a face, none sees the ground plan
    ],
)
def test_boxes_are_overrated_by_a_known_share(half, excess):
    side = box_side(orbit(2.6), half) * 2.6
    assert -0.02 < side - 1.0 < excess


def test_views_that_are_empty_are_passed_over_and_nothing_at_all_is_refused():
    cameras = orbit(2.2)
    images = sphere_images(cameras)
    images["mask"][3] = 0.0
    normal = in_camera(cameras, images["normal_world"])
    assert longest_side(cameras, images["mask"], normal) * 2.2 == pytest.approx(1.0, abs=0.03)
    with pytest.raises(ValueError, match="all views are empty"):
        longest_side(cameras, torch.zeros_like(images["mask"]), normal)
