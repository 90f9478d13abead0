"""How good is a finished GLB? Geometry, novel views and relighting against path-traced truth.

Protocol, the same for every asset and preset:

- The GLB is read back from its file and rendered by our rasteriser at the six test cameras, 4 x 4
  samples per pixel. Image figures are means over views of the figure on the true mask (> 0.5).
- Surface distance: exact distance to the nearest triangle, longest side of the truth = 1.
  `to_asset` starts at 100k points of the true surface, of which only those count that some of 64
  directions around the object sees (true meshes have inner walls that no view shows);
  `to_truth` starts at 100k points of the asset and measures to the whole true surface.
- Volume overlap: occupancy at 128^3 by the winding number of both meshes.
- Relight: PSNR after AgX under the true light B and C, multiple scattering off as in the truth,
  minus the same for the truth's own materials and normals shaded by our renderer: what is left is
  the asset's fault, not the shading model's.
- Light: relative L1 error of the recovered map against `env_A.exr`, both blurred to 16 x 32 texels
  and weighted by solid angle; by a Gaussian, and by block means. One texel of that map holds a
  lamp of radiance 8920 beside a block's border, and bilinear lookup carries a part of it across:
  by block means the truth itself, stored as an octahedral map and read back, scores 0.23 at 64^2,
  0.14 at 128^2 and 0.07 at 256^2.
"""

import json
import math
from pathlib import Path

import numpy as np
import torch
import trimesh
from torch import Tensor

from svim3d.cameras import FAR, NEAR, Cameras, look_at_origin
from svim3d.color import srgb_from_linear
from svim3d.fields.material_field import Materials
from svim3d.io.exr import read_rgb
from svim3d.io.glb import read_mesh
from svim3d.io.orbit import read_orbit
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
    physical_radiance,
)
from svim3d.shading.prefilter import PyramidOperator
from svim3d.shading.tonemap import agx

SAMPLES = 100_000
SIGHT_DIRECTIONS, SIGHT_PX, SIGHT_DISTANCE = 64, 512, 4.0
SIGHT_SLACK = 0.01  # world units; a point this far behind what is seen still counts as seen
RESOLUTION, HALF_EXTENT = 128, 0.55
SUPERSAMPLE = 4
LIGHT_SIZE = 256  # octahedral map of the true lights, 256 x 128 as files
BLURRED_ROWS = 16


def evaluate(glb: Path, orbit: Path, phase0: Tensor | None) -> dict[str, float]:
    """All figures of one asset.

    Args:
        glb: the finished file.
        orbit: folder of the truth.
        phase0: the light recovered by phase 0, lat-long [H, 2H, 3]; None if it was skipped.
    """
    mesh = read_mesh(glb)
    figures = _geometry(mesh, orbit / "mesh.ply")
    figures |= _novel_views(mesh, orbit)
    figures |= _relighting(mesh, orbit)
    figures["faces"], figures["file_mib"] = len(mesh.faces), glb.stat().st_size / 2**20
    if phase0 is not None:
        figures |= light_errors(phase0, _true_light(orbit, "A"))
    return figures


def _geometry(mesh: SourceMesh, truth_file: Path) -> dict[str, float]:
    """Distances both ways and volume overlap."""
    loaded = trimesh.load(truth_file, process=False)
    vertices = torch.from_numpy(np.array(loaded.vertices, np.float32))
    faces = torch.from_numpy(np.array(loaded.faces, np.int32))
    generator = torch.Generator().manual_seed(0)
    truth_points = sample_surface(vertices, faces, SAMPLES, generator)
    truth_points = truth_points[visible(truth_points, vertices, faces)]
    points = sample_surface(mesh.vertices, mesh.faces, SAMPLES, generator)
    to_asset = distance_to_surface(truth_points, mesh.vertices, mesh.faces)
    to_truth = distance_to_surface(points, vertices, faces)
    volumes = [
        occupancy(v, f, resolution=RESOLUTION, half_extent=HALF_EXTENT)
        for v, f in ((vertices, faces), (mesh.vertices, mesh.faces))
    ]
    return {
        "to_asset": float(to_asset.mean()),
        "to_truth": float(to_truth.mean()),
        "distance": float(to_asset.mean() + to_truth.mean()) / 2,
        "distance_p95": float(torch.cat([to_asset, to_truth]).quantile(0.95)),
        "volume_iou": volume_iou(*volumes),
    }


def visible(points: Tensor, vertices: Tensor, faces: Tensor) -> Tensor:
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


def _distance_along_view(window_depth: Tensor) -> Tensor:
    """Distance along the camera's -z axis from window depth in [0, 1]; infinite where empty."""
    ndc = 2.0 * window_depth.double() - 1.0
    distance = 2.0 * FAR * NEAR / (FAR + NEAR - ndc * (FAR - NEAR))
    return torch.where(window_depth.isinf(), math.inf, distance)


def _novel_views(mesh: SourceMesh, orbit: Path) -> dict[str, float]:
    """Materials and normals at the test cameras."""
    cameras, truth, _ = read_orbit(orbit, "test_A")
    rendered = render_pictures(mesh, cameras, _unlit, supersample=SUPERSAMPLE)
    covered = truth["mask"] > 0.5
    seen = rendered["mask"] > 0.5
    angles, decibels = [], {name: [] for name in ("basecolor", "roughness", "metallic")}
    for view in range(len(cameras)):
        mask = covered[view]
        normals = rendered["normal_world"][view], truth["normal_world"][view]
        angles.append(mean_angle_deg(*normals, mask))
        for name, values in decibels.items():
            curve = srgb_from_linear if name == "basecolor" else torch.Tensor.clone
            values.append(psnr(curve(rendered[name][view]), curve(truth[name][view]), mask))
    return {
        "normal_deg": float(np.mean(angles)),
        **{f"{name}_db": float(np.mean(values)) for name, values in decibels.items()},
        "mask_iou": float((covered & seen).sum() / (covered | seen).sum()),
    }


def _unlit(normal: Tensor, wo: Tensor, materials: Materials) -> Tensor:
    """A shader for pictures of which only the materials are looked at."""
    return torch.zeros_like(normal)


def _relighting(mesh: SourceMesh, orbit: Path) -> dict[str, float]:
    """The asset under two lights it never saw, and what the true materials give there."""
    asset_db, ideal_db = [], []
    for environment in ("B", "C"):
        light = octahedral_from_latlong(_true_light(orbit, environment), LIGHT_SIZE)
        pyramid = PyramidOperator.build(LIGHT_SIZE)(light)
        shader = environment_shader(pyramid, multiple_scattering=False)
        cameras, truth, _ = read_orbit(orbit, f"test_{environment}")
        rendered = render_pictures(mesh, cameras, shader, supersample=SUPERSAMPLE)["radiance"]
        for view in range(len(cameras)):
            mask = truth["mask"][view] > 0.5
            target = agx(truth["radiance"][view])
            ideal = shade_images(truth, cameras, view, shader)
            asset_db.append(psnr(agx(rendered[view]), target, mask))
            ideal_db.append(psnr(agx(ideal), target, mask))
    return {
        "relight_db": float(np.mean(asset_db)),
        "relight_ideal_db": float(np.mean(ideal_db)),
        "relight_delta_db": float(np.mean(asset_db) - np.mean(ideal_db)),
    }


def shade_images(truth: dict[str, Tensor], cameras: Cameras, view: int, shader: Shader) -> Tensor:
    """Radiance [H, W, 3], premultiplied, of given material and normal images."""
    mask = truth["mask"][view]
    wo = -cameras.rays(view)[1]
    flat = {name: truth[name][view].reshape(len(wo), -1) for name in truth}
    materials = Materials(
        flat["basecolor"], flat["roughness"], flat["metallic"], torch.zeros_like(wo)
    )
    radiance = shader(normalize(flat["normal_world"]), wo, materials)
    return radiance.view(*mask.shape[:2], 3) * mask


def _true_light(orbit: Path, environment: str) -> Tensor:
    index = json.loads((orbit / "orbit.json").read_text())
    file = orbit / index["environments"][environment]["file"]
    return physical_radiance(torch.from_numpy(read_rgb(file)))[0]


def light_errors(found: Tensor, truth: Tensor) -> dict[str, float]:
    """Relative L1 errors of a lat-long map at 16 x 32 texels, weighted by solid angle.

    `light_error` blurs both maps by a Gaussian before they are resampled, `light_error_blocks`
    takes means over blocks.
    """
    errors = {}
    for name, blur in (("light_error", blurred_latlong), ("light_error_blocks", _blocks)):
        coarse_found, coarse_truth = (blur(m, height=BLURRED_ROWS) for m in (found, truth))
        omega = latlong_solid_angles(*coarse_truth.shape[:2], coarse_truth)
        difference = ((coarse_found - coarse_truth).abs() * omega).sum()
        errors[name] = float(difference / (coarse_truth * omega).sum())
    return errors


def _blocks(latlong: Tensor, *, height: int) -> Tensor:
    return downsample_latlong(latlong, latlong.shape[0] // height)
