"""Gallery: all that the report of a run shows and that takes computing.

Reads the photo and what was cut out of it, the views and the exported asset, each where there is
one. Writes a sheet of all views for each kind of picture, the same sheets of the asset seen by the
same cameras, a picture that stands for the asset where nothing can be drawn live, lights to turn it
in, and, where the asset is too large for a page, a copy with smaller textures. The asset goes
through its file, as in the preview stage.
"""

import json
import math
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import interpolate

from stages.artifacts import ExportedAsset, FinishedFiles, MaterialViews
from stages.base import Context, Stage
from stages.photo_artifact import PreparedPhoto
from stages.prefilter_cache import cached_operator
from stages.settings.gallery import GalleryConfig
from svim3d.cameras import Cameras
from svim3d.color import srgb_from_linear
from svim3d.io.exr import read_rgb
from svim3d.io.glb import read_mesh
from svim3d.io.gltf_shrink import shrink_glb
from svim3d.io.hdr import write_hdr
from svim3d.io.image import PAPER
from svim3d.io.photo import read_photo
from svim3d.io.thumbnail import encode_webp
from svim3d.mesh.source_mesh import SourceMesh
from svim3d.render.deferred import Shader, environment_shader
from svim3d.render.pictures import render_pictures
from svim3d.shading.environment import direction_from_latlong, octahedral_from_latlong
from svim3d.shading.showroom import night, noon, overcast
from svim3d.shading.studio import studio_radiance
from svim3d.shading.tonemap import agx

ASSET, LIGHT = "asset.glb", "environment.exr"  # files of the export
ABOUT, MODEL, POSTER = "gallery.json", "model.glb", "poster.webp"
FOUND = "found"  # the light that was fitted with the asset
LIGHTS = {"studio": studio_radiance, "noon": noon, "overcast": overcast, "night": night}
LIGHT_ROWS = 64  # of the lat-long pictures: a texel is 3 degrees, half the smallest lamp
LIGHT_SIZE = 64  # of the octahedral map that the asset is rendered in
CELL, COLUMNS = 192, 7  # side of each picture on a sheet, pixels, and pictures in a row
PHOTO_PX = 640  # longest side of the input
POSTER_PX = 480
# The asset is rendered at so many times the size it is shown in, and averaged down: half the time
# of four samples a pixel, and outlines are as smooth to the eye.
RENDERED = 1.5
THUMBNAIL_ROWS = 40
LEAST_COVERAGE = 1e-4  # guards the division that turns premultiplied into straight

Images = dict[str, Float[Tensor, "_ _ _ _"]]


class Gallery(FinishedFiles):
    """Pictures for a page: WebP sheets, Radiance lights, and `gallery.json`."""

    def headline(self) -> str:
        """How many pictures of how many views."""
        size = sum(len(content) for content in self.files.values()) / 2**20
        return f"{self.summary['views']} views, {self.summary['sheets']} sheets, {size:.1f} MiB"


def run(
    source: Path | None = None,
    photo: PreparedPhoto | None = None,
    views: MaterialViews | None = None,
    asset: ExportedAsset | None = None,
    *,
    config: GalleryConfig,
    ctx: Context,
) -> Gallery:
    """Draw what there is: the photo, its cut-out, the views, the asset as they see it."""
    files: dict[str, bytes] = {}
    about: dict[str, Any] = {"cell": CELL, "columns": COLUMNS, "views": [], "light": []}
    if source is not None:
        given = read_photo(source, ctx.event, longest_px=2 * PHOTO_PX)
        files["input.webp"] = _on_paper(given.rgb, given.mask)
    if photo is not None:
        files["cut_out.webp"] = _on_paper(photo.rgb, photo.mask)
    if views is not None:
        order = _order(views)
        files |= _sheets("views", _shown(views), views.cameras, order)
        about["views"] = [_angles(views.cameras, view) | {"view": view} for view in order]
    if asset is not None:
        light = _found_light(asset, ctx)
        about["light"] = [*([] if light is None else [FOUND]), *LIGHTS]
        files |= _lights(light, ctx) | _model(asset, config, ctx)
        if views is not None:
            files |= _of_asset(asset, light, views, order, ctx)
    files[ABOUT] = json.dumps(about, indent=1).encode()
    sheets = sum(name.startswith(("views/", "asset/")) for name in files)
    return Gallery(files, {"views": len(about["views"]), "sheets": sheets})


def _on_paper(rgb: Float[Tensor, "H W 3"], mask: Float[Tensor, "H W 1"] | None) -> bytes:
    """A photo, small; what is transparent shows the paper of all our sheets."""
    laid = rgb if mask is None else PAPER + mask * (rgb - PAPER)
    factor = PHOTO_PX / max(laid.shape[:2])
    if factor < 1.0:
        size = [max(1, round(side * factor)) for side in laid.shape[:2]]
        planes = laid.permute(2, 0, 1)[None]
        smaller = interpolate(planes, size=size, mode="bilinear", antialias=True)
        laid = smaller[0].permute(1, 2, 0)
    return encode_webp(laid)


def _order(views: MaterialViews) -> list[int]:
    """The reference first, then on around the object."""
    azimuth = views.cameras.azimuths
    around = (azimuth - azimuth[views.reference] + 1e-4).remainder(math.tau)
    return [int(view) for view in around.argsort(stable=True)]


def _angles(cameras: Cameras, view: int) -> dict[str, float]:
    """Where a camera stands, degrees and world units."""
    x, y, z = cameras.positions[view].tolist()
    distance = math.sqrt(x * x + y * y + z * z)
    return {
        "azimuth_deg": round(math.degrees(math.atan2(x, z)) % 360.0, 2) % 360.0,
        "elevation_deg": round(math.degrees(math.asin(y / distance)), 2),
        "distance": round(distance, 4),
        "fov_y_deg": round(cameras.fov_y_deg, 3),
    }


def _shown(views: MaterialViews) -> Images:
    """Planes of the views that a sheet is made of."""
    planes = {
        "radiance": views.radiance,
        "mask": views.mask,
        "basecolor": views.basecolor,
        "roughness": views.roughness,
        "metallic": views.metallic,
        "normal_world": views.normal_world,
    }
    return planes if views.confidence is None else planes | {"confidence": views.confidence}


def _sheets(kind: str, images: Images, cameras: Cameras, order: list[int]) -> dict[str, bytes]:
    """A sheet for each kind of picture; normals are shown as the camera's."""
    mask = images["mask"]
    turned = torch.einsum("vij,vhwi->vhwj", cameras.c2w[:, :3, :3], images["normal_world"])
    pictures = {
        "rgb": agx(images["radiance"] / mask.clamp_min(LEAST_COVERAGE)),
        "basecolor": srgb_from_linear(images["basecolor"].clamp(0.0, 1.0)),
        "roughness": images["roughness"],
        "metallic": images["metallic"],
        "normal": turned * 0.5 + 0.5,
    }
    sheets = {name: _sheet(picture, mask, order) for name, picture in pictures.items()}
    sheets["mask"] = _sheet(mask, torch.ones_like(mask), order)
    if "confidence" in images:
        trust = images["confidence"]
        sheets["confidence"] = _sheet(trust / trust.max().clamp_min(1e-6), mask, order)
    return {f"{kind}/{name}.webp": encode_webp(sheet) for name, sheet in sheets.items()}


def _sheet(
    pictures: Float[Tensor, "V H W C"], mask: Float[Tensor, "V H W 1"], order: list[int]
) -> Float[Tensor, "_ _ 3"]:
    """All views on paper, in rows of `COLUMNS` cells."""
    colour = pictures[order].clamp(0.0, 1.0)
    laid = PAPER + mask[order].clamp(0.0, 1.0) * (colour - PAPER)
    planes = laid.expand(*laid.shape[:-1], 3).permute(0, 3, 1, 2)
    cells = interpolate(planes, size=(CELL, CELL), mode="bilinear", antialias=True)
    rows = -(-len(order) // COLUMNS)
    blank = cells.new_full((rows * COLUMNS - len(order), 3, CELL, CELL), PAPER)
    grid = torch.cat([cells, blank]).view(rows, COLUMNS, 3, CELL, CELL)
    return grid.permute(0, 3, 1, 4, 2).reshape(rows * CELL, COLUMNS * CELL, 3)


def _found_light(asset: ExportedAsset, ctx: Context) -> Float[Tensor, "H W 3"] | None:
    """The light delivered with the asset, lat-long."""
    if LIGHT not in asset.files:
        return None
    file = ctx.work / LIGHT
    file.write_bytes(asset.files[LIGHT])
    return torch.from_numpy(read_rgb(file)).clamp_min(0.0)


def _of_asset(
    asset: ExportedAsset,
    light: Float[Tensor, "H W 3"] | None,
    views: MaterialViews,
    order: list[int],
    ctx: Context,
) -> dict[str, bytes]:
    """The asset as the views' cameras see it, under the light it came with, and the poster."""
    latlong = _latlong(LIGHTS["studio"]) if light is None else light
    radiance = octahedral_from_latlong(latlong, LIGHT_SIZE)
    shader = environment_shader(cached_operator(ctx.shared, LIGHT_SIZE)(radiance))
    file = ctx.work / ASSET
    file.write_bytes(asset.files[ASSET])
    mesh = read_mesh(file)
    side = round(RENDERED * CELL)
    cameras = views.cameras.resized(side, side)
    rendered: list[Images] = []
    for view in range(len(cameras)):
        rendered.append(render_pictures(mesh, cameras[view], shader, supersample=1))
        ctx.report(view + 1, len(cameras), {"coverage": float(rendered[-1]["mask"].mean())})
    names = ("radiance", "mask", "basecolor", "roughness", "metallic", "normal_world")
    images = {name: torch.cat([seen[name] for seen in rendered]) for name in names}
    poster = _poster(mesh, views.cameras[views.reference], shader)
    return {POSTER: poster, **_sheets("asset", images, views.cameras, order)}


def _poster(mesh: SourceMesh, camera: Cameras, shader: Shader) -> bytes:
    """The asset from the front, with opacity."""
    side = round(RENDERED * POSTER_PX)
    seen = render_pictures(mesh, camera.resized(side, side), shader, supersample=1)
    picture = agx(seen["radiance"] / seen["mask"].clamp_min(LEAST_COVERAGE))
    planes = torch.cat([picture * seen["mask"], seen["mask"]], -1).permute(0, 3, 1, 2)
    size = (POSTER_PX, POSTER_PX)
    small = interpolate(planes, size=size, mode="bilinear", antialias=True)[0].permute(1, 2, 0)
    straight = small[..., :3] / small[..., 3:].clamp_min(LEAST_COVERAGE)
    return encode_webp(torch.cat([straight, small[..., 3:]], -1))


def _latlong(radiance: Any) -> Float[Tensor, "H W 3"]:
    """A light as a picture."""
    v, u = torch.meshgrid(
        (torch.arange(LIGHT_ROWS) + 0.5) / LIGHT_ROWS,
        (torch.arange(2 * LIGHT_ROWS) + 0.5) / (2 * LIGHT_ROWS),
        indexing="ij",
    )
    return radiance(direction_from_latlong(torch.stack([u, v], -1)))


def _lights(found: Float[Tensor, "H W 3"] | None, ctx: Context) -> dict[str, bytes]:
    """All lights, turned as web viewers want them, and a small picture of each."""
    lights = {name: _latlong(radiance) for name, radiance in LIGHTS.items()}
    if found is not None:
        lights[FOUND] = found
    files = {}
    for name, latlong in lights.items():
        # three.js has +x in the middle of the picture, a quarter of a turn from our -z.
        turned = latlong.roll(-latlong.shape[1] // 4, 1).contiguous()
        file = ctx.work / "light.hdr"
        write_hdr(file, turned.numpy())
        files[f"lights/{name}.hdr"] = file.read_bytes()
        planes = agx(latlong).permute(2, 0, 1)[None]
        small = interpolate(planes, size=(THUMBNAIL_ROWS, 2 * THUMBNAIL_ROWS), mode="area")
        files[f"lights/{name}.webp"] = encode_webp(small[0].permute(1, 2, 0))
    return files


def _model(asset: ExportedAsset, config: GalleryConfig, ctx: Context) -> dict[str, bytes]:
    """A smaller copy of the asset where it is too large for a page; else nothing."""
    content = asset.files[ASSET]
    found = shrink_glb(content, int(config.most_model_mib * 2**20))
    if found is None:
        ctx.event(
            "model_left_out",
            f"asset.glb has {len(content) / 2**20:.1f} MiB, too many for the page even with the "
            "smallest textures: the page links to it",
            tell=False,
        )
        return {}
    smaller, side = found
    if not side:
        return {}
    ctx.event(
        "model_reduced",
        f"asset.glb has {len(content) / 2**20:.1f} MiB: the page shows a copy with textures of "
        f"{side} px ({len(smaller) / 2**20:.1f} MiB)",
        tell=False,
    )
    return {MODEL: smaller}


GALLERY = Stage(run)
