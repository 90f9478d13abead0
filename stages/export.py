"""Textured mesh to finished files: GLB, on request OBJ, and the environment that belongs to it.

Reads the textured mesh or, when phase 3 was skipped, colours the surface per vertex; writes
`asset.glb` and `environment.exr`. The GLB is opened again by another reader (trimesh) and compared.
"""

from pathlib import Path

import torch
from torch import Tensor

from stages.artifacts import ExportedAsset, FittedField, RefinedSurface, TexturedMesh
from stages.base import Context, Stage
from stages.errors import InputError
from stages.settings.export import ExportConfig
from svim3d.color import srgb_from_linear
from svim3d.io.exr import write_rgb
from svim3d.io.glb import glb_bytes, reopen_glb
from svim3d.io.obj import obj_files
from svim3d.mesh.cleanup import clean_surface, decimate, is_closed
from svim3d.mesh.mesh import signed_volume, vertex_normals
from svim3d.mesh.texels import rasterize_uv
from svim3d.numerics import normalize
from svim3d.shading.environment import latlong_from_octahedral

NAME = "asset"
ENVIRONMENT_HEIGHT = 128  # rows of the lat-long picture; an octahedral map of 128^2 holds no more
MIN_AREA_SHARE, MIN_EXTENT_SHARE = 0.002, 0.05  # of floaters, the defaults of uv_bake
POINTS_PER_CHUNK = 2**17  # bounds the memory of the field's intermediate values
POSITION_TOLERANCE = 1e-6  # world units; the file holds the same 32-bit floats
TEXTURE_TOLERANCE = 1.01 / 255.0  # one step of 8 bits and its rounding


def run(
    field: FittedField,
    surface: RefinedSurface | None,
    textured: TexturedMesh | None,
    *,
    config: ExportConfig,
    ctx: Context,
) -> ExportedAsset:
    """Write the asset's files.

    Raises:
        InputError: there is no mesh to write.
        RuntimeError: the written GLB does not read back as what was written.
    """
    mesh = textured
    if mesh is None:
        mesh = _colored(surface if surface is not None else field.own_surface(), config, ctx)
    if not len(mesh.faces):
        raise InputError("wanted a mesh to export, got one without faces; run uv_bake again")
    content = glb_bytes(
        vertices=mesh.vertices,
        faces=mesh.faces,
        normals=mesh.normals,
        basecolor=mesh.basecolor,
        orm=mesh.orm,
        uv=mesh.uv,
        tangents=mesh.tangents,
        normal_tangent=mesh.normal_tangent,
        name=NAME,
    )
    _check(content, mesh)
    files = {f"{NAME}.glb": content}
    if "obj" in config.formats:
        files |= obj_files(
            vertices=mesh.vertices,
            faces=mesh.faces,
            normals=mesh.normals,
            basecolor=mesh.basecolor,
            orm=mesh.orm,
            uv=mesh.uv,
            normal_tangent=mesh.normal_tangent,
            name=NAME,
        )
    light = surface.environment if surface is not None else field.environment
    files["environment.exr"] = _environment_exr(light, ctx.work)
    return ExportedAsset(files, _summary(mesh, len(content)))


def _colored(fitted: RefinedSurface, config: ExportConfig, ctx: Context) -> TexturedMesh:
    """The surface with materials and shading normals per vertex: the asset without phase 3."""
    fine = clean_surface(
        fitted.vertices,
        fitted.faces,
        min_area_share=MIN_AREA_SHARE,
        min_extent_share=MIN_EXTENT_SHARE,
    )
    if not len(fine.faces):
        raise InputError(
            f"wanted a surface to export, got {len(fitted.faces)} faces of which none is sound; "
            "run the earlier stages longer or check the masks of the views"
        )
    coarse = decimate(fine.vertices, fine.faces, max_faces=config.vertex_color_faces)
    for note in (*fine.notes, *coarse.notes):
        ctx.event("mesh", note)
    geometric = vertex_normals(coarse.vertices, coarse.faces)
    materials = fitted.material_field(ctx.device)
    colors, orms, normals = [], [], []
    size = ctx.chunk(POINTS_PER_CHUNK)
    with torch.no_grad():
        for low in range(0, len(geometric), size):
            part = slice(low, low + size)
            found = materials(coarse.vertices[part].to(ctx.device))
            colors.append(found.basecolor.cpu())
            open_sky = torch.ones_like(found.roughness)
            orms.append(torch.cat([open_sky, found.roughness, found.metallic], 1).cpu())
            normals.append(normalize(geometric[part] + found.bump.cpu()))
    return TexturedMesh(
        vertices=coarse.vertices,
        faces=coarse.faces,
        normals=torch.cat(normals),
        uv=None,
        tangents=None,
        basecolor=torch.cat(colors),
        orm=torch.cat(orms),
        normal_tangent=None,
    )


def _check(content: bytes, mesh: TexturedMesh) -> None:
    """Compare the reopened GLB with what went in."""
    found = reopen_glb(content)
    if found.vertices.shape != mesh.vertices.shape or found.faces.shape != mesh.faces.shape:
        raise RuntimeError(
            f"asset.glb reads back with {len(found.vertices)} vertices and {len(found.faces)} "
            f"faces instead of {len(mesh.vertices)} and {len(mesh.faces)}"
        )
    errors: dict[str, tuple[Tensor, Tensor | None, float]] = {
        "positions": (mesh.vertices, found.vertices, POSITION_TOLERANCE),
        "basecolor": (
            srgb_from_linear(mesh.basecolor) if mesh.uv is not None else mesh.basecolor,
            srgb_from_linear(found.basecolor) if mesh.uv is not None else found.basecolor,
            TEXTURE_TOLERANCE,
        ),
    }
    if mesh.uv is not None:
        errors["uv"] = (mesh.uv, found.uv, POSITION_TOLERANCE)
        errors["orm"] = (mesh.orm, found.orm, TEXTURE_TOLERANCE)
    if mesh.normal_tangent is not None:
        # Decoded normals span [-1, 1], so a step is twice as large.
        errors["normals"] = (mesh.normal_tangent, found.normal_tangent, 2 * TEXTURE_TOLERANCE)
    for name, (wanted, got, tolerance) in errors.items():
        error = torch.inf if got is None else float((wanted - got).abs().max())
        if not error <= tolerance:
            raise RuntimeError(f"asset.glb reads back with {name} off by {error:.3g}")


def _environment_exr(radiance: Tensor, work: Path) -> bytes:
    """The light that the materials were fitted with, as a half-float lat-long EXR."""
    file = work / "environment.exr"  # OpenEXR writes files only
    latlong = latlong_from_octahedral(radiance, height=ENVIRONMENT_HEIGHT)
    write_rgb(file, latlong.numpy(), half=True)
    content = file.read_bytes()
    file.unlink()
    return content


def _summary(mesh: TexturedMesh, size_bytes: int) -> dict[str, float | int | str | bool]:
    """Counts and checks for the run's table."""
    _, index = torch.unique(mesh.vertices, dim=0, return_inverse=True)
    low, high = mesh.vertices.amin(0), mesh.vertices.amax(0)
    summary: dict[str, float | int | str | bool] = {
        "faces": len(mesh.faces),
        "vertices": len(mesh.vertices),
        "materials": "texture" if mesh.uv is not None else "vertex",
        "glb_bytes": size_bytes,
        "watertight": is_closed(index[mesh.faces.long()]),
        "volume": float(signed_volume(mesh.vertices, mesh.faces)),
        "longest_side": float((high - low).max()),
    }
    if mesh.uv is not None:
        size = mesh.basecolor.shape[0]
        texels = rasterize_uv(mesh.uv, mesh.faces, size)
        summary |= {
            "texture_size": size,
            "atlas_coverage": len(texels.pixel) / size**2,
            "atlas_overlaps": texels.overlaps,
        }
    return summary


EXPORT = Stage(run)
