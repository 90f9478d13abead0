"""How near does 2.5D relighting come to path-traced pictures? True materials, novel lights.

    python benchmarks/bench_relight.py --data FOLDER [--assets spheres cat] [--views 0 3]
        [--picture FILE] [--budget] [--samples 256]

`--data` (default: the environment variable SVIM3D_DATA) holds `orbits/<asset>` with the views
`test_B` and `test_C` and the maps that lit them. The true materials, normals and depth of each view
are shaded by `shade_view` under the true light, multiple scattering off as in the truth, in three
modes: `off` (the split sum alone, the baseline), `shadow` (traced rays, no light from what blocks
them) and `full` (three bounces). Figures are PSNR after AgX on the mask (> 0.5), mean over views.
Seconds are wall clock: `trace` once per view, `frame` for each turned light.

`--budget` adds, for the first of the views, how much each approximation costs; see `relight_budget`
(it needs `embreex`).
"""

import argparse
import itertools
import json
import os
import sys
import time
from collections import defaultdict
from dataclasses import dataclass, field
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import torch
from torch import Tensor

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from svim3d.io.exr import read_exr, read_rgb  # noqa: E402
from svim3d.io.orbit import read_orbit  # noqa: E402
from svim3d.metrics import psnr  # noqa: E402
from svim3d.numerics import dot, normalize  # noqa: E402
from svim3d.render.gbuffer import GBuffer  # noqa: E402
from svim3d.render.image_shading import BOUNCES, shade_view  # noqa: E402
from svim3d.render.screen_visibility import ScreenVisibility  # noqa: E402
from svim3d.shading.environment import octahedral_from_latlong, physical_radiance  # noqa: E402
from svim3d.shading.prefilter import EnvironmentPyramid, PyramidOperator  # noqa: E402
from svim3d.shading.tonemap import agx  # noqa: E402

ASSETS = ("boombox", "barrel", "cat", "oculus", "spheres")
LIGHTS = "BC"
LIGHT_SIZE = 256  # octahedral map of the true lights, 256 x 128 as files
MODES = ("off", "shadow", "full")
BINS = {"n.v": (0.0, 0.25, 0.5, 0.75, 1.0), "roughness": (0.0, 0.2, 0.4, 0.6, 1.0)}


@dataclass
class Case:
    """One asset under one light: what is known of its views, and the path-traced truth."""

    asset: str
    light: str
    gbuffer: GBuffer
    truth: Tensor  # premultiplied radiance
    radiance: Tensor  # of the light, lat-long
    pyramid: EnvironmentPyramid

    @classmethod
    def read(cls, folder: Path, light: str) -> "Case":
        """All test views of one orbit folder under one of its lights."""
        cameras, images, _ = read_orbit(folder, f"test_{light}")
        files = [folder / f"test_{light}/{view:03d}.exr" for view in range(len(cameras))]
        depth = [torch.from_numpy(read_exr(file)["depth.Z"]) for file in files]
        images["depth"] = torch.stack(depth)[..., None]
        images["normal_world"] = normalize(images["normal_world"])
        name = json.loads((folder / "orbit.json").read_text())["environments"][light]["file"]
        radiance = physical_radiance(torch.from_numpy(read_rgb(folder / name)))[0]
        pyramid = PyramidOperator.build(LIGHT_SIZE)(octahedral_from_latlong(radiance, LIGHT_SIZE))
        gbuffer = GBuffer.of(cameras, images)
        return cls(folder.name, light, gbuffer, images["radiance"], radiance, pyramid)

    def mask(self, view: int) -> Tensor:
        """The pixels that count."""
        return self.gbuffer.mask[view] > 0.5

    def display(self, view: int, radiance: Tensor | None = None) -> Tensor:
        """Straight radiance, or the truth, as it is shown on black."""
        if radiance is None:
            return agx(self.truth[view])
        return agx(radiance * self.gbuffer.mask[view])


@dataclass
class Errors:
    """Squared errors by mode, summed in bins over all cases."""

    total: dict[tuple[str, str, int], float] = field(default_factory=lambda: defaultdict(float))
    count: dict[tuple[str, str, int], int] = field(default_factory=lambda: defaultdict(int))

    def add(self, case: Case, view: int, mode: str, squared: Tensor) -> None:
        """Take in the squared errors of one picture."""
        mask = case.mask(view)[..., 0]
        g = case.gbuffer
        values = {
            "n.v": dot(g.normal_world[view], g.view_directions(view))[..., 0],
            "roughness": g.roughness[view][..., 0],
        }
        for name, edges in BINS.items():
            bins = torch.bucketize(values[name][mask].contiguous(), torch.tensor(edges[1:-1]))
            for b in range(len(edges) - 1):
                self.total[name, mode, b] += float(squared[mask][bins == b].sum())
                self.count[name, mode, b] += int((bins == b).sum())

    def report(self) -> None:
        """Print a table for each way of binning."""
        for name, edges in BINS.items():
            print(f"\nPSNR by {name}, all pixels of all cases together")
            spans = [f"{low:.2f}-{high:.2f}" for low, high in itertools.pairwise(edges)]
            print(f"{'mode':8}" + "".join(f"{span:>11}" for span in spans))
            for mode in MODES:
                means = [
                    self.total[name, mode, b] / max(self.count[name, mode, b], 1)
                    for b in range(len(spans))
                ]
                print(f"{mode:8}" + "".join(f"{-10 * np.log10(m + 1e-12):11.2f}" for m in means))
            everything = max(sum(self.total[name, MODES[0], b] for b in range(len(spans))), 1e-12)
            share = [self.total[name, MODES[0], b] / everything for b in range(len(spans))]
            print(f"{'share':8}" + "".join(f"{s:11.1%}" for s in share) + "  of the error when off")


def relight(case: Case, view: int) -> tuple[dict[str, Tensor], float, float]:
    """Radiance by mode, seconds to trace, seconds for one full frame."""
    started = time.perf_counter()
    visibility = ScreenVisibility.trace(case.gbuffer, view)
    trace_s = time.perf_counter() - started
    pictures = {}
    for mode, traced, bounces in zip(
        MODES, (None, visibility, visibility), (0, 0, BOUNCES), strict=True
    ):
        started = time.perf_counter()
        shaded = shade_view(
            case.gbuffer,
            view,
            case.pyramid,
            visibility=traced,
            bounces=bounces,
            multiple_scattering=False,
        )
        frame_s = time.perf_counter() - started
        pictures[mode] = shaded.radiance
    return pictures, trace_s, frame_s


def measure(case: Case, views: list[int], errors: Errors) -> tuple[list[float], dict[str, Tensor]]:
    """Mean PSNR by mode with both times, and the pictures of the first view."""
    rows, first = [], {}
    for view in views:
        pictures, trace_s, frame_s = relight(case, view)
        target, row = case.display(view), []
        for mode, radiance in pictures.items():
            shown = case.display(view, radiance)
            row.append(psnr(shown, target, case.mask(view)))
            errors.add(case, view, mode, (shown - target).square().mean(-1))
        rows.append([*row, trace_s, frame_s])
        first = first or pictures
    return [float(x) for x in np.mean(rows, 0)], first


def draw(rows: list[tuple[Case, int, dict[str, Tensor]]], file: Path) -> None:
    """Truth, all modes and three times the remaining difference, one row per case."""
    figure, axes = plt.subplots(len(rows), 5, figsize=(15, 3 * len(rows)), squeeze=False)
    for (case, view, pictures), row in zip(rows, axes, strict=True):
        target = case.display(view)
        shown = {f"{case.asset} {case.light}: truth": target}
        shown |= {mode: case.display(view, radiance) for mode, radiance in pictures.items()}
        shown["3 |full - truth|"] = (3.0 * (shown["full"] - target).abs()).clamp_max(1.0)
        i, j = torch.nonzero(case.mask(view)[..., 0], as_tuple=True)
        crop = slice(int(i.min()), int(i.max()) + 1), slice(int(j.min()), int(j.max()) + 1)
        for axis, (name, picture) in zip(row, shown.items(), strict=True):
            axis.imshow(picture[crop].numpy())
            axis.set_title(name, fontsize=9)
            axis.axis("off")
    figure.tight_layout()
    figure.savefig(file, dpi=80)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=os.environ.get("SVIM3D_DATA"))
    parser.add_argument("--assets", nargs="+", choices=ASSETS, default=ASSETS)
    parser.add_argument("--views", nargs="+", type=int, default=list(range(6)))
    parser.add_argument("--picture", type=Path, default=ROOT / "benchmarks/results/relight.png")
    parser.add_argument("--budget", action="store_true", help="explain what is lost")
    parser.add_argument("--samples", type=int, default=256, help="per pixel, for the budget")
    arguments = parser.parse_args()
    if arguments.data is None:
        parser.error("--data is needed: no SVIM3D_DATA is set")
    errors, table, drawn = Errors(), [], []
    print("asset    light" + "".join(f"{mode:>8}" for mode in MODES) + "  trace ms  frame ms")
    for asset in arguments.assets:
        for light in LIGHTS:
            case = Case.read(arguments.data / "orbits" / asset, light)
            if not table:
                relight(case, arguments.views[0])  # compiles
            figures, pictures = measure(case, arguments.views, errors)
            table.append(figures)
            drawn.append((case, arguments.views[0], pictures))
            print(_row(f"{asset:9}{light:5}", figures), flush=True)
    print(_row(f"{'mean':14}", [float(x) for x in np.mean(table, 0)]))
    errors.report()
    arguments.picture.parent.mkdir(parents=True, exist_ok=True)
    draw(drawn, arguments.picture)
    print(f"picture: {arguments.picture}")
    if arguments.budget:
        from relight_budget import report_budget

        report_budget(arguments.data, drawn, arguments.samples)


def _row(label: str, figures: list[float]) -> str:
    *decibels, trace_s, frame_s = figures
    shown = "".join(f"{x:8.2f}" for x in decibels)
    return f"{label}{shown}{trace_s * 1e3:10.0f}{frame_s * 1e3:10.1f}"


if __name__ == "__main__":
    main()
