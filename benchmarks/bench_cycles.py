"""How far is our rasteriser from Cycles, and what do both cost? RGB of the same examples.

    python benchmarks/bench_cycles.py --cycles-python PATH [--objects 3] [--size 64] [--views 3]
        [--lights 2] [--samples 64] [--seed 3] [--sheet FILE.png]

One thread. PSNR is of the display-referred pictures, where the mask is whole; the baseline is our
rasteriser, in the first columns of `--sheet`. Each example starts Cycles anew.
"""

import argparse
import resource
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import torch

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from stages.data_render import DataRequest, cycles_with, make_example  # noqa: E402
from stages.prefilter_cache import cached_operator  # noqa: E402
from svim3d.io.image import write_png  # noqa: E402
from svim3d.io.training_data import example_file, read_example  # noqa: E402
from svim3d.metrics import psnr  # noqa: E402
from svim3d.synthesis.example import TrainingExample  # noqa: E402
from svim3d.synthesis.lights import SIZE  # noqa: E402


def cpu_seconds() -> float:
    """Of this process and of all that it started."""
    usages = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(usage.ru_utime + usage.ru_stime for usage in usages)


def made(request: DataRequest, index: int) -> tuple[TrainingExample, float]:
    """An example and its CPU seconds."""
    request.folder.mkdir(exist_ok=True)
    start = cpu_seconds()
    make_example(request, index)
    spent = cpu_seconds() - start
    return read_example(example_file(request.folder, index)), spent


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cycles-python", type=Path, required=True)
    for name, value in (("objects", 3), ("size", 64), ("views", 3), ("lights", 2)):
        parser.add_argument(f"--{name}", type=int, default=value)
    parser.add_argument("--samples", type=int, default=64)
    parser.add_argument("--seed", type=int, default=3)
    parser.add_argument("--sheet", type=Path)
    given = parser.parse_args()
    torch.set_num_threads(1)
    cycles = cycles_with(
        given.cycles_python, samples=given.samples, device="cpu", timeout_s=86_400.0
    )
    rows = []
    print(f"{'':>3} {'object':12} {'PSNR dB':>8} {'raster s':>9} {'cycles s':>9}")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        raster = DataRequest(
            folder=folder / "raster",
            seed=given.seed,
            size=given.size,
            views=given.views,
            lights=given.lights,
            meshes=(),
            environments=(),
            cache=folder / "cache",
        )
        traced = replace(raster, folder=folder / "cycles", cycles=cycles)
        cached_operator(raster.cache, SIZE)
        made(raster, given.objects)  # so that kernels are compiled before
        for index in range(given.objects):
            (ours, cost), (theirs, price) = made(raster, index), made(traced, index)
            whole = (ours.mask == 255).expand(given.lights, -1, -1, -1, -1)
            apart = psnr(ours.rgb / 255.0, theirs.rgb / 255.0, whole)
            print(
                f"{index:3} {ours.metadata['name']:12} {apart:8.2f} {cost:9.2f} {price:9.2f}",
                flush=True,
            )
            both = [torch.cat(list(e.rgb[0]), 1) for e in (ours, theirs)]
            rows.append(torch.cat(both, 1))
    if given.sheet:
        write_png(given.sheet, torch.cat(rows) / 255.0)


if __name__ == "__main__":
    main()
