"""Phase 1 alone: quality against CPU seconds for both density models, hash sizes and step counts.

    python benchmarks/bench_field.py --data FOLDER [--asset boombox] [--steps 100 300 900]
        [--rays 2048] [--variants sdf density] [--set nerf_field=value] [--chart FILE]

`--data` (default: the environment variable SVIM3D_DATA) holds `orbits/<asset>` with training views,
test views and the true mesh. Each row is one run of the stage from the views, without phase 0.
Distance: mean of both ways between the extracted surface and what is visible of the true one,
longest side = 1. Normals and basecolor: the field itself seen by the test cameras, one ray through
each pixel of the true mask; basecolor in dB after sRGB encoding.
"""

import argparse
import os
import sys
import tempfile
import time
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import torch
import trimesh
import yaml

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from stages.artifacts import FittedField, MaterialViews  # noqa: E402
from stages.base import Context  # noqa: E402
from stages.nerf import run  # noqa: E402
from stages.settings.nerf import NerfConfig  # noqa: E402
from svim3d.color import srgb_from_linear  # noqa: E402
from svim3d.fields.material_field import MaterialField  # noqa: E402
from svim3d.io.orbit import read_orbit  # noqa: E402
from svim3d.mesh.marching import extract_surface  # noqa: E402
from svim3d.metrics import distance_to_surface, mean_angle_deg, psnr, sample_surface  # noqa: E402
from svim3d.numerics import normalize  # noqa: E402
from svim3d.render.asset_figures import visible  # noqa: E402
from svim3d.render.march import Rays  # noqa: E402
from svim3d.render.volumes import SdfVolume  # noqa: E402
from svim3d.render.volumetric import render_rays  # noqa: E402

VARIANTS = {
    "sdf": {},
    "sdf, hash 2^13": {"hash_log2_entries": 13},
    "sdf, hash 2^19": {"hash_log2_entries": 19},
    "sdf, no coarse grids": {"coarse_nodes": ()},
    "sdf, no bump": {"bump_start": 1.0},
    "density": {"density_model": "density"},
}
SAMPLES = 50_000
SHARP = 2000.0  # inverse width of the opacity with which a finished distance is looked at
MIN_WEIGHT = 0.02
HEADER = f"{'variant':22} steps   CPU s  distance     p95  normal  basecolor"


def fit(views: MaterialViews, config: NerfConfig) -> tuple[FittedField, float]:
    """One run of the stage and its CPU seconds."""
    with tempfile.TemporaryDirectory() as work:
        folder = Path(work)
        with Context("nerf", torch.device("cpu"), 0, folder / "work", folder / "shared") as ctx:
            begin = time.process_time()
            fitted = run(views, None, config=config, ctx=ctx)
            return fitted, time.process_time() - begin


def surface_figures(fitted: FittedField, orbit: Path) -> dict[str, float]:
    """Distance both ways to the visible part of the true mesh."""
    truth = trimesh.load(orbit / "mesh.ply", process=False)
    true_vertices = torch.from_numpy(np.array(truth.vertices, np.float32))
    true_faces = torch.from_numpy(np.array(truth.faces, np.int32))
    generator = torch.Generator().manual_seed(0)
    wanted = sample_surface(true_vertices, true_faces, SAMPLES, generator)
    wanted = wanted[visible(wanted, true_vertices, true_faces)]
    vertices, faces = extract_surface(fitted.sdf, fitted.half_extent)
    if not len(faces):
        return {"distance": float("nan"), "p95": float("nan")}
    to_truth = distance_to_surface(
        sample_surface(vertices, faces, SAMPLES, generator), true_vertices, true_faces
    )
    to_field = distance_to_surface(wanted, vertices, faces)
    return {
        "distance": float(to_truth.mean() + to_field.mean()) / 2,
        "p95": float(torch.cat([to_truth, to_field]).quantile(0.95)),
    }


@torch.no_grad()
def view_figures(fitted: FittedField, orbit: Path) -> dict[str, float]:
    """Shading normals and basecolor at the test cameras."""
    cameras, truth, _ = read_orbit(orbit, "test_A")
    materials = MaterialField(fitted.material_spec)
    materials.load_state_dict(fitted.material_state)
    volume = SdfVolume(fitted.sdf, fitted.half_extent)
    volume.sharpness = SHARP
    volume.refresh()
    angles, decibels = [], []
    for view in range(len(cameras)):
        mask = truth["mask"][view] > 0.5
        chosen = torch.nonzero(mask.view(-1))[:, 0]
        origins, directions = cameras.rays(view)
        seen = render_rays(
            volume,
            materials,
            Rays(origins[chosen].contiguous(), directions[chosen]),
            jitter=torch.full((len(chosen),), 0.5),
            pyramid=None,
            min_weight=MIN_WEIGHT,
        )
        images = {}
        for name, values in (("normal", seen.normal_shading), ("color", seen.basecolor)):
            images[name] = torch.zeros(mask.numel(), 3).index_copy(0, chosen, values)
        shape = (*mask.shape[:2], 3)
        normals = normalize(images["normal"]).view(shape)
        angles.append(mean_angle_deg(normals, truth["normal_world"][view], mask))
        colors = srgb_from_linear(images["color"].view(shape))
        decibels.append(psnr(colors, srgb_from_linear(truth["basecolor"][view]), mask))
    return {"normal": float(np.mean(angles)), "basecolor": float(np.mean(decibels))}


def draw(rows: list[dict[str, float | str]], file: Path) -> None:
    """Every figure against CPU seconds, one line per variant."""
    panels = (("distance", "surface distance"), ("normal", "normals, deg"), ("basecolor", "dB"))
    figure, axes = plt.subplots(1, len(panels), figsize=(5 * len(panels), 4))
    for axis, (name, label) in zip(axes, panels, strict=True):
        for variant in dict.fromkeys(row["variant"] for row in rows):
            own = [row for row in rows if row["variant"] == variant]
            axis.plot([r["cpu_s"] for r in own], [r[name] for r in own], "o-", label=variant)
        axis.set(xlabel="CPU seconds", ylabel=label, xscale="log")
        axis.grid(alpha=0.3)
    axes[0].legend()
    figure.tight_layout()
    figure.savefig(file, dpi=120)


def main() -> None:
    """Run all variants at all step counts."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=os.environ.get("SVIM3D_DATA"))
    parser.add_argument("--asset", default="boombox")
    parser.add_argument("--steps", type=int, nargs="+", default=[100, 300, 900])
    parser.add_argument("--rays", type=int, default=2048)
    parser.add_argument("--variants", nargs="+", default=list(VARIANTS), choices=list(VARIANTS))
    parser.add_argument("--set", nargs="*", default=[], metavar="NAME=VALUE")
    parser.add_argument("--chart", type=Path)
    arguments = parser.parse_args()
    if arguments.data is None:
        parser.error("--data names no folder and SVIM3D_DATA is not set")
    overrides = {
        name: yaml.safe_load(value)
        for name, value in (item.split("=", 1) for item in arguments.set)
    }
    orbit = Path(arguments.data) / "orbits" / arguments.asset
    views = MaterialViews.load(orbit)
    # The first run of a process loads the compiled kernels.
    fit(views, NerfConfig(steps=2, rays_per_step=arguments.rays))
    print(HEADER)
    rows: list[dict[str, float | str]] = []
    for variant in arguments.variants:
        for steps in arguments.steps:
            settings = {"steps": steps, "rays_per_step": arguments.rays, **overrides}
            fitted, cpu_s = fit(views, NerfConfig(**(settings | VARIANTS[variant])))
            row = {"variant": variant, "steps": steps, "cpu_s": cpu_s}
            row |= surface_figures(fitted, orbit) | view_figures(fitted, orbit)
            rows.append(row)
            print(
                f"{variant:22} {steps:5d} {cpu_s:7.1f} {row['distance']:9.5f} {row['p95']:7.4f} "
                f"{row['normal']:7.2f} {row['basecolor']:10.2f}",
                flush=True,
            )
    if arguments.chart:
        draw(rows, arguments.chart)


if __name__ == "__main__":
    main()
