"""Tiny folders in the layouts of other benchmarks: the painted sphere, z up, off the origin."""

import json
import math
from pathlib import Path

import numpy as np
import torch
import trimesh
from scored_sphere import ball
from sphere_orbit import RADIUS, sphere_images

from svim3d.cameras import Cameras, look_at_origin
from svim3d.color import srgb_from_linear
from svim3d.io.exr import write_exr, write_rgb
from svim3d.io.image import write_png

# Ours = turn @ (theirs - CENTRE) / SIZE, before the photo's camera is brought to azimuth 0.
CENTRE, SIZE = torch.tensor([3.0, -2.0, 1.0]), 4.0
UPRIGHT = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
PIXELS, FOV_DEG, DISTANCE = 24, 33.8, 2.2
PHOTO_AZIMUTH_DEG = 50.0
AZIMUTHS_DEG = {"train": (50.0, 140.0, 230.0, 320.0), "test": (95.0, 275.0)}


def our_cameras(split: str) -> Cameras:
    """Cameras of a split before the photo's is brought to azimuth 0."""
    poses = [look_at_origin(10.0, azimuth, DISTANCE) for azimuth in AZIMUTHS_DEG[split]]
    return Cameras(torch.stack(poses), FOV_DEG, PIXELS, PIXELS)


def their_pose(c2w: torch.Tensor) -> list[list[float]]:
    pose = torch.eye(4)
    pose[:3, :3] = UPRIGHT.T @ c2w[:3, :3]
    pose[:3, 3] = SIZE * (UPRIGHT.T @ c2w[:3, 3]) + CENTRE
    return pose.tolist()


def write_index(file: Path, cameras: Cameras, names: list[str], **more: object) -> None:
    frames = [
        {"file_path": name, "transform_matrix": their_pose(c2w), **more}
        for name, c2w in zip(names, cameras.c2w, strict=True)
    ]
    page = {"camera_angle_x": math.radians(FOV_DEG), "frames": frames}
    file.write_text(json.dumps(page))


def write_mesh(file: Path) -> None:
    body = ball()
    file.parent.mkdir(parents=True, exist_ok=True)
    vertices = SIZE * (body.vertices @ UPRIGHT) + CENTRE
    trimesh.Trimesh(vertices.numpy(), body.faces.numpy(), process=False).export(file)


def spot_light(direction: tuple[float, float, float]) -> torch.Tensor:
    """A lat-long light, in our convention, that shines from one texel."""
    light = torch.full((16, 32, 3), 0.1)
    x, y, z = direction
    u, v = math.atan2(x, -z) / math.tau + 0.5, math.acos(y) / math.pi
    light[min(15, int(v * 16)), int(u * 32) % 32] = 100.0
    return light


def write_renders(home: Path, *, maps: bool = True, mesh: str | None = "mesh.obj") -> None:
    """A render folder of Poly Haven, BlenderVault or GSO."""
    for split in ("train", "test"):
        cameras = our_cameras(split)
        images = sphere_images(cameras)
        (home / split).mkdir(parents=True)
        names = [f"./{split}/r_{view}" for view in range(len(cameras))]
        write_index(home / f"transforms_{split}.json", cameras, names)
        for view, name in enumerate(names):
            stem = home / name
            mask = images["mask"][view]
            write_png(
                stem.with_suffix(".png"),
                torch.cat([srgb_from_linear(images["radiance"][view]), mask], -1),
            )
            if not maps:
                continue
            colour = srgb_from_linear(images["basecolor"][view])
            write_png(stem.with_name(f"{stem.name}_albedo.png"), colour)
            nothing = torch.zeros_like(mask)
            orm = torch.cat([nothing, images["roughness"][view], images["metallic"][view]], -1)
            write_png(stem.with_name(f"{stem.name}_orm.png"), orm)
            normal = images["normal_world"][view] @ UPRIGHT
            write_png(stem.with_name(f"{stem.name}_normal.png"), 0.5 * normal + 0.5)
            if split == "test":
                relit = torch.cat([2.0 * images["radiance"][view], mask], -1)
                planes = {channel: relit[..., i].numpy() for i, channel in enumerate("RGBA")}
                write_exr(stem.with_name(f"{stem.name}_sun.exr"), planes)
    if maps:
        (home / "lights").mkdir()
        # Blender shows +x in the middle: this lamp stands there.
        light = spot_light((0.0, 0.0, -1.0))
        write_rgb(home / "lights" / "sun.exr", light.numpy())
    if mesh is not None:
        write_mesh(home / mesh)


def write_orb(root: Path) -> None:
    """Two captures of one object."""
    for scene, exposure in (("ball_scene001", 1.0), ("ball_scene002", 2.0)):
        home, truth = root / "blender_HDR" / scene, root / "ground_truth" / scene
        for split in ("train", "test"):
            cameras = our_cameras(split)
            images = sphere_images(cameras)
            for folder in (home / split, home / f"{split}_mask", truth / "env_map"):
                folder.mkdir(parents=True, exist_ok=True)
            names = [f"./{split}/{view:04d}" for view in range(len(cameras))]
            write_index(home / f"transforms_{split}.json", cameras, names)
            for view in range(len(cameras)):
                radiance = exposure * images["radiance"][view] + 0.2 * (1 - images["mask"][view])
                write_rgb(home / split / f"{view:04d}.exr", radiance.numpy())
                write_png(home / f"{split}_mask" / f"{view:04d}.png", images["mask"][view])
                if split == "test":  # a lamp behind what the camera looks at
                    light = spot_light((0.0, 0.0, -1.0))
                    write_rgb(truth / "env_map" / f"{view:04d}.exr", light.numpy())
        other = "ball_scene002" if scene.endswith("1") else "ball_scene001"
        names = [f"./test/{view:04d}" for view in range(2)]
        write_index(
            home / "transforms_novel.json",
            our_cameras("test"),
            names,
            scene_name=other,
            camera_angle_x=math.radians(FOV_DEG),
        )
        write_mesh(truth / "mesh_blender" / "mesh.obj")
        write_orb_maps(truth)


def write_orb_maps(truth: Path) -> None:
    """Albedo, normals in camera axes and depth in the world's units, of the test views."""
    cameras = our_cameras("test")
    images = sphere_images(cameras)
    for folder in ("pseudo_gt_albedo", "surface_normal", "z_depth"):
        (truth / folder).mkdir(parents=True)
    for view in range(len(cameras)):
        name = f"{view:04d}"
        colour = srgb_from_linear(images["basecolor"][view])
        write_png(truth / "pseudo_gt_albedo" / f"{name}.png", colour)
        normal = images["normal_world"][view] @ cameras.c2w[view, :3, :3]
        np.save(truth / "surface_normal" / f"{name}.npy", normal.numpy())
        depth = torch.where(images["mask"][view] > 0, SIZE * sphere_depth(cameras, view), -1.0)
        np.save(truth / "z_depth" / f"{name}.npy", depth[..., 0].numpy())


def sphere_depth(cameras: Cameras, view: int) -> torch.Tensor:
    """Along the camera's -z axis, our units; only the ball's pixels mean something."""
    origin, direction = cameras.rays(view)
    along = -(origin * direction).sum(-1, keepdim=True)
    gap = RADIUS**2 - ((origin * origin).sum(-1, keepdim=True) - along**2)
    distance = along - gap.clamp_min(0).sqrt()
    forward = -cameras.c2w[view, :3, 2]
    return (distance * direction @ forward[:, None]).view(cameras.height, cameras.width, 1)
