"""How fast is relighting? Frames per second of one view while the light turns.

    python benchmarks/bench_relight_speed.py --data FOLDER [--asset boombox] [--frames 40]

`--data` (default: the environment variable SVIM3D_DATA) holds `orbits/<asset>`; the reference view
is lit by `env_A.exr`, turned by 5 degrees from frame to frame. A frame is everything up to 8-bit
display values: shading (and occlusion), AgX, rounding. What a view or a light costs once is told
apart. The baseline is what the paper does, in plain tensor operations: turn the map by resampling,
prefilter it anew by its eager samples' numbers as a stored operator, shade by the torch twin.
Wall seconds are medians; CPU seconds are those of the process over all frames.
"""

import argparse
import os
import statistics
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from stages.subject import BUFFERS  # noqa: E402
from svim3d.io.light import read_light  # noqa: E402
from svim3d.io.orbit import read_orbit  # noqa: E402
from svim3d.render.gbuffer import GBuffer  # noqa: E402
from svim3d.render.image_shading import ViewPoints  # noqa: E402
from svim3d.shading.environment import rotate_about_y  # noqa: E402
from svim3d.shading.prefilter import PyramidOperator  # noqa: E402
from svim3d.shading.split_sum import Shading, shade_plainly  # noqa: E402
from svim3d.shading.tonemap import agx  # noqa: E402

STEP_DEG = 5.0
LIGHT_SIZE = 256
Frame = Callable[[float], Tensor]


def resized(gbuffer: GBuffer, size: int) -> GBuffer:
    """The same view with more pixels: nearest neighbours, which cost what real ones would."""
    images = {
        name: torch.nn.functional.interpolate(image.permute(0, 3, 1, 2), size=(size, size))
        .permute(0, 2, 3, 1)
        .contiguous()
        for name, image in gbuffer.images().items()
    }
    return GBuffer.of(gbuffer.cameras.resized(size, size), images)


def displayed(points: ViewPoints, shading: Shading) -> Tensor:
    """The picture in 8-bit display values."""
    return points.image((agx(shading.radiance) * 255.0).round().to(torch.uint8))


def methods(gbuffer: GBuffer, light: Tensor) -> dict[str, tuple[Frame, float]]:
    """Frame functions by name, and the seconds that each view costs once."""
    pyramid = PyramidOperator.build(LIGHT_SIZE, "hybrid", "relighting")(light)
    paper = PyramidOperator.build(LIGHT_SIZE, "sampled")
    points = ViewPoints.of(gbuffer, 0)
    ViewPoints.occluded(gbuffer, 0)  # compiles
    start = time.perf_counter()
    traced = ViewPoints.occluded(gbuffer, 0)
    traced_s = time.perf_counter() - start

    def baseline(azimuth: float) -> Tensor:
        turned = paper(rotate_about_y(light, azimuth))
        shader = partial(shade_plainly, pyramid=turned, multiple_scattering=True)
        return displayed(points, points.lit(turned, shader=shader))

    def open_air(azimuth: float) -> Tensor:
        return displayed(points, points.lit(pyramid, azimuth_deg=azimuth))

    def occluded(azimuth: float) -> Tensor:
        return displayed(traced, traced.lit(pyramid, azimuth_deg=azimuth))

    return {
        "paper, plain torch": (baseline, 0.0),
        "without occlusion": (open_air, 0.0),
        "with occlusion": (occluded, traced_s),
    }


def measure(frame: Frame, frames: int) -> tuple[float, float]:
    """Median wall seconds and mean CPU seconds of a frame."""
    frame(0.0)
    walls, cpu = [], time.process_time()
    for index in range(frames):
        start = time.perf_counter()
        frame(STEP_DEG * index)
        walls.append(time.perf_counter() - start)
    return statistics.median(walls), (time.process_time() - cpu) / frames


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=os.environ.get("SVIM3D_DATA"))
    parser.add_argument("--asset", default="boombox")
    parser.add_argument("--sizes", type=int, nargs="+", default=[256, 576])
    parser.add_argument("--frames", type=int, default=40)
    given = parser.parse_args()
    if given.data is None:
        parser.error("--data is needed: no SVIM3D_DATA is set")
    folder = given.data / "orbits" / given.asset
    cameras, images, reference = read_orbit(folder, wanted=BUFFERS)
    view = GBuffer.of(cameras, images).take([reference])
    light = read_light(folder / "env_A.exr").octahedral(LIGHT_SIZE)
    print(f"{torch.get_num_threads()} threads, torch {torch.__version__}, {given.asset}")
    print("size  covered  method               frames/s  ms wall  ms CPU  once per view, ms")
    for size in given.sizes:
        gbuffer = view if size == cameras.height else resized(view, size)
        covered = int((gbuffer.mask > 0.5).sum())
        for name, (frame, once_s) in methods(gbuffer, light).items():
            wall_s, cpu_s = measure(frame, given.frames)
            print(
                f"{size:4}{covered:9}  {name:20}{1 / wall_s:9.1f}{1000 * wall_s:9.1f}"
                f"{1000 * cpu_s:8.1f}{1000 * once_s:12.0f}",
                flush=True,
            )


if __name__ == "__main__":
    main()
