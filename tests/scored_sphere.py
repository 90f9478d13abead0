"""A small truth to hold assets against: the painted sphere in the layout of benchmark orbits."""

import json
import math
from pathlib import Path

import torch
import trimesh
from sphere_orbit import RADIUS, sphere_cameras, sphere_images

from stages.artifacts import ExportedAsset
from svim3d.cameras import Cameras
from svim3d.io.exr import write_rgb
from svim3d.io.glb import glb_bytes
from svim3d.io.image import write_png
from svim3d.io.orbit import write_orbit
from svim3d.mesh.lathe import Body, revolve

COLOUR, ROUGHNESS, METALLIC = (0.75, 0.375, 0.1875), 0.5, 0.0
LIGHTS = {"A": 0.5, "B": 1.0, "C": 0.25}  # even radiance from everywhere


def ball(radius: float = RADIUS, segments: int = 96) -> Body:
    angle = torch.linspace(-math.pi / 2, math.pi / 2, 49)
    profile = radius * torch.stack([angle.cos(), angle.sin()], 1)
    profile[[0, -1], 0] = 0.0
    return revolve(profile, rounds=0, segments=segments)


def plain_images(cameras: Cameras, light: float) -> dict[str, torch.Tensor]:
    """The sphere in one material, as bright as its basecolor times the light."""
    images = sphere_images(cameras)
    mask = images["mask"]
    images["basecolor"] = torch.tensor(COLOUR) * mask
    images["radiance"] = light * images["basecolor"]
    images["roughness"] = ROUGHNESS * mask
    images["metallic"] = METALLIC * mask
    return images


def write_truth(folder: Path, *, views: int = 4, size: int = 32) -> Path:
    """Everything that scores are taken from, and a photo."""
    cameras = {"train": sphere_cameras(views, size), "test": sphere_cameras(2, size)}
    index = {}
    for split, light in (("train", "A"), ("test_A", "A"), ("test_B", "B"), ("test_C", "C")):
        seen = cameras[split.partition("_")[0]]
        images = plain_images(seen, LIGHTS[light])
        write_orbit(folder / split, seen, images, reference=len(seen) - 1)
        index[split] = json.loads((folder / split / "orbit.json").read_text())
        (folder / split / "orbit.json").unlink()
        if split == "train":
            photo = torch.cat([images["radiance"], images["mask"]], -1)[-1]
            write_png(folder / "reference.png", photo.clamp(0.0, 1.0))
    for light, radiance in LIGHTS.items():
        write_rgb(folder / f"env_{light}.exr", torch.full((16, 32, 3), radiance).numpy())
    mesh = ball()
    trimesh.Trimesh(mesh.vertices.numpy(), mesh.faces.numpy(), process=False).export(
        folder / "mesh.ply"
    )
    page = {
        "camera": index["train"]["camera"],
        "train": [{**f, "file": f"train/{f['file']}"} for f in index["train"]["frames"]],
        "test": [
            {**f, "files": {n: f"test_{n}/{f['file']}" for n in LIGHTS}}
            for f in index["test_A"]["frames"]
        ],
        "environments": {name: {"file": f"env_{name}.exr"} for name in LIGHTS},
        "reference": {"file": "reference.png", "train_index": views - 1},
    }
    (folder / "orbit.json").write_text(json.dumps(page))
    return folder


def ball_asset(radius: float = RADIUS, colour: tuple[float, ...] = COLOUR) -> ExportedAsset:
    body = ball(radius)
    count = len(body.vertices)
    glb = glb_bytes(
        vertices=body.vertices,
        faces=body.faces,
        normals=body.normals,
        basecolor=torch.tensor(colour).expand(count, 3),
        orm=torch.tensor([1.0, ROUGHNESS, METALLIC]).expand(count, 3),
    )
    return ExportedAsset({"asset.glb": glb}, {})
