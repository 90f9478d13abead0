"""What a perfect generator would draw of the painted sphere, and the photo that it was shown."""

import torch
from sphere_orbit import sphere_images

from stages.photo_artifact import Placement, PreparedPhoto
from svim3d.cameras import Cameras, orbit_angles, orbit_cameras
from svim3d.color import srgb_from_linear
from svim3d.diffusion.groups import GeneratedViews

DISTANCE = 1.95  # the sphere of radius 0.5 then fills nine tenths of the picture


def drawn_cameras(views: int, size: int) -> Cameras:
    angles = orbit_angles(views, 10.0, 0.0)
    return orbit_cameras(angles, radius=DISTANCE, fov_y_deg=33.8, size=size)


def drawn_sphere(views: int, size: int) -> GeneratedViews:
    cameras = drawn_cameras(views, size)
    images = sphere_images(cameras)
    normal = torch.einsum("vij,vhwi->vhwj", cameras.c2w[:, :3, :3], images["normal_world"])
    return GeneratedViews(
        rgb_linear=images["radiance"],
        basecolor=images["basecolor"],
        roughness=images["roughness"],
        metallic=images["metallic"],
        normal_camera=normal,
        mask=images["mask"],
    )


def sphere_photo(size: int) -> PreparedPhoto:
    """The sphere's reference view, greener than it is drawn."""
    images = sphere_images(drawn_cameras(1, size))
    rgb = srgb_from_linear(images["radiance"][0] * torch.tensor([0.5, 1.0, 0.5]))
    return PreparedPhoto(
        rgb, images["mask"][0], Placement(size, size, 0, 0, size, size, 1.0), "alpha"
    )
