"""Generation: whatever shows the object -> views with materials.

Reads a photo, of whose prepared object the diffusion model draws an orbit; or an orbit folder
(path-traced, photographed or generated elsewhere); or a mesh file (.glb, .gltf, .obj) or a scene
file (.json) that our own renderer turns into an orbit under an environment. Rendered radiance is a
split-sum approximation without visibility: no shadows, no interreflection.
"""

from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from stages.artifacts import MaterialViews
from stages.base import Context, Stage
from stages.errors import InputError
from stages.photo_artifact import PreparedPhoto
from stages.prefilter_cache import cached_operator
from stages.settings.generation import GenerationConfig
from svim3d.cameras import fitting_radius, orbit_angles, orbit_cameras
from svim3d.io.light import read_light
from svim3d.io.orbit import read_orbit
from svim3d.io.orbit_repair import admit_views
from svim3d.io.scene import read_object
from svim3d.mesh.source_mesh import SourceMesh, normalised
from svim3d.render.deferred import environment_shader
from svim3d.render.outlines import sharpened, without_bleed
from svim3d.render.pictures import render_pictures
from svim3d.render.view_findings import SOFT_MASKS, SOFT_PX, ramp_width_px, view_findings
from svim3d.shading.octahedral import texel_directions
from svim3d.shading.studio import studio_radiance


def run(
    source: Path,
    prepared: PreparedPhoto | None = None,
    *,
    config: GenerationConfig,
    ctx: Context,
) -> MaterialViews:
    """Views of the object in `source`, or of the object that was cut out of it.

    Raises:
        InputError: the source cannot be used; says what was wanted, what came, what to do.
    """
    if not source.exists():
        raise InputError(
            f"wanted a photo, an orbit folder, a mesh or a scene, but {source} does not exist; "
            "check the path"
        )
    try:
        views = _views(source, prepared, config, ctx)
    except InputError:
        raise
    except ValueError as error:
        raise InputError(str(error)) from error
    images = {name: image for name, image in vars(views).items() if isinstance(image, Tensor)}
    for kind, message in view_findings(views.cameras, images):
        if prepared is None or kind != SOFT_MASKS:  # nobody can give a generator sharper ones
            ctx.event(kind, message)
    return views


def _views(
    source: Path, prepared: PreparedPhoto | None, config: GenerationConfig, ctx: Context
) -> MaterialViews:
    """Drawn of a photo, read from a folder, or rendered."""
    if prepared is not None:
        # The diffusion libraries take seconds to import, and only photos need them.
        from stages.orbit_drawing import views_of_photo

        return views_of_photo(prepared, config=config, ctx=ctx)
    if source.is_dir():
        return _from_orbit(source, ctx)
    return _from_mesh(normalised(read_object(source), source.name), config, ctx)


def _from_orbit(folder: Path, ctx: Context) -> MaterialViews:
    """Read, mend and check the views of an orbit folder."""
    cameras, images, reference = read_orbit(folder, notify=ctx.event)
    cameras, images, reference = admit_views(cameras, images, reference, ctx.event)
    return MaterialViews(cameras=cameras, reference=reference, **_with_clean_outlines(images, ctx))


def _with_clean_outlines(images: dict[str, Tensor], ctx: Context) -> dict[str, Tensor]:
    """Outlines as sharp as a pixel, without the background that they were cut out of."""
    width = ramp_width_px(images["mask"])
    if width > SOFT_PX:
        ctx.event(
            SOFT_MASKS,
            f"masks fade over about {width:.1f} pixels: they are sharpened about half coverage, "
            "which the outline may miss by as much; give sharper masks",
        )
        images = sharpened(images, width)
    images, bled = without_bleed(images)
    if bled:
        ctx.event(
            "background_bleeds",
            f"the background shines through along outlines (basecolor is off by {bled:.2f}): "
            "half-covered pixels take those just inside; give views that were cut out cleanly",
        )
    return images


def _from_mesh(mesh: SourceMesh, config: GenerationConfig, ctx: Context) -> MaterialViews:
    """Render the orbit, one view at a time."""
    radius = config.radius or fitting_radius(mesh.vertices, config.fov_y_deg, config.fill)
    angles = orbit_angles(config.views, config.elevation_mean_deg, config.elevation_swing_deg)
    cameras = orbit_cameras(angles, radius=radius, fov_y_deg=config.fov_y_deg, size=config.size)
    light = _environment(config, ctx)
    shader = environment_shader(cached_operator(ctx.shared, config.environment_size)(light))
    views = []
    for view in range(len(cameras)):
        pictures = render_pictures(mesh, cameras[view], shader, supersample=config.supersample)
        views.append(pictures)
        ctx.report(view + 1, len(cameras), {"coverage": float(pictures["mask"].mean())})
    images = {name: torch.cat([pictures[name] for pictures in views]) for name in views[0]}
    # What a reload would read: the folder stores half floats, but for depth.
    images = {n: i if n == "depth" else i.half().float() for n, i in images.items()}
    cameras, images, reference = admit_views(cameras, images, len(cameras) - 1, ctx.event)
    return MaterialViews(cameras=cameras, reference=reference, **images)


def _environment(config: GenerationConfig, ctx: Context) -> Float[Tensor, "N N 3"]:
    """The light as an octahedral map."""
    if config.environment is None:
        return studio_radiance(texel_directions(config.environment_size))
    light = read_light(config.environment, ctx.event)
    return light.octahedral(config.environment_size)


GENERATION = Stage(run)
