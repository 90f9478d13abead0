"""What are shadows and interreflection worth? Both of our engines against another path tracer.

    python benchmarks/bench_path.py --data FOLDER [--assets cat boombox] [--views 0 3]
        [--samples 256] [--size 128] [--picture FILE]

`--data` (default: the environment variable SVIM3D_DATA) holds `glb/*.glb` and `orbits/<asset>`
with path-traced views of the same assets (`test_B`, `test_C`) and the maps that lit them. Each GLB
is put where the orbit's `source_to_world` says and seen by the test cameras, in three ways:
`raster` (our rasteriser and split sum, multiple scattering off as in the truth; the baseline), and
through Mitsuba `shadow` (direct light: paths of two vertices) and `full` (six, as in the truth).
Tangents are computed anew, as the truth's renderer does, whatever the file says.

Figures are PSNR after AgX on the mask (> 0.5), mean over views; the truth is averaged down to
`--size`. `energy` is the mean radiance of each over that of the truth. Seconds are CPU, per view.
"""

import argparse
import json
import os
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import torch
from torch import Tensor

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from svim3d.cameras import Cameras  # noqa: E402
from svim3d.io.exr import read_rgb  # noqa: E402
from svim3d.io.glb import read_mesh  # noqa: E402
from svim3d.io.orbit import read_orbit  # noqa: E402
from svim3d.mesh.frames import tangent_frames  # noqa: E402
from svim3d.mesh.source_mesh import SourceMesh  # noqa: E402
from svim3d.metrics import psnr  # noqa: E402
from svim3d.numerics import normalize  # noqa: E402
from svim3d.render.deferred import environment_shader  # noqa: E402
from svim3d.render.path_tracing import render_path_traced  # noqa: E402
from svim3d.render.pictures import render_pictures  # noqa: E402
from svim3d.shading.environment import octahedral_from_latlong, physical_radiance  # noqa: E402
from svim3d.shading.prefilter import PyramidOperator  # noqa: E402
from svim3d.shading.tonemap import agx  # noqa: E402

ASSETS = ("boombox", "barrel", "cat", "oculus")  # those that have a GLB
LIGHTS = "BC"
WAYS = ("raster", "shadow", "full")
LIGHT_SIZE = 256  # octahedral map of the true lights, 256 x 128 as files
SUPERSAMPLE = 4
VERTICES = {"shadow": 2, "full": 6}


@dataclass
class Case:
    """One asset under one light, with the truth at the size in use."""

    asset: str
    light: str
    mesh: SourceMesh
    cameras: Cameras
    radiance: Tensor  # of the light, lat-long
    truth: Tensor  # premultiplied radiance
    mask: Tensor

    @classmethod
    def read(cls, data: Path, asset: str, light: str, views: list[int], size: int) -> "Case":
        """Truth, light and the true mesh of one asset."""
        folder = data / "orbits" / asset
        index = json.loads((folder / "orbit.json").read_text())
        mesh = placed(read_mesh(data / "glb" / index["source_file"]), index["source_to_world"])
        cameras, images, _ = read_orbit(folder, f"test_{light}")
        radiance = torch.from_numpy(read_rgb(folder / index["environments"][light]["file"]))
        truth, mask = (
            torch.nn.functional.interpolate(
                images[name][views].permute(0, 3, 1, 2), size=(size, size), mode="area"
            ).permute(0, 2, 3, 1)
            for name in ("radiance", "mask")
        )
        cameras = cameras[views].resized(size, size)
        return cls(asset, light, mesh, cameras, physical_radiance(radiance)[0], truth, mask)


def placed(mesh: SourceMesh, transform: list[list[float]]) -> SourceMesh:
    """The mesh after a rotation, uniform scale and shift, with tangents of its own."""
    matrix = torch.tensor(transform)
    vertices = mesh.vertices @ matrix[:3, :3].T + matrix[:3, 3]
    normals = normalize(mesh.normals @ matrix[:3, :3].T)
    frames = tangent_frames(vertices, mesh.faces, normals, mesh.uv)
    source = frames.vertex_source.long()
    return replace(
        mesh,
        vertices=vertices[source],
        normals=normals[source],
        uv=mesh.uv[source],
        colors=mesh.colors[source],
        faces=frames.faces,
        tangents=frames.tangents,
    )


def render(case: Case, way: str, samples: int) -> Tensor:
    """Premultiplied radiance of all views."""
    if way == "raster":
        light = octahedral_from_latlong(case.radiance, LIGHT_SIZE)
        pyramid = PyramidOperator.build(LIGHT_SIZE)(light)
        shader = environment_shader(pyramid, multiple_scattering=False)
        return render_pictures(case.mesh, case.cameras, shader, supersample=SUPERSAMPLE)["radiance"]
    return render_path_traced(
        case.mesh,
        case.cameras,
        case.radiance,
        samples=samples,
        seed=0,
        max_depth=VERTICES[way],
    )["radiance"]


def measure(case: Case, samples: int) -> tuple[list[float], dict[str, Tensor]]:
    """PSNR, energy and seconds by way, and the pictures."""
    target, inside = agx(case.truth), case.mask > 0.5
    decibels, energies, seconds, pictures = [], [], [], {}
    for way in WAYS:
        started = time.process_time()
        pictures[way] = render(case, way, samples)
        seconds.append((time.process_time() - started) / len(case.cameras))
        shown = agx(pictures[way])
        views = zip(shown, target, inside, strict=True)
        decibels.append(float(np.mean([psnr(a, b, m) for a, b, m in views])))
        within = inside.expand_as(case.truth)
        energies.append(float(pictures[way][within].mean() / case.truth[within].mean()))
    return [*decibels, *energies, *seconds], pictures


def draw(rows: list[tuple[Case, dict[str, Tensor]]], file: Path) -> None:
    """Truth, all ways and three times the remaining difference: the first view of each case."""
    figure, axes = plt.subplots(len(rows), 5, figsize=(15, 3 * len(rows)), squeeze=False)
    for (case, pictures), row in zip(rows, axes, strict=True):
        target = agx(case.truth[0])
        shown = {f"{case.asset} {case.light}: truth": target}
        shown |= {way: agx(picture[0]) for way, picture in pictures.items()}
        shown["3 |full - truth|"] = (3.0 * (shown["full"] - target).abs()).clamp_max(1.0)
        for axis, (name, picture) in zip(row, shown.items(), strict=True):
            axis.imshow(picture.numpy())
            axis.set_title(name, fontsize=9)
            axis.axis("off")
    figure.tight_layout()
    figure.savefig(file, dpi=80)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=os.environ.get("SVIM3D_DATA"))
    parser.add_argument("--assets", nargs="+", choices=ASSETS, default=ASSETS)
    parser.add_argument("--views", nargs="+", type=int, default=list(range(6)))
    parser.add_argument("--samples", type=int, default=256, help="paths per pixel")
    parser.add_argument("--size", type=int, default=128, help="of the pictures, in pixels")
    parser.add_argument("--picture", type=Path, default=ROOT / "benchmarks/results/path.png")
    arguments = parser.parse_args()
    if arguments.data is None:
        parser.error("--data is needed: no SVIM3D_DATA is set")
    table, drawn = [], []
    print(f"{'':14}{'PSNR, dB':>27}{'energy':>27}{'CPU s per view':>27}")
    print("asset    light" + 3 * "".join(f"{way:>9}" for way in WAYS))
    for asset in arguments.assets:
        for light in LIGHTS:
            case = Case.read(arguments.data, asset, light, arguments.views, arguments.size)
            figures, pictures = measure(case, arguments.samples)
            table.append(figures)
            drawn.append((case, pictures))
            print(f"{asset:9}{light:5}" + "".join(f"{x:9.2f}" for x in figures), flush=True)
    print(f"{'mean':14}" + "".join(f"{x:9.2f}" for x in np.mean(table, 0)))
    arguments.picture.parent.mkdir(parents=True, exist_ok=True)
    draw(drawn, arguments.picture)
    print(f"picture: {arguments.picture}")


if __name__ == "__main__":
    main()
