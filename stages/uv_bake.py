"""Phase 3: cleanup, decimation, atlas, and textures baked from the material field.

Reads the views, the surface of phase 2 (or phase 1's own when that was skipped) and the material
field, writes a `TexturedMesh`. Every texel is projected back onto the original surface, where the
field is asked and the normal is taken; so decimation costs little colour and relief. Then
basecolor, roughness and metallic are sharpened against the views by least squares. Tangent frames:
MikkTSpace; atlas: xatlas with a time limit, box projection beyond it.

On request the asset is no more than the views ask for: fewer faces, constants and palettes instead
of textures, smaller textures. What was chosen, and the figures behind it, are told as events.
"""

from dataclasses import replace
from functools import cache

import torch
from jaxtyping import Float
from torch import Tensor

from stages.artifacts import FittedField, MaterialViews, RefinedSurface, TexturedMesh
from stages.base import Context, Stage
from stages.capacity_plan import CapacityPlan, bounded
from stages.errors import InputError
from stages.settings.uv_bake import UvBakeConfig
from svim3d.mesh.atlas import unwrap
from svim3d.mesh.cleanup import CleanMesh, clean_surface, decimate
from svim3d.mesh.frames import tangent_frames, tangent_from_world
from svim3d.mesh.mesh import vertex_normals
from svim3d.mesh.projection import project_onto
from svim3d.mesh.texels import Texels, average_down, rasterize_uv, to_image
from svim3d.numerics import normalize
from svim3d.render.face_budget import UNSEEN, ShapePictures, decimate_to_error
from svim3d.render.material_maps import BakedTexels, Wanted, material_maps
from svim3d.render.occlusion import ambient_occlusion
from svim3d.render.texture_fit import fit_texels, texel_view
from svim3d.render.view_pixels import ViewPixels
from svim3d.render.view_warps import ViewCorrections, read_through

POINTS_PER_CHUNK = 2**17  # bounds the memory of the field's intermediate values
# Steps of the fits by which forms are compared, at least: they begin at a constant, not at a bake.
JUDGED_ITERATIONS = 20
SOLID = 0.99  # coverage of a pixel that holds no background


def run(
    views: MaterialViews,
    field: FittedField,
    surface: RefinedSurface | None,
    plan: CapacityPlan | None = None,
    *,
    config: UvBakeConfig,
    ctx: Context,
) -> TexturedMesh:
    """Bake the field onto a mesh and sharpen its textures against the views.

    With a plan sizes are upper bounds.

    Raises:
        InputError: there is no surface to bake.
    """
    config = bounded(config, plan, ctx)
    fitted = surface if surface is not None else field.own_surface()
    fine = clean_surface(
        fitted.vertices,
        fitted.faces,
        min_area_share=config.min_area_share,
        min_extent_share=config.min_extent_share,
    )
    if not len(fine.faces):
        raise InputError(
            f"wanted a surface to bake, got {len(fitted.faces)} faces of which none is sound; "
            "run the earlier stages longer or check the masks of the views"
        )
    coarse = _decimated(fine, views, config, ctx)
    for note in (*fine.notes, *coarse.notes):
        ctx.event("mesh", note)
    ctx.report(1, 4, {"faces_fine": len(fine.faces), "faces": len(coarse.faces)})

    mesh, texels = _unwrapped(coarse, config, ctx)
    ctx.report(2, 4, {"vertices": len(mesh.vertices), "texels": len(texels.pixel)})

    values = _bake(mesh, texels, fine, fitted, ctx)
    ctx.report(3, 4, {})
    openness = _openness(mesh, field, config.occlusion_rays)
    values = torch.cat([values, texels.interpolate(mesh.faces, openness)], 1)
    values, texels = average_down(values, texels, config.supersample)
    corrections = fitted.corrections if config.correct_views else None
    pixels_at = cache(lambda size: _seen(mesh, size, views, corrections))
    unfitted, local, occlusion = values.split([5, 3, 1], 1)
    sharpened = unfitted
    if config.fit_iterations:
        sharpened = _sharpened(unfitted, texels, pixels_at(texels.size), config)
    baked = BakedTexels(sharpened, unfitted, occlusion, local, mesh, texels)
    maps = material_maps(baked, pixels_at, views.normal_world, _wanted(config))
    for name, note in maps.notes.items():
        ctx.event("material", f"{name}: {note}", tell=False)
    ctx.report(4, 4, {"coverage": len(texels.pixel) / texels.size**2})
    return replace(
        mesh,
        basecolor=maps.basecolor,
        orm=maps.orm,
        orm_factor=maps.orm_factor,
        normal_tangent=maps.normal_tangent,
    ).without_needless_seams()


def _wanted(config: UvBakeConfig) -> Wanted:
    """How the settings have the maps made."""
    return Wanted(
        nested=config.materials == "nested",
        sized=config.texture_sizes == "evidence",
        prior=config.fit_prior,
        iterations=max(config.fit_iterations, JUDGED_ITERATIONS),
        sharpened=config.fit_iterations,
        lost_db=config.materials_lost_db,
    )


def _decimated(
    fine: CleanMesh, views: MaterialViews, config: UvBakeConfig, ctx: Context
) -> CleanMesh:
    """At most `max_faces`, and where evidence counts no more than the views would miss."""
    if config.faces == "fixed":
        return decimate(fine.vertices, fine.faces, max_faces=config.max_faces)
    found = decimate_to_error(
        fine.vertices,
        fine.faces,
        ShapePictures.of_views(views.cameras, views.mask, views.normal_world),
        limit=UNSEEN,
        max_faces=config.max_faces,
    )
    ctx.event(
        "faces",
        f"{len(found.mesh.faces)} of at most {config.max_faces} faces: against the whole surface "
        f"the views see {found.error.silhouette:.2%} less of the silhouettes and normals "
        f"{found.error.normal_deg:.2f} deg farther off ({UNSEEN.silhouette:.1%} and "
        f"{UNSEEN.normal_deg:.0f} deg are allowed)",
        tell=False,
    )
    return found.mesh


def _unwrapped(
    coarse: CleanMesh, config: UvBakeConfig, ctx: Context
) -> tuple[TexturedMesh, Texels]:
    """The decimated mesh with normals, uv and tangents, textures still empty; and its texels."""
    atlas = unwrap(
        coarse.vertices,
        coarse.faces,
        texture_size=config.texture_size,
        gutter_px=config.gutter_px,
        timeout_s=config.atlas_timeout_s,
    )
    if atlas.fallback is not None:
        ctx.event("atlas", f"charts by box projection: {atlas.fallback}")
    ctx.report(1, 4, {"charts": atlas.charts})
    smooth = vertex_normals(coarse.vertices, coarse.faces)
    vertices, normals = (a[atlas.vertex_source.long()] for a in (coarse.vertices, smooth))
    frames = tangent_frames(vertices, atlas.faces, normals, atlas.uv)
    source = frames.vertex_source.long()
    mesh = TexturedMesh(
        vertices=vertices[source],
        faces=frames.faces,
        normals=normals[source],
        uv=atlas.uv[source],
        tangents=frames.tangents,
        basecolor=vertices.new_zeros(0, 3),
        orm=vertices.new_zeros(0, 3),
        normal_tangent=None,
    )
    if config.supersample == 1:
        return mesh, atlas.texels
    return mesh, rasterize_uv(
        atlas.uv[source], frames.faces, atlas.texels.size * config.supersample
    )


def _bake(
    mesh: TexturedMesh,
    texels: Texels,
    fine: CleanMesh,
    fitted: RefinedSurface,
    ctx: Context,
) -> Float[Tensor, "P 8"]:
    """Basecolor (linear), roughness, metallic and tangent-space normal of every texel.

    The shading normal is that of the field: geometric normal of the fine surface plus bump.
    """
    normal, tangent, bitangent = mesh.frame(texels)
    points = texels.interpolate(mesh.faces, mesh.vertices)
    hits = project_onto(points, normal, fine.vertices, fine.faces)
    points = hits.interpolate(fine.faces, fine.vertices)
    geometric = hits.interpolate(fine.faces, vertex_normals(fine.vertices, fine.faces))
    materials = fitted.material_field(ctx.device)
    chunks, size = [], ctx.chunk(POINTS_PER_CHUNK)
    with torch.no_grad():
        for low in range(0, len(points), size):
            part = slice(low, low + size)
            found = materials(points[part].to(ctx.device))
            shading = normalize(normalize(geometric[part]) + found.bump.cpu())
            local = tangent_from_world(shading, normal[part], tangent[part], bitangent[part])
            surface = torch.cat([found.basecolor, found.roughness, found.metallic], 1).cpu()
            chunks.append(torch.cat([surface, local], 1))
    return torch.cat(chunks)


def _seen(
    mesh: TexturedMesh,
    texture_size: int,
    views: MaterialViews,
    corrections: ViewCorrections | None,
) -> ViewPixels:
    """What the views say of basecolor, roughness and metallic, and how far it counts.

    Pixels at the rim of the mask are left out, slanted ones count by the cosine squared, all of
    them by their confidence. Views are read through their warps, if they have any.
    """
    assert mesh.uv is not None
    seen = texel_view(mesh.vertices, mesh.faces, mesh.uv, views.cameras, texture_size=texture_size)
    images = torch.cat([views.basecolor, views.roughness, views.metallic, views.mask], -1)
    if views.confidence is not None:
        images = torch.cat([images, views.confidence], -1)
    flat = images.reshape(-1, images.shape[-1])
    count, height, width, _ = views.mask.shape
    if corrections is None:
        shown, vouched = flat[seen.pixel], None
    else:
        shown, vouched = read_through(corrections, flat, seen.pixel, height, width)
    target, mask, confidence = shown.split([5, 1, shown.shape[1] - 6], 1)
    weight = (mask >= SOLID) * seen.trust.clamp_min(0.0) ** 2
    for further in (confidence, vouched):
        if further is not None and further.shape[1]:
            weight = weight * further
    return ViewPixels(
        operator=seen.operator,
        pixel=seen.pixel,
        target=target,
        weight=weight,
        shape=(count, height, width),
        texture_size=texture_size,
    )


def _sharpened(
    baked: Float[Tensor, "P 5"], texels: Texels, pixels: ViewPixels, config: UvBakeConfig
) -> Float[Tensor, "P 5"]:
    """Texels whose rendered pixels agree with the views; those that no view sees stay as baked."""
    fitted = fit_texels(
        pixels.operator,
        pixels.target,
        pixels.weight,
        to_image(baked, texels).view(-1, 5),
        prior=config.fit_prior,
        iterations=config.fit_iterations,
    )
    return fitted[texels.pixel]


def _openness(mesh: TexturedMesh, field: FittedField, rays: int) -> Float[Tensor, "N 1"]:
    """Share of the sky that each vertex sees; one everywhere without rays.

    Per vertex suffices: occlusion varies slowly, and the vertices are a hundredth of the texels.
    """
    if rays == 0:
        return torch.ones(len(mesh.vertices), 1)
    return ambient_occlusion(
        mesh.vertices, mesh.normals, field.sdf, half_extent=field.half_extent, rays=rays
    )


UV_BAKE = Stage(run)
