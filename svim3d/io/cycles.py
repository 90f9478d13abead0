"""Blender's Cycles as a path tracer in a process of its own.

A folder is exchanged: `corners.npz`, `light_N.exr` (lat-long) and `scene.json` go there,
`LIGHT_VIEW.exr` comes back. Blender's Python package `bpy` fits one Python and an older NumPy, so
that it lives in an environment of its own, whose interpreter the user names.

Source: Blender 4.5, Cycles and its Principled BSDF: GGX with multiple scattering over Lambert.
"""

import json
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from svim3d.cameras import Cameras
from svim3d.io.exr import read_exr, write_rgb
from svim3d.mesh.micropolygons import Micropolygons
from svim3d.shading.environment import latlong_from_octahedral

SCRIPT = Path(__file__).with_name("cycles_scene.py")
LIGHT_ROWS = 4  # of a lat-long picture per texel of an octahedral map's side: none is lost
DEVICES = ("cpu", "gpu")


@dataclass(frozen=True)
class Cycles:
    """How to reach Cycles.

    Attributes:
        python: interpreter that can import bpy.
        samples: paths per pixel.
        device: "cpu", one thread, or "gpu", the GPUs that Cycles finds.
        timeout_s: for all pictures of one call.
    """

    python: Path
    samples: int
    device: Literal["cpu", "gpu"]
    timeout_s: float


def render_with_cycles(
    cycles: Cycles,
    mesh: Micropolygons,
    cameras: Cameras,
    lights: Sequence[Float[Tensor, "n n 3"]],
    *,
    seed: int,
) -> list[Float[Tensor, "V H W 4"]]:
    """Path-traced views in each octahedral light: linear radiance, premultiplied, and coverage.

    Raises:
        ValueError: the interpreter is missing or cannot import bpy, rendering failed or took too
            long; says what to do.
    """
    with TemporaryDirectory(prefix="svim3d_cycles_") as name:
        folder = Path(name)
        write_exchange(folder, cycles, mesh, cameras, lights, seed=seed)
        run_script(cycles, folder)
        return read_pictures(folder, lights=len(lights), views=len(cameras))


def write_exchange(
    folder: Path,
    cycles: Cycles,
    mesh: Micropolygons,
    cameras: Cameras,
    lights: Sequence[Float[Tensor, "n n 3"]],
    *,
    seed: int,
) -> None:
    """Write what the script reads."""
    arrays = {field.name: getattr(mesh, field.name).float().numpy() for field in fields(mesh)}
    np.savez(folder / "corners.npz", **arrays)
    for index, light in enumerate(lights):
        latlong = latlong_from_octahedral(light, height=LIGHT_ROWS * light.shape[0])
        # Half floats would clip a small sun.
        write_rgb(folder / f"light_{index}.exr", latlong.float().numpy(), half=False)
    told = {
        "size": cameras.height,
        "fov_y_deg": cameras.fov_y_deg,
        "cameras": cameras.c2w.tolist(),
        "lights": len(lights),
        "samples": cycles.samples,
        "seed": seed,
        "device": cycles.device,
    }
    (folder / "scene.json").write_text(json.dumps(told))


def run_script(cycles: Cycles, folder: Path) -> None:
    """Have the interpreter render; see `render_with_cycles` for what is raised."""
    # Isolated, so that neither PYTHONPATH nor the modules beside the script are taken for others.
    command = [str(cycles.python), "-I", str(SCRIPT), str(folder)]
    try:
        done = subprocess.run(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            timeout=cycles.timeout_s,
            check=False,
        )
    except OSError as error:
        raise ValueError(
            f"wanted a Python that has bpy, but {cycles.python} cannot be started "
            f"({error.strerror}); name one with --cycles-python"
        ) from error
    except subprocess.TimeoutExpired as error:
        raise ValueError(
            f"Cycles took longer than {cycles.timeout_s:g} s for one example; ask for fewer "
            "--cycles-samples, or allow more with --cycles-timeout"
        ) from error
    if done.returncode:
        said = done.stdout.decode(errors="replace").strip().splitlines() or ["nothing was said"]
        raise ValueError(f"Cycles failed under {cycles.python}: {said[-1]}")


def read_pictures(folder: Path, *, lights: int, views: int) -> list[Float[Tensor, "V H W 4"]]:
    """What the script wrote, for each light.

    Raises:
        ValueError: a picture is missing or damaged.
    """

    def read(light: int, view: int) -> Float[Tensor, "H W 4"]:
        channels = read_exr(folder / f"{light}_{view}.exr")
        return torch.from_numpy(np.stack([channels[name] for name in "RGBA"], -1))

    return [torch.stack([read(light, view) for view in range(views)]) for light in range(lights)]
