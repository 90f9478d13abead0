"""Training data: examples rendered into a folder, one file each, by any number of processes.

Reads meshes and environments where some are named; writes `NNNNNN.safetensors` and `dataset.json`.
Example i of a seed is always the same, so a folder can grow, and a run that was stopped goes on
where it was: whole files are kept, the rest is made. RGB comes from our rasteriser or, with shadows
and light from surface to surface as they are, from Cycles.
"""

import functools
import json
import math
import multiprocessing
import os
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from stages.errors import InputError
from stages.prefilter_cache import cached_operator
from svim3d.io.cycles import Cycles, render_with_cycles
from svim3d.io.glb import read_mesh
from svim3d.io.light import SUFFIXES as LIGHT_SUFFIXES
from svim3d.io.light import read_light
from svim3d.io.obj import read_obj
from svim3d.io.training_data import example_file, is_whole, read_example_metadata, write_example
from svim3d.mesh.source_mesh import SourceMesh, normalised
from svim3d.synthesis.example import TrainingExample
from svim3d.synthesis.examples import FOV_DEG, Renderer, Shot, render_example
from svim3d.synthesis.lights import SIZE
from svim3d.synthesis.scenes import micropolygons
from svim3d.synthesis.views import with_coverage

SUMMARY = "dataset.json"
MESH_SUFFIXES = (".glb", ".gltf", ".obj")
# One thread a process: the pictures are small, and as many processes as cores are wanted anyway.
ONE_THREAD = {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
EXAMPLES_PER_CALL = 4  # that a process is handed at a time: about a second of work
EDGE_PX = 1.0  # of the triangles that carry materials to Cycles, about; see `micropolygons`
# More than an example has pictures, whose seeds count up from its own.
SEEDS_PER_EXAMPLE = 1 << 16
RASTER = "raster"
KEPT_MESHES = 4  # that a process holds: examples of one mesh are far apart

Status = Literal["made", "kept", "skipped"]


@dataclass(frozen=True)
class DataRequest:
    """What to render.

    Attributes:
        folder: where the files go.
        seed: of everything that is drawn.
        size: side of the pictures, pixels.
        views: per example; the last is the reference.
        lights: per example.
        meshes: files to show one after the other, over and over; none invents objects.
        environments: files that every other light is taken from; none invents all lights.
        cache: folder of derived data that runs share.
        cycles: what makes the RGB pictures; None is our rasteriser.
    """

    folder: Path
    seed: int
    size: int
    views: int
    lights: int
    meshes: tuple[Path, ...]
    environments: tuple[Path, ...]
    cache: Path
    cycles: Cycles | None = None

    @property
    def backend(self) -> str:
        """What makes the RGB pictures, and how well."""
        return RASTER if self.cycles is None else f"cycles, {self.cycles.samples} samples"

    def settings(self) -> dict[str, Any]:
        """What all examples of a folder have in common."""
        return {
            "seed": self.seed,
            "size": self.size,
            "views": self.views,
            "lights": self.lights,
            "fov_deg": FOV_DEG,
            "meshes": [file.name for file in self.meshes],
            "environments": [file.name for file in self.environments],
            "backend": self.backend,
        }


@dataclass(frozen=True)
class Outcome:
    """What became of one example.

    Attributes:
        index: of the example.
        status: made now, kept from before, or skipped because its mesh cannot be read.
        message: why it was skipped.
    """

    index: int
    status: Status
    message: str = ""


def files_in(folder: Path | None, suffixes: tuple[str, ...], what: str) -> tuple[Path, ...]:
    """The files of a folder, by name; none without a folder.

    Raises:
        InputError: there is no such folder, or nothing in it.
    """
    if folder is None:
        return ()
    if not folder.is_dir():
        raise InputError(f"there is no folder {folder}; name one with {what}")
    found = sorted(f for f in folder.rglob("*") if f.suffix.lower() in suffixes)
    if not found:
        raise InputError(f"wanted {what} ({', '.join(suffixes)}) in {folder}, but there are none")
    return tuple(found)


def mesh_files(folder: Path | None) -> tuple[Path, ...]:
    """Meshes in a folder and below; see `files_in`."""
    return files_in(folder, MESH_SUFFIXES, "meshes")


def environment_files(folder: Path | None) -> tuple[Path, ...]:
    """Environments in a folder and below; see `files_in`."""
    return files_in(folder, LIGHT_SUFFIXES, "environments")


def cycles_with(
    python: Path | None, *, samples: int, device: Literal["cpu", "gpu"], timeout_s: float
) -> Cycles:
    """Cycles, run by an interpreter; see `Cycles`.

    Raises:
        InputError: no interpreter is named.
    """
    if python is None:
        raise InputError(
            "--backend cycles wants a Python that has Blender's package: python3.11 -m venv DIR, "
            "DIR/bin/pip install bpy==4.5.*, then --cycles-python DIR/bin/python"
        )
    return Cycles(python, samples, device, timeout_s)


def render_data(request: DataRequest, objects: int, workers: int) -> Iterator[Outcome]:
    """Make what is missing of examples 0 to `objects` - 1, and tell of each when it is there.

    `dataset.json` is written first, with the settings, and again at the end, with counts.

    Raises:
        InputError: the folder holds data of other settings, or cannot be written.
    """
    _claim(request)
    # Compiled or read once here, so that the processes find it ready.
    cached_operator(request.cache, SIZE)
    tally = Counter[Status]()
    for outcome in _outcomes(request, range(objects), workers):
        tally[outcome.status] += 1
        yield outcome
    _write_summary(request, {"skipped": tally["skipped"], **_counts(request.folder)})


def _outcomes(request: DataRequest, indices: range, workers: int) -> Iterator[Outcome]:
    """Examples as they are made, in order; by processes of one thread each."""
    make = functools.partial(make_example, request)
    if workers <= 1:
        yield from map(make, indices)
        return
    before = {name: os.environ.get(name) for name in ONE_THREAD}
    os.environ.update(ONE_THREAD)
    # Fresh processes: a fork would share locks of thread pools that may be held.
    pool = ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context("spawn"))
    try:
        yield from pool.map(make, indices, chunksize=EXAMPLES_PER_CALL)
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
        for name, value in before.items():
            os.environ.pop(name)
            if value is not None:
                os.environ[name] = value


def make_example(request: DataRequest, index: int) -> Outcome:
    """Render and write one example, unless it is there."""
    file = example_file(request.folder, index)
    if is_whole(file):
        return Outcome(index, "kept")
    # Sums over several threads would differ in their last bits from machine to machine.
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        return _make(request, index, file)
    finally:
        torch.set_num_threads(threads)


def _make(request: DataRequest, index: int, file: Path) -> Outcome:
    """Render and write one example, or tell which mesh cannot be rendered."""
    if not request.meshes:
        example = _rendered(request, index, None)
    else:
        path = request.meshes[index % len(request.meshes)]
        try:
            example = _rendered(request, index, (path.stem, _mesh(path)))
        except InputError:  # not of the mesh, but of what all of them need
            raise
        except Exception as error:  # of any kind: one broken file must not end the run
            return Outcome(index, "skipped", f"{path} was left out: {error}")
    metadata = {**example.metadata, "backend": request.backend}
    write_example(file, replace(example, metadata=metadata))
    return Outcome(index, "made")


def _rendered(
    request: DataRequest, index: int, mesh: tuple[str, SourceMesh] | None
) -> TrainingExample:
    return render_example(
        request.seed,
        index,
        cached_operator(request.cache, SIZE),
        size=request.size,
        views=request.views,
        lights=request.lights,
        mesh=mesh,
        maps=_maps(request.environments),
        renderer=_renderer(request, index),
    )


def _renderer(request: DataRequest, index: int) -> Renderer | None:
    """Cycles, if it is wanted, with random numbers of the example's own."""
    cycles = request.cycles
    if cycles is None:
        return None
    seed = (request.seed * 1_000_003 + index) * SEEDS_PER_EXAMPLE

    def path_traced(shot: Shot) -> list[Tensor]:
        height = 2.0 * math.tan(math.radians(shot.cameras.fov_y_deg) / 2.0)
        pixel = height * float(shot.cameras.positions[0].norm()) / shot.cameras.height
        mesh = micropolygons(shot.scene, EDGE_PX * pixel)
        try:
            pictures = render_with_cycles(cycles, mesh, shot.cameras, shot.lights, seed=seed)
        except ValueError as error:
            raise InputError(str(error)) from error
        return [with_coverage(picture, shot.samples.mask) for picture in pictures]

    return path_traced


@functools.lru_cache(maxsize=KEPT_MESHES)
def _mesh(file: Path) -> SourceMesh:
    mesh = read_obj(file) if file.suffix.lower() == ".obj" else read_mesh(file)
    return normalised(mesh, file.name)


@functools.lru_cache(maxsize=1)
def _maps(files: tuple[Path, ...]) -> tuple[tuple[str, Float[Tensor, "n n 3"]], ...]:
    """Names and octahedral maps of environment files."""

    def silent(_kind: str, _message: str) -> None:
        """A few mended texels do not matter here, and every process would tell of them."""

    return tuple((file.stem, read_light(file, silent).octahedral(SIZE)) for file in files)


def _claim(request: DataRequest) -> None:
    """Make the folder, or see that it holds data of the same settings."""
    file = request.folder / SUMMARY
    try:
        request.folder.mkdir(parents=True, exist_ok=True)
        if file.is_file():
            # Folders that name no backend are from when there was one.
            there = {"backend": RASTER, **json.loads(file.read_text())}
            other = {k: there.get(k) for k, v in request.settings().items() if there.get(k) != v}
            if other:
                raise InputError(
                    f"{request.folder} holds data of other settings ({other}); use those, or "
                    "choose another folder"
                )
        else:
            _write_summary(request, {})
    except (OSError, json.JSONDecodeError) as error:
        raise InputError(f"{request.folder} cannot be used: {error}") from error


def _counts(folder: Path) -> dict[str, Any]:
    """How many examples of which quality and name a folder holds."""
    about = [read_example_metadata(file) for file in sorted(folder.glob("*.safetensors"))]
    return {
        "objects": len(about),
        "quality": dict(sorted(Counter(a["quality"] for a in about).items())),
        "names": dict(sorted(Counter(a["name"] for a in about).items())),
    }


def _write_summary(request: DataRequest, counts: dict[str, Any]) -> None:
    """Write `dataset.json` in one step."""
    temporary = request.folder / f".{SUMMARY}.tmp"
    temporary.write_text(json.dumps({**request.settings(), **counts}, indent=2) + "\n")
    temporary.replace(request.folder / SUMMARY)
