"""Written files held against what went into them."""

from dataclasses import replace

import torch
from torch import Tensor

from stages.artifacts import TexturedMesh
from svim3d.color import srgb_from_linear
from svim3d.io.glb import ReopenedGlb, reopen_glb
from svim3d.io.glb_small import POSITION_STEP, UV_STEP
from svim3d.io.gltf import parse_glb
from svim3d.io.texture_files import full_orm
from svim3d.io.usd import ReopenedUsd, reopen_usdz

POSITION_TOLERANCE = 1e-6  # world units; the file holds the same 32-bit floats
TEXTURE_TOLERANCE = 1.01 / 255.0  # one step of 8 bits and its rounding
# Decoded normals span [-1, 1], so a step is twice as large.
NORMAL_TOLERANCE = 2 * TEXTURE_TOLERANCE
PICTURE = 3  # dimensions of a material's values

Compared = dict[str, tuple[Tensor, Tensor | None, float]]  # wanted, got, largest error


def check_glb(content: bytes, mesh: TexturedMesh) -> None:
    """Compare the GLB, as trimesh reads it, with the mesh.

    Raises:
        RuntimeError: naming what is off.
    """
    found = reopen_glb(content)
    _require_size("asset.glb", found.vertices, found.faces, mesh)
    compared = _compared(mesh, found)
    if mesh.orm.ndim != 2:
        compared["orm"] = (full_orm(mesh), found.orm, TEXTURE_TOLERANCE)
    _require_equal("asset.glb", compared)


def check_usdz(content: bytes, mesh: TexturedMesh) -> None:
    """Compare the package, as OpenUSD reads it, with the mesh.

    Raises:
        RuntimeError: naming what is off.
    """
    found = reopen_usdz(content)
    _require_size("asset.usdz", found.vertices, found.faces, mesh)
    if mesh.basecolor.ndim != PICTURE:
        found = replace(found, basecolor=found.basecolor.view_as(mesh.basecolor))
    compared = _compared(mesh, found)
    compared["vertex normals"] = (mesh.normals, found.normals, POSITION_TOLERANCE)
    if mesh.orm.ndim != 2:
        planes = (found.occlusion, found.roughness, found.metallic)
        for name, plane, got in zip(
            ("occlusion", "roughness", "metallic"), full_orm(mesh).unbind(-1), planes, strict=True
        ):
            compared[name] = (plane, got.squeeze(-1) if got.ndim else got, TEXTURE_TOLERANCE)
    _require_equal("asset.usdz", compared)


def check_quantised(content: bytes, mesh: TexturedMesh) -> None:
    """Compare the geometry of a quantised GLB, as our reader has it, with the mesh.

    Raises:
        RuntimeError: naming what is off.
    """
    found = parse_glb(content)
    _require_size("asset_small.glb", found.vertices, found.faces, mesh)
    side = float((mesh.vertices.amax(0) - mesh.vertices.amin(0)).max())
    compared: Compared = {"positions": (mesh.vertices, found.vertices, side * POSITION_STEP)}
    if mesh.uv is not None:
        compared["uv"] = (mesh.uv, found.uv, UV_STEP)
    _require_equal("asset_small.glb", compared)


def _compared(mesh: TexturedMesh, found: ReopenedGlb | ReopenedUsd) -> Compared:
    """What all formats of a textured mesh have in common."""
    basecolor = mesh.basecolor, found.basecolor
    if mesh.basecolor.ndim == PICTURE:
        basecolor = srgb_from_linear(basecolor[0]), srgb_from_linear(basecolor[1])
    compared: Compared = {
        "positions": (mesh.vertices, found.vertices, POSITION_TOLERANCE),
        "basecolor": (*basecolor, TEXTURE_TOLERANCE),
    }
    if mesh.uv is not None:
        compared["uv"] = (mesh.uv, found.uv, POSITION_TOLERANCE)
    if mesh.normal_tangent is not None:
        compared["normals"] = (mesh.normal_tangent, found.normal_tangent, NORMAL_TOLERANCE)
    return compared


def _require_size(name: str, vertices: Tensor, faces: Tensor, mesh: TexturedMesh) -> None:
    if vertices.shape != mesh.vertices.shape or faces.shape != mesh.faces.shape:
        raise RuntimeError(
            f"{name} reads back with {len(vertices)} vertices and {len(faces)} "
            f"faces instead of {len(mesh.vertices)} and {len(mesh.faces)}"
        )


def _require_equal(file: str, compared: Compared) -> None:
    for name, (wanted, got, tolerance) in compared.items():
        error = torch.inf if got is None else float((wanted - got).abs().max())
        if not error <= tolerance:
            raise RuntimeError(f"{file} reads back with {name} off by {error:.3g}")
