"""Textured mesh to finished files: GLB, other formats on request, and the environment with it.

Reads the textured mesh or, when phase 3 was skipped, colours the surface per vertex; writes
`asset.glb` and `environment.exr`. On request: coarser levels of detail, a smaller GLB, OBJ, USDC,
USDZ, the textures alone, and the asset as layers in the cameras of the views. Each GLB is opened
again by another reader (trimesh) and compared.
"""

from collections.abc import Iterator
from pathlib import Path

import torch
from torch import Tensor

from stages.artifacts import ExportedAsset, FittedField, RefinedSurface, TexturedMesh
from stages.base import Context, Stage
from stages.errors import InputError
from stages.export_checks import check_glb
from stages.export_formats import NAME, other_files, writers_parts
from stages.finished_views import ViewFolder, finished_views
from stages.settings.export import ExportConfig
from svim3d.cameras import fitting_radius, orbit_angles, orbit_cameras
from svim3d.io.exr import write_rgb
from svim3d.io.glb import glb_bytes
from svim3d.mesh.cleanup import clean_surface, decimate, is_closed
from svim3d.mesh.mesh import signed_volume, vertex_normals
from svim3d.mesh.texels import rasterize_uv
from svim3d.numerics import normalize
from svim3d.render.face_budget import COARSER, ShapeError, ShapePictures, decimate_to_error
from svim3d.render.material_evidence import LARGEST_PALETTE
from svim3d.render.texture_transfer import transferred
from svim3d.shading.environment import latlong_from_octahedral

ENVIRONMENT_HEIGHT = 128  # rows of the lat-long picture; an octahedral map of 128^2 holds no more
MIN_AREA_SHARE, MIN_EXTENT_SHARE = 0.002, 0.05  # of floaters, the defaults of uv_bake
POINTS_PER_CHUNK = 2**17  # bounds the memory of the field's intermediate values
# Cameras that levels of detail are held against: the views that the asset came of are not at hand.
LOD_VIEWS, LOD_SWING_DEG, LOD_PICTURE_PX = 8, 30.0, 256
FOV_Y_DEG, FILL = 33.8, 0.85


def run(
    field: FittedField,
    surface: RefinedSurface | None,
    textured: TexturedMesh | None,
    views: ViewFolder,
    *,
    config: ExportConfig,
    ctx: Context,
) -> ExportedAsset:
    """Write the asset's files.

    Raises:
        InputError: there is no mesh to write.
        RuntimeError: a written file does not read back as what was written.
    """
    mesh = textured
    if mesh is None:
        mesh = _colored(surface if surface is not None else field.own_surface(), config, ctx)
    if not len(mesh.faces):
        raise InputError("wanted a mesh to export, got one without faces; run uv_bake again")
    files = {f"{NAME}.glb": _glb(mesh)}
    summary = _summary(mesh, len(files[f"{NAME}.glb"]))
    for level, (coarser, error) in enumerate(_coarser(mesh, config.lods), 1):
        name = f"{NAME}_lod{level}.glb"
        files[name] = _glb(coarser)
        summary[f"lod{level}_faces"] = len(coarser.faces)
        summary[f"lod{level}_glb_bytes"] = len(files[name])
        ctx.event(
            "lod",
            f"{name}: {len(coarser.faces)} faces, silhouettes {error.silhouette:.2%} and normals "
            f"{error.normal_deg:.1f} deg off asset.glb",
            tell=False,
        )
    files |= other_files(mesh, config, ctx)
    light = surface.environment if surface is not None else field.environment
    if "aov" in config.formats:
        files |= finished_views(files[f"{NAME}.glb"], views, light, ctx)
    files["environment.exr"] = _environment_exr(light, ctx.work)
    return ExportedAsset(files, summary)


def _glb(mesh: TexturedMesh) -> bytes:
    """The mesh as a file, checked."""
    content = glb_bytes(**writers_parts(mesh))
    check_glb(content, mesh)
    return content


def _coarser(mesh: TexturedMesh, levels: int) -> Iterator[tuple[TexturedMesh, ShapeError]]:
    """Levels of detail of growing error against the whole mesh, each of fewer faces.

    The sides of their textures are halved from level to level, as mipmaps are.
    """
    radius = fitting_radius(mesh.vertices, FOV_Y_DEG, FILL)
    angles = orbit_angles(LOD_VIEWS, 0.0, LOD_SWING_DEG)
    cameras = orbit_cameras(angles, radius=radius, fov_y_deg=FOV_Y_DEG, size=LOD_PICTURE_PX)
    whole, index = torch.unique(mesh.vertices, dim=0, return_inverse=True)
    welded = index[mesh.faces.long()].to(mesh.faces.dtype)
    pictures = ShapePictures.of_surface(whole, welded, cameras)
    most, shrink = len(welded), 1
    for limit in COARSER[:levels]:
        found = decimate_to_error(whole, welded, pictures, limit=limit, max_faces=most)
        coarser = found.mesh
        if len(coarser.faces) >= most:
            continue  # decimation has come to its end, or the limit asks for all of them
        most, shrink = len(coarser.faces), 2 * shrink
        yield transferred(mesh, coarser.vertices, coarser.faces, shrink=shrink), found.error


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
    painted = "vertex" if mesh.basecolor.ndim == 2 else "texture" if mesh.textures else "constant"
    summary: dict[str, float | int | str | bool] = {
        "faces": len(mesh.faces),
        "vertices": len(mesh.vertices),
        "materials": painted,
        "glb_bytes": size_bytes,
        "watertight": is_closed(index[mesh.faces.long()]),
        "volume": float(signed_volume(mesh.vertices, mesh.faces)),
        "longest_side": float((high - low).max()),
    }
    if mesh.orm_factor is not None:
        summary |= {f"{name}_map": form for name, form in _forms(mesh).items()}
    if mesh.uv is not None:
        size = max(len(image) for image in mesh.textures.values())
        texels = rasterize_uv(mesh.uv, mesh.faces, size)
        summary |= {
            "texture_size": size,
            "atlas_coverage": len(texels.pixel) / size**2,
            "atlas_overlaps": texels.overlaps,
        }
    return summary


def _forms(mesh: TexturedMesh) -> dict[str, str]:
    """What each map has become: a constant, a palette or a texture."""
    forms = {"normal": "none" if mesh.normal_tangent is None else "texture"}
    planes = {
        "basecolor": mesh.basecolor,
        "occlusion": mesh.orm[..., :1],
        "roughness": mesh.orm[..., 1:2],
        "metallic": mesh.orm[..., 2:],
    }
    for name, plane in planes.items():
        values = torch.unique(plane.reshape(-1, plane.shape[-1]), dim=0)
        few = "constant" if len(values) == 1 else f"palette of {len(values)}"
        forms[name] = few if len(values) <= LARGEST_PALETTE else f"texture of {len(plane)} px"
    return forms


EXPORT = Stage(run)
