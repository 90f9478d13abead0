"""Evaluation: a finished asset against the true object, as `svim3d.render.asset_figures` has it.

Reads the truth (a folder in the layout of benchmark orbits: `test` views under environments A, B
and C, the maps that lit them, `mesh.ply`), the exported asset and, where phase 0 ran, its light;
writes `scores.json`. What is scored went through the file.
"""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import torch

from stages.artifacts import EnvironmentLight, ExportedAsset
from stages.base import Context, Stage
from stages.errors import InputError
from stages.prefilter_cache import cached_operator
from stages.settings.evaluation import EvaluationConfig
from svim3d.io.exr import read_rgb
from svim3d.io.glb import read_mesh
from svim3d.io.orbit import read_orbit
from svim3d.io.triangles import read_triangles
from svim3d.render.asset_figures import (
    Figures,
    LitViews,
    geometry_figures,
    light_figures,
    novel_view_figures,
    relight_figures,
)
from svim3d.shading.environment import physical_radiance

SEEN, UNSEEN = "A", ("B", "C")  # the light of the given views, and those of relighting
INDEX, MESH = "orbit.json", "mesh.ply"


@dataclass(frozen=True)
class AssetScores:
    """Figures by name; what each says is told in `svim3d.render.asset_figures`."""

    figures: Figures

    def save(self, folder: Path) -> None:
        """Write `scores.json`."""
        (folder / "scores.json").write_text(json.dumps(self.figures, indent=1))

    @classmethod
    def load(cls, folder: Path) -> Self:
        """Read it."""
        return cls(json.loads((folder / "scores.json").read_text()))

    def headline(self) -> str:
        """Relighting and geometry, in short."""
        relit, distance = self.figures["relight_db"], self.figures["distance"]
        return f"relit {relit:.1f} dB, surfaces {distance:.4f} apart"


def run(
    truth: Path,
    export: ExportedAsset,
    env_preopt: EnvironmentLight | None,
    *,
    config: EvaluationConfig,
    ctx: Context,
) -> AssetScores:
    """All figures of one asset.

    Raises:
        InputError: the truth lacks what figures are taken from.
    """
    glb = export.files["asset.glb"]
    file = ctx.work / "asset.glb"
    file.write_bytes(glb)
    mesh = read_mesh(file)
    try:
        surface = read_triangles(truth / MESH)
        lit = {name: _lit_views(truth, name) for name in (SEEN, *UNSEEN)}
    except ValueError as error:
        raise InputError(str(error)) from error
    figures = geometry_figures(
        mesh, surface, samples=config.surface_samples, resolution=config.volume_cells
    )
    figures |= novel_view_figures(mesh, lit[SEEN], supersample=config.supersample)
    figures |= relight_figures(
        mesh,
        [lit[name] for name in UNSEEN],
        cached_operator(ctx.shared, config.light_size),
        light_size=config.light_size,
        supersample=config.supersample,
    )
    figures |= {"faces": len(mesh.faces), "file_mib": len(glb) / 2**20}
    if env_preopt is not None:
        figures |= light_figures(env_preopt.latlong(), lit[SEEN].light)
    return AssetScores(figures)


def _lit_views(truth: Path, environment: str) -> LitViews:
    """The test views under one environment, and the map that lit them."""
    cameras, images, _ = read_orbit(truth, f"test_{environment}")
    index = json.loads((truth / INDEX).read_text())
    try:
        file = truth / index["environments"][environment]["file"]
    except (KeyError, TypeError) as error:
        raise ValueError(
            f"wanted environments.{environment}.file in {truth / INDEX}, got "
            f"{index.get('environments')}"
        ) from error
    if not file.is_file():
        raise ValueError(f"wanted the light of {truth / INDEX}, but {file} does not exist")
    return LitViews(cameras, images, physical_radiance(torch.from_numpy(read_rgb(file)))[0])


EVALUATION = Stage(run)
