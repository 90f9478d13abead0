"""How good is a finished asset? Geometry, novel views and relighting against path-traced truth.

Protocol, the same for every asset and preset:

- The asset is rendered by our rasteriser at the test cameras, some samples per pixel. Image
  figures are means over views of the figure on the true mask (> 0.5).
- Surface distance: exact distance to the nearest triangle, longest side of the truth = 1.
  `to_asset` starts at points of the true surface, of which only those count that some of 64
  directions around the object sees (true meshes have inner walls that no view shows);
  `to_truth` starts at points of the asset and measures to the whole true surface.
- Volume overlap: occupancy by the winding number of both meshes.
- Relight: PSNR after AgX under lights that the asset never saw, multiple scattering off as in the
  truth, minus the same for the truth's own materials and normals shaded by our renderer: what is
  left is the asset's fault, not the shading model's.
- Light: relative L1 error of the recovered map against the true one, both blurred to 16 x 32 texels
  and weighted by solid angle; by a Gaussian, and by block means. One texel of the map may hold a
  lamp of radiance 8920 beside a block's border, and bilinear lookup carries a part of it across:
  by block means the truth itself, stored as an octahedral map and read back, scores 0.23 at 64^2,
  0.14 at 128^2 and 0.07 at 256^2.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from svim3d.cameras import FAR, NEAR, Cameras, look_at_origin
from svim3d.color import srgb_from_linear
from svim3d.fields.material_field import Materials
from svim3d.mesh.source_mesh import SourceMesh
from svim3d.metrics import (
    distance_to_surface,
    mean_angle_deg,
    occupancy,
    psnr,
    sample_surface,
    volume_iou,
)
from svim3d.numerics import normalize
from svim3d.raster.zbuffer import rasterize
from svim3d.render.deferred import Shader, environment_shader
from svim3d.render.pictures import render_pictures
from svim3d.shading.environment import (
    blurred_latlong,
    downsample_latlong,
    latlong_solid_angles,
    octahedral_from_latlong,
)
from svim3d.shading.prefilter import PyramidOperator
from svim3d.shading.tonemap import agx

SIGHT_DIRECTIONS, SIGHT_PX, SIGHT_DISTANCE = 64, 512, 4.0
SIGHT_SLACK = 0.01  # world units; a point this far behind what is seen still counts as seen
HALF_EXTENT = 0.55  # of the cube whose cells are compared, world units
BLURRED_ROWS = 16  # of the light maps that are compared
COVERED = 0.5

Figures = dict[str, float]
Surface = tuple[Float[Tensor, "N 3"], Int[Tensor, "F 3"]]


@dataclass(frozen=True)
class LitViews:
    """Views of the truth at test cameras.

    Attributes:
        cameras: V poses.
        images: radiance (scene-linear, premultiplied), mask, basecolor, roughness, metallic and
            normal_world, each [V, H, W, C].
        light: that lit them, lat-long, linear.
    """

    cameras: Cameras
    images: dict[str, Float[Tensor, "_ _ _ _"]]
    light: Float[Tensor, "h w 3"]


def geometry_figures(mesh: SourceMesh, truth: Surface, *, samples: int, resolution: int) -> Figures:
    """Distances both ways and volume overlap.

    Args:
        mesh: the asset.
        truth: vertices and faces.
        samples: points on each surface.
        resolution: cells along the cube that volumes are compared in.
    """
    vertices, faces = truth
    generator = torch.Generator().manual_seed(0)
    truth_points = sample_surface(vertices, faces, samples, generator)
    truth_points = truth_points[visible(truth_points, vertices, faces)]
    points = sample_surface(mesh.vertices, mesh.faces, samples, generator)
    to_asset = distance_to_surface(truth_points, mesh.vertices, mesh.faces)
    to_truth = distance_to_surface(points, vertices, faces)
    volumes = [
        occupancy(v, f, resolution=resolution, half_extent=HALF_EXTENT)
        for v, f in (truth, (mesh.vertices, mesh.faces))
    ]
    return {
        "to_asset": float(to_asset.mean()),
        "to_truth": float(to_truth.mean()),
        "distance": float(to_asset.mean() + to_truth.mean()) / 2,
        "distance_p95": float(torch.cat([to_asset, to_truth]).quantile(0.95)),
        "volume_iou": volume_iou(*volumes),
    }


def visible(
    points: Float[Tensor, "P 3"], vertices: Float[Tensor, "N 3"], faces: Int[Tensor, "F 3"]
) -> Bool[Tensor, "P"]:
    """Which points of a surface are seen from outside, from any of many directions."""
    fov = 2.0 * math.degrees(math.atan(1.0 / SIGHT_DISTANCE))
    seen = torch.zeros(len(points), dtype=torch.bool)
    for i in range(SIGHT_DIRECTIONS):
        # Fibonacci points: near-uniform over the sphere.
        elevation = math.degrees(math.asin(1.0 - (2 * i + 1) / SIGHT_DIRECTIONS))
        pose = look_at_origin(elevation, i * 137.50776405 % 360.0, SIGHT_DISTANCE)
        camera = Cameras(pose[None], fov, SIGHT_PX, SIGHT_PX)
        fragments = rasterize(
            camera.project(vertices)[0], faces, SIGHT_PX, SIGHT_PX, cull_backfaces=False
        )
        nearest = _distance_along_view(fragments.depth)
        clip = camera.project(points)[0]
        column, row = (((clip[:, :2] / clip[:, 3:]) * 0.5 + 0.5) * SIGHT_PX).long().unbind(1)
        inside = (column >= 0) & (column < SIGHT_PX) & (row >= 0) & (row < SIGHT_PX)
        column, row = column.clamp(0, SIGHT_PX - 1), (SIGHT_PX - 1 - row).clamp(0, SIGHT_PX - 1)
        seen |= inside & (clip[:, 3] <= nearest[row, column] + SIGHT_SLACK)
    return seen


def _distance_along_view(window_depth: Float[Tensor, "H W"]) -> Float[Tensor, "H W"]:
    """Distance along the camera's -z axis from window depth in [0, 1]; infinite where empty."""
    ndc = 2.0 * window_depth.double() - 1.0
    distance = 2.0 * FAR * NEAR / (FAR + NEAR - ndc * (FAR - NEAR))
    return torch.where(window_depth.isinf(), math.inf, distance)


def novel_view_figures(mesh: SourceMesh, truth: LitViews, *, supersample: int) -> Figures:
    """Materials, normals and outlines at the test cameras."""
    rendered = render_pictures(mesh, truth.cameras, _unlit, supersample=supersample)
    covered = truth.images["mask"] > COVERED
    seen = rendered["mask"] > COVERED
    angles: list[float] = []
    decibels: dict[str, list[float]] = {n: [] for n in ("basecolor", "roughness", "metallic")}
    for view in range(len(truth.cameras)):
        mask = covered[view]
        normals = rendered["normal_world"][view], truth.images["normal_world"][view]
        angles.append(mean_angle_deg(*normals, mask))
        for name, values in decibels.items():
            curve = srgb_from_linear if name == "basecolor" else torch.Tensor.clone
            values.append(psnr(curve(rendered[name][view]), curve(truth.images[name][view]), mask))
    return {
        "normal_deg": float(np.mean(angles)),
        **{f"{name}_db": float(np.mean(values)) for name, values in decibels.items()},
        "mask_iou": float((covered & seen).sum() / (covered | seen).sum()),
    }


def _unlit(normal: Tensor, wo: Tensor, materials: Materials) -> Tensor:
    """A shader for pictures of which only the materials are looked at."""
    return torch.zeros_like(normal)


def relight_figures(
    mesh: SourceMesh,
    truths: list[LitViews],
    operator: PyramidOperator,
    *,
    light_size: int,
    supersample: int,
) -> Figures:
    """The asset under lights it never saw, and what the true materials give there.

    Args:
        mesh: the asset.
        truths: its truth under each of them.
        operator: prefilters octahedral maps of `light_size` texels a side.
        light_size: as said.
        supersample: samples per pixel and axis.
    """
    asset_db, ideal_db = [], []
    for truth in truths:
        pyramid = operator(octahedral_from_latlong(truth.light, light_size))
        shader = environment_shader(pyramid, multiple_scattering=False)
        rendered = render_pictures(mesh, truth.cameras, shader, supersample=supersample)["radiance"]
        for view in range(len(truth.cameras)):
            mask = truth.images["mask"][view] > COVERED
            target = agx(truth.images["radiance"][view])
            ideal = shade_images(truth.images, truth.cameras, view, shader)
            asset_db.append(psnr(agx(rendered[view]), target, mask))
            ideal_db.append(psnr(agx(ideal), target, mask))
    return {
        "relight_db": float(np.mean(asset_db)),
        "relight_ideal_db": float(np.mean(ideal_db)),
        "relight_delta_db": float(np.mean(asset_db) - np.mean(ideal_db)),
    }


def shade_images(
    truth: dict[str, Tensor], cameras: Cameras, view: int, shader: Shader
) -> Float[Tensor, "H W 3"]:
    """Radiance, premultiplied, of given material and normal images."""
    mask = truth["mask"][view]
    wo = -cameras.rays(view)[1]
    flat = {name: truth[name][view].reshape(len(wo), -1) for name in truth}
    materials = Materials(
        flat["basecolor"], flat["roughness"], flat["metallic"], torch.zeros_like(wo)
    )
    radiance = shader(normalize(flat["normal_world"]), wo, materials)
    return radiance.view(*mask.shape[:2], 3) * mask


def light_figures(found: Float[Tensor, "h w 3"], truth: Float[Tensor, "H W 3"]) -> Figures:
    """Relative L1 errors of a lat-long map at 16 x 32 texels, weighted by solid angle.

    `light_error` blurs both maps by a Gaussian before they are resampled, `light_error_blocks`
    takes means over blocks.
    """
    errors = {}
    blurs: dict[str, Callable[..., Tensor]] = {
        "light_error": blurred_latlong,
        "light_error_blocks": _blocks,
    }
    for name, blur in blurs.items():
        coarse_found, coarse_truth = (blur(m, height=BLURRED_ROWS) for m in (found, truth))
        height, width, _ = coarse_truth.shape
        omega = latlong_solid_angles(height, width, coarse_truth)
        difference = ((coarse_found - coarse_truth).abs() * omega).sum()
        errors[name] = float(difference / (coarse_truth * omega).sum())
    return errors


def _blocks(latlong: Float[Tensor, "H W 3"], *, height: int) -> Float[Tensor, "h w 3"]:
    return downsample_latlong(latlong, latlong.shape[0] // height)
