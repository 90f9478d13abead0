"""How well phase 0 recovers the light: one row per asset, and a picture of what it found.

    python benchmarks/bench_environment.py --data FOLDER [--assets spheres cat] [--picture FILE]
        [--set size=64 max_pixels=20000]

`--data` (default: the environment variable SVIM3D_DATA) holds `orbits/<asset>` with views and the
map that lit them, `env_A.exr`. Errors are sum |a - b| / sum b (L1) and the ratio of root mean
squares (RMS) over 16 x 32 texels, all texels alike, of both maps: blurred by a Gaussian of half a
texel's width, or averaged over blocks. Block means depend on which side of an edge a lamp falls,
so the last column gives what is left of the true map itself after resampling to the size in use.
"""

import argparse
import json
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
import yaml

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from stages.artifacts import MaterialViews  # noqa: E402
from stages.base import Context  # noqa: E402
from stages.env_preopt import ENV_PREOPT  # noqa: E402
from stages.settings.env_preopt import EnvPreoptConfig  # noqa: E402
from svim3d.io.exr import read_rgb  # noqa: E402
from svim3d.shading.environment import (  # noqa: E402
    blurred_latlong,
    downsample_latlong,
    latlong_from_octahedral,
    octahedral_from_latlong,
)
from svim3d.shading.tonemap import agx  # noqa: E402

ASSETS = ("boombox", "barrel", "cat", "oculus", "spheres")
ROWS = 16  # of the maps that are compared
HEADER = "asset       CPU s  blur L1    RMS  block L1    RMS  energy  floor"


def relative_errors(found: torch.Tensor, truth: torch.Tensor) -> tuple[float, float]:
    """L1 and RMS error over that of the truth."""
    l1 = (found - truth).abs().sum() / truth.sum()
    rms = ((found - truth) ** 2).sum().sqrt() / (truth**2).sum().sqrt()
    return float(l1), float(rms)


def recover(folder: Path, config: EnvPreoptConfig) -> tuple[torch.Tensor, float]:
    """Phase 0 on one orbit: the map as lat-long of 128 rows, and CPU seconds."""
    views = MaterialViews.load(folder)
    with tempfile.TemporaryDirectory() as work:
        cpu = torch.device("cpu")
        with Context("env_preopt", cpu, 0, Path(work), Path(work)) as ctx:
            started = time.process_time()
            light = ENV_PREOPT.run(views, config=config, ctx=ctx)
            seconds = time.process_time() - started
    return latlong_from_octahedral(light.radiance, height=128), seconds


def report(asset: str, found: torch.Tensor, truth: torch.Tensor, seconds: float, size: int) -> str:
    """One row of the table."""
    block = truth.shape[0] // ROWS
    smooth, blocks = blurred_latlong(truth, height=ROWS), downsample_latlong(truth, block)
    found_smooth = blurred_latlong(found, height=ROWS)
    found_blocks = downsample_latlong(found, found.shape[0] // ROWS)
    resampled = latlong_from_octahedral(octahedral_from_latlong(truth, size), height=128)
    floor, _ = relative_errors(downsample_latlong(resampled, 128 // ROWS), blocks)
    errors = [*relative_errors(found_smooth, smooth), *relative_errors(found_blocks, blocks)]
    energy = float(found_smooth.sum() / smooth.sum())
    return (
        f"{asset:10}{seconds:7.1f}{errors[0]:9.3f}{errors[1]:7.3f}{errors[2]:10.3f}"
        f"{errors[3]:7.3f}{energy:8.3f}{floor:7.3f}"
    )


def draw(maps: dict[str, torch.Tensor], file: Path) -> None:
    """All maps below each other, after AgX; left as they are, right blurred."""
    figure, axes = plt.subplots(len(maps), 2, figsize=(10, 2.6 * len(maps)), squeeze=False)
    for (name, picture), row in zip(maps.items(), axes, strict=True):
        for axis, shown in zip(row, (picture, blurred_latlong(picture, height=ROWS)), strict=True):
            axis.imshow(np.asarray(agx(shown)))
            axis.set_title(name, fontsize=9)
            axis.axis("off")
    figure.tight_layout()
    figure.savefig(file, dpi=90)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=os.environ.get("SVIM3D_DATA"))
    parser.add_argument("--assets", nargs="+", choices=ASSETS, default=ASSETS)
    parser.add_argument("--picture", type=Path, default=ROOT / "benchmarks/results/environment.png")
    parser.add_argument("--set", nargs="*", default=[], metavar="FIELD=VALUE")
    arguments = parser.parse_args()
    if arguments.data is None:
        parser.error("--data is needed: no SVIM3D_DATA is set")
    pairs = (item.split("=", 1) for item in arguments.set)
    settings = EnvPreoptConfig(**{name: yaml.safe_load(value) for name, value in pairs})
    maps: dict[str, torch.Tensor] = {}
    print(json.dumps(settings.model_dump()), HEADER, sep="\n")
    for asset in arguments.assets:
        folder = arguments.data / "orbits" / asset
        truth = torch.from_numpy(read_rgb(folder / "env_A.exr"))
        found, seconds = recover(folder, settings)
        print(report(asset, found, truth, seconds, settings.size), flush=True)
        maps |= {"true light": truth, asset: found}
    arguments.picture.parent.mkdir(parents=True, exist_ok=True)
    draw(maps, arguments.picture)
    print(f"picture: {arguments.picture}")


if __name__ == "__main__":
    main()
