"""Trials of the stability suite: a hazard laid out as an input, an asset held against the truth.

What is true of a hazard is known to `svim3d.synthesis.hazards` alone; the pipeline is given an
orbit folder, or a mesh and a light, like anybody's.
"""

import json
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from stages.prefilter_cache import cached_operator
from svim3d.color import srgb_from_linear
from svim3d.io.exr import read_rgb, write_rgb
from svim3d.io.glb import glb_bytes, read_mesh
from svim3d.io.image import PAPER
from svim3d.io.orbit import write_orbit
from svim3d.io.thumbnail import encode_thumbnail
from svim3d.mesh.atlas import unwrap
from svim3d.mesh.cleanup import clean_surface, decimate
from svim3d.mesh.source_mesh import SourceMesh
from svim3d.mesh.topology import Topology
from svim3d.metrics import distance_to_surface, mean_angle_deg, psnr, sample_surface
from svim3d.render.deferred import Shader, environment_shader
from svim3d.render.pictures import render_pictures
from svim3d.shading.environment import octahedral_from_latlong
from svim3d.shading.tonemap import agx
from svim3d.synthesis.hazards.catalogue import HAZARDS as HAZARDS
from svim3d.synthesis.hazards.torture import torture_mesh
from svim3d.synthesis.hazards.trials import Darkroom, Trial, Truth

LIGHT_SIZE = 64  # octahedral map that trials are lit and judged by, texels
SUPERSAMPLE = 3
SAMPLES = 20_000  # points on each surface for distances
METAL = 0.5  # mean metallic from which an object counts as metal
STRIP_CELL_PX, STRIP_BYTES = 96, 9_000
# As phase 3 has them.
MAX_FACES, TEXTURE_SIZE, GUTTER_PX, ATLAS_TIMEOUT_S = 16_000, 1024, 4, 20.0
MIN_AREA_SHARE, MIN_EXTENT_SHARE = 0.002, 0.05

Figures = dict[str, float | int | bool | str | None]


@dataclass(frozen=True)
class Input:
    """What the pipeline is given.

    Attributes:
        source: an orbit folder or a mesh file.
        overrides: settings that belong to it, as `--set` takes them.
    """

    source: Path
    overrides: tuple[str, ...] = ()


def make_trial(
    hazard: str, variant: str, severity: float, seed: int, *, shared: Path, size: int, views: int
) -> Trial:
    """The trial of a hazard; `shared` is where prefilter operators are kept."""
    room = Darkroom(cached_operator(shared, LIGHT_SIZE), size, views)
    return HAZARDS[hazard].make(room, severity, seed, variant)


def lay_out(trial: Trial, folder: Path) -> Input:
    """Write what the pipeline is given into an empty folder."""
    if trial.light is None:
        write_orbit(folder, trial.cameras, trial.images, reference=trial.reference)
        return Input(folder)
    mesh, light = trial.truth.mesh, folder / "light.exr"
    write_rgb(light, trial.light.numpy(), half=False)
    material = mesh.materials[0]
    orm = torch.tensor([1.0, material.roughness_factor, material.metallic_factor])
    content = glb_bytes(
        vertices=mesh.vertices,
        faces=mesh.faces,
        normals=mesh.normals,
        basecolor=mesh.colors,
        orm=orm.expand(len(mesh.vertices), 3),
    )
    (folder / "thing.glb").write_bytes(content)
    cameras = trial.cameras
    return Input(
        folder / "thing.glb",
        (
            f"generation.environment={json.dumps(str(light))}",
            f"generation.size={cameras.height}",
            f"generation.views={len(cameras)}",
        ),
    )


def judge(trial: Trial, asset: Path, *, shared: Path) -> tuple[Figures, bytes]:
    """Figures of an asset against the truth, and a strip of pictures of both (JPEG).

    `score_db` is the worse of two means over held-out views: radiance after AgX under the light
    that was found, and under one that no view shows; over all pixels that truth or asset covers.

    Args:
        trial: what was asked for.
        asset: payload of the export stage.
        shared: where prefilter operators are kept.
    """
    truth = trial.truth
    latlong = torch.from_numpy(read_rgb(asset / "environment.exr"))
    finite = bool(torch.isfinite(latlong).all())
    try:
        mesh = read_mesh(asset / "asset.glb")
    except ValueError as error:
        return {"finite": False, "what": str(error)}, b""
    found = octahedral_from_latlong(latlong.nan_to_num(), LIGHT_SIZE)
    operator = cached_operator(shared, LIGHT_SIZE)
    shown = _shown(mesh, truth, environment_shader(operator(found)))
    relit = _shown(mesh, truth, environment_shader(operator(truth.new_light)))
    view_db = _decibels(shown["radiance"], truth.images["radiance"], shown["mask"], truth)
    relit_db = _decibels(relit["radiance"], truth.relit, relit["mask"], truth)
    covered, seen = truth.images["mask"] > 0.5, shown["mask"] > 0.5
    figures: Figures = {
        "finite": finite and all(bool(torch.isfinite(i).all()) for i in shown.values()),
        # A light that was given spoilt is not the one that the truth was seen in.
        "score_db": min(view_db, relit_db) if trial.light is None else relit_db,
        "view_db": view_db,
        "relit_db": relit_db,
        "basecolor_db": psnr(
            srgb_from_linear(shown["basecolor"]),
            srgb_from_linear(truth.images["basecolor"]),
            covered,
        ),
        "normal_deg": mean_angle_deg(shown["normal_world"], truth.images["normal_world"], covered),
        "mask_iou": float((covered & seen).sum() / (covered | seen).sum()),
        "distance": spread(mesh, truth.mesh),
        "roughness": float(shown["roughness"][seen].mean()),
        "metallic": float(shown["metallic"][seen].mean()),
        "is_metal": bool(shown["metallic"][seen].mean() > METAL),
        "was_metal": bool(truth.images["metallic"][covered].mean() > METAL),
        **_counts(mesh, truth),
    }
    return figures, _strip(trial, shown)


def _shown(mesh: SourceMesh, truth: Truth, shader: Shader) -> dict[str, Tensor]:
    return render_pictures(mesh, truth.cameras, shader, supersample=SUPERSAMPLE)


def _decibels(image: Tensor, true: Tensor, mask: Tensor, truth: Truth) -> float:
    """Mean over views of PSNR after AgX, where truth or asset is."""
    either = (truth.images["mask"] > 0.5) | (mask > 0.5)
    values = [
        psnr(agx(image[view]), agx(true[view]), either[view]) for view in range(len(truth.cameras))
    ]
    return float(np.mean(values))


def spread(one: SourceMesh, other: SourceMesh) -> float:
    """Mean distance between two surfaces, both ways (Chamfer); the object's longest side is 1."""
    generator = torch.Generator().manual_seed(0)
    here = sample_surface(one.vertices, one.faces, SAMPLES, generator)
    there = sample_surface(other.vertices, other.faces, SAMPLES, generator)
    forth = distance_to_surface(here, other.vertices, other.faces).mean()
    back = distance_to_surface(there, one.vertices, one.faces).mean()
    return 0.5 * float(forth + back)


def spread_of_files(one: Path, other: Path) -> float:
    """`spread` of two mesh files."""
    return spread(read_mesh(one), read_mesh(other))


def _counts(mesh: SourceMesh, truth: Truth) -> Figures:
    topology = Topology.of(mesh.vertices, mesh.faces)
    return {
        "faces": len(mesh.faces),
        "watertight": topology.is_closed,
        "should_be_watertight": truth.watertight,
        "parts": topology.parts,
        "cavities": topology.cavities,
        "euler": topology.euler,
        "true_euler": truth.euler,
    }


def _strip(trial: Trial, shown: dict[str, Tensor]) -> bytes:
    """Two given views, then truth beside asset from two held-out cameras."""
    truth = trial.truth.images
    cells = [_cell(trial.images, len(trial.cameras) // 3), _cell(trial.images, trial.reference)]
    for view in (0, 2):
        cells += [_cell(truth, view), _cell(shown, view)]
    width = STRIP_CELL_PX * len(cells)
    return encode_thumbnail(torch.cat(cells, 1), longest_px=width, most_bytes=STRIP_BYTES)


def _cell(images: dict[str, Tensor], view: int) -> Float[Tensor, "n n 3"]:
    """Radiance of a view on the sheets' paper."""
    mask = images["mask"][view].nan_to_num(0.0, 0.0, 0.0).clamp(0.0, 1.0)
    laid = PAPER * (1.0 - mask) + agx(images["radiance"][view].nan_to_num().clamp_min(0.0)) * mask
    planes = laid.permute(2, 0, 1)[None]
    size = (STRIP_CELL_PX, STRIP_CELL_PX)
    scaled = torch.nn.functional.interpolate(planes, size=size, mode="nearest-exact")
    return scaled[0].permute(1, 2, 0)


def unwrap_torture(kind: str, severity: float, seed: int) -> Figures:
    """What cleanup, decimation and atlas make of a mesh that they should never have to see.

    The mesh goes through all three as in phase 3, and once more to the atlas as it is.
    """
    vertices, faces = torture_mesh(kind, severity, seed)
    start = time.monotonic()
    fine = clean_surface(
        vertices, faces, min_area_share=MIN_AREA_SHARE, min_extent_share=MIN_EXTENT_SHARE
    )
    coarse = decimate(fine.vertices, fine.faces, max_faces=MAX_FACES)
    raw_faces = faces[:MAX_FACES]
    notes = [*fine.notes, *coarse.notes]
    figures: Figures = {"faces_given": len(faces), "faces": len(coarse.faces)}
    for name, (points, triangles) in {
        "": (coarse.vertices, coarse.faces),
        "raw_": (vertices, raw_faces),
    }.items():
        atlas = unwrap(
            points,
            triangles,
            texture_size=TEXTURE_SIZE,
            gutter_px=GUTTER_PX,
            timeout_s=ATLAS_TIMEOUT_S,
        )
        inside = (atlas.uv >= 0.0) & (atlas.uv <= 1.0) & torch.isfinite(atlas.uv)
        figures |= {
            f"{name}charts": atlas.charts,
            f"{name}coverage": len(atlas.texels.pixel) / TEXTURE_SIZE**2,
            f"{name}overlapping": len(atlas.texels.overlapping),
            f"{name}outside": int((~inside).sum()),
        }
        if atlas.fallback is not None:
            notes.append(atlas.fallback)
    topology = Topology.of(coarse.vertices, coarse.faces)
    is_whole = not any(figures[f"{n}{w}"] for n in ("", "raw_") for w in ("overlapping", "outside"))
    return figures | {
        "seconds": time.monotonic() - start,
        "finite": bool(torch.isfinite(coarse.vertices).all()),
        "is_whole": is_whole and len(coarse.faces) > 0,
        "watertight": topology.is_closed,
        "should_be_watertight": kind in ("noisy", "sliver-fan"),
        "notes": "; ".join(notes),
    }
