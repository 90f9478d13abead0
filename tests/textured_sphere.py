"""A sphere of radius 0.5 as a GLB with textures: red on the left, gold on the right."""

import math

import torch

from stages.artifacts import ExportedAsset
from svim3d.io.glb import glb_bytes
from svim3d.mesh.lathe import revolve

LEFT, RIGHT = (0.6, 0.05, 0.04), (1.0, 0.71, 0.29)
ROUGH, SMOOTH = 0.75, 0.35


def sphere_glb(texture=64, rows=33):
    """`texture` texels a side; 0 paints the vertices of a red sphere instead."""
    angle = torch.linspace(-math.pi / 2, math.pi / 2, rows)
    profile = torch.stack([angle.cos(), angle.sin()], 1)
    profile[[0, -1], 0] = 0.0
    body = revolve(profile * 0.5, rounds=0, segments=2 * rows)
    parts = {"vertices": body.vertices, "faces": body.faces, "normals": body.normals}
    if not texture:
        count = len(body.vertices)
        return glb_bytes(
            **parts,
            basecolor=torch.tensor(LEFT).expand(count, 3),
            orm=torch.tensor([1.0, ROUGH, 0.0]).expand(count, 3),
        )
    # Seen from +z, x runs from the left of the picture to its right.
    uv = body.vertices[:, :2] * torch.tensor([1.0, -1.0]) + 0.5
    is_left = (torch.arange(texture) < texture // 2)[None, :, None].expand(texture, texture, 1)
    basecolor = torch.where(is_left, torch.tensor(LEFT), torch.tensor(RIGHT))
    orm = torch.where(is_left, torch.tensor([1.0, ROUGH, 0.0]), torch.tensor([1.0, SMOOTH, 1.0]))
    return glb_bytes(**parts, uv=uv, basecolor=basecolor, orm=orm)


def sphere_asset(texture=64, **files):
    return ExportedAsset({"asset.glb": sphere_glb(texture)} | files, {"faces": 1})
