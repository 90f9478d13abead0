"""What does a training example cost? CPU seconds by part, for invented objects.

    python benchmarks/bench_data.py [--objects 12] [--size 64] [--views 21] [--lights 4]
        [--seed 1] [--sheet FILE.png]

One thread; prefiltering operators and kernels are made before. The baseline is the deferred
renderer as it was: every view under every light by `render_mesh`, 2 x 2 samples a pixel, without
shadows. `--sheet` draws the objects: reference view in two lights, five more views, basecolor,
occlusion-roughness-metallic and normals.
"""

import argparse
import statistics
import sys
import time
from collections import defaultdict
from pathlib import Path

import torch
from torch import Tensor

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from svim3d.io.image import write_png  # noqa: E402
from svim3d.render.deferred import environment_shader, render_mesh  # noqa: E402
from svim3d.shading.prefilter import PyramidOperator  # noqa: E402
from svim3d.synthesis.dice import Dice  # noqa: E402
from svim3d.synthesis.example import TrainingExample  # noqa: E402
from svim3d.synthesis.examples import cameras_for, render_example  # noqa: E402
from svim3d.synthesis.lights import SIZE, random_light  # noqa: E402
from svim3d.synthesis.objects import random_object  # noqa: E402
from svim3d.synthesis.scenes import scene_of  # noqa: E402
from svim3d.synthesis.shadows import DepthPictures, shadowed_radiance  # noqa: E402
from svim3d.synthesis.trajectories import random_trajectory  # noqa: E402
from svim3d.synthesis.views import SUPERSAMPLE, sample_views  # noqa: E402


class Clock:
    """CPU seconds by name."""

    def __init__(self) -> None:
        self.seconds: dict[str, list[float]] = defaultdict(list)
        self._last = time.process_time()

    def lap(self, name: str) -> None:
        """Book the time since the last lap."""
        now = time.process_time()
        self.seconds[name].append(now - self._last)
        self._last = now


def measure(
    seed: int, index: int, given: argparse.Namespace, operator: PyramidOperator, clock: Clock
) -> int:
    """One object by parts, whole, and by the baseline; returns its faces."""
    dice = Dice.of(seed, index)
    clock.lap("start")
    thing = random_object(dice)
    clock.lap("object")
    scene, trajectory = scene_of(thing, 30.0), random_trajectory(dice, given.views)
    cameras, _ = cameras_for(scene, trajectory, given.size)
    pyramids = [operator(random_light(dice)) for _ in range(given.lights)]
    clock.lap("cameras and lights")
    samples = sample_views(scene.geometry, scene.materials, cameras)
    clock.lap("samples and materials")
    pictures = DepthPictures.of(scene.geometry)
    clock.lap("depth pictures")
    shadowed_radiance(samples, pictures, pyramids)
    clock.lap("light and shadows")
    render_example(seed, index, operator, size=given.size, views=given.views, lights=given.lights)
    clock.lap("example, whole")
    for pyramid in pyramids:
        shader = environment_shader(pyramid)
        for view in range(given.views):
            render_mesh(
                scene.geometry,
                scene.materials,
                cameras,
                view=view,
                shader=shader,
                supersample=SUPERSAMPLE,
            )
    clock.lap("baseline, view by view")
    return len(thing.assembly.faces)


def row(example: TrainingExample) -> Tensor:
    """One line of the sheet."""
    last = len(example.mask) - 1
    turns = [last * k // 6 for k in range(1, 6)]
    pictures = [example.rgb[0, last], example.rgb[-1, last], *(example.rgb[0, k] for k in turns)]
    pictures += [example.basecolor[last], example.orm[last], example.normal[last]]
    return torch.cat(pictures, 1).float() / 255.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--objects", type=int, default=12)
    parser.add_argument("--size", type=int, default=64)
    parser.add_argument("--views", type=int, default=21)
    parser.add_argument("--lights", type=int, default=4)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--sheet", type=Path)
    given = parser.parse_args()
    torch.set_num_threads(1)
    operator = PyramidOperator.build(SIZE)
    measure(given.seed, 0, given, operator, Clock())  # compiles
    clock = Clock()
    faces = [measure(given.seed, i, given, operator, clock) for i in range(given.objects)]
    print(
        f"{given.objects} objects of {min(faces)} to {max(faces)} faces (median "
        f"{statistics.median(faces):.0f}), {given.views} views of {given.size} px, "
        f"{given.lights} lights; torch {torch.__version__}"
    )
    print("part                      CPU s, mean   worst")
    for name, seconds in clock.seconds.items():
        if name != "start":
            print(f"{name:25} {statistics.mean(seconds):10.3f} {max(seconds):8.3f}")
    if given.sheet is not None:
        sizes = {"size": given.size, "views": given.views, "lights": given.lights}
        rows = [row(render_example(given.seed, i, operator, **sizes)) for i in range(given.objects)]
        write_png(given.sheet, torch.cat(rows))


if __name__ == "__main__":
    main()
