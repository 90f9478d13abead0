"""Cases of the stability suite: what is run, and by which settings."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from flows.cases import CaseProcess, outcome_of
from flows.config import PipelineConfig, load_config
from flows.pipeline import IMAGE_TO_ASSET
from flows.stability_options import TINY
from stages.keys import code_digests, digest_json, library_versions

CASE_MODULE, TRIAL_MODULE = "flows.stability_case", "stages.hazard_trial"

# About eight CPU seconds a case with all phases, of which two are the start of the process.
TINY_SETTINGS = (
    "env_preopt.size=32",
    "env_preopt.steps=40",
    "env_preopt.max_pixels=6000",
    "nerf.steps=96",
    "nerf.rays_per_step=768",
    "nerf.grid_nodes=[32, 48, 64]",
    "nerf.grid_shares=[0.0, 0.4, 0.7]",
    "nerf.hash_log2_entries=14",
    "nerf.hash_finest=128",
    "dmtet.steps=16",
    "dmtet.cells=40",
    "uv_bake.texture_size=256",
    "uv_bake.max_faces=3000",
    "uv_bake.fit_iterations=8",
    "uv_bake.occlusion_rays=8",
    "preview.cell=64",
    "preview.supersample=2",
)
# The paper's method without what has been added against views that disagree: no warp is gauged or
# weighed, no mask is outvoted.
PLAIN = (
    "nerf.warp_start=1",
    "nerf.weigh_views=false",
    "nerf.hull_rejections=0",
    "dmtet.warp_start=1",
    "dmtet.weigh_views=false",
    "uv_bake.correct_views=false",
)
OURS, BASELINE = "ours", "plain"


@dataclass(frozen=True)
class Case:
    """One run.

    Attributes:
        hazard: by name.
        variant: of it; empty where there is one.
        severity: how bad it is.
        seed: of hazard, object and pipeline.
        way: `ours` or `plain`.
    """

    hazard: str
    variant: str
    severity: float
    seed: int
    way: str

    @property
    def name(self) -> str:
        """For a person."""
        variant = f" ({self.variant})" if self.variant else ""
        return f"{self.hazard}{variant} {self.severity:g}, seed {self.seed}, {self.way}"


@dataclass(frozen=True)
class Settings:
    """What all cases share.

    Attributes:
        preset: `tiny` or one of the presets.
        overrides: as given to `--set`.
        size: rows and columns of the views.
        views: of an orbit.
        store: where artifacts are kept.
        limit_s: seconds after which a case is ended.
    """

    preset: str
    overrides: tuple[str, ...]
    size: int
    views: int
    store: Path
    limit_s: float

    def of(self, case: Case) -> tuple[str, list[str]]:
        """Preset and overrides of a case, later ones before earlier ones."""
        sized = [f"nerf.image_size={self.size}", f"dmtet.image_size={self.size}"]
        tiny = [*TINY_SETTINGS, *sized] if self.preset == TINY else []
        plain = PLAIN if case.way == BASELINE else ()
        return "standard" if self.preset == TINY else self.preset, [*tiny, *plain, *self.overrides]

    def key(self, case: Case, code: str) -> str:
        """Names all that a result depends on; raises `InputError` where settings are wrong."""
        preset, overrides = self.of(case)
        config = load_config(PipelineConfig, preset, overrides).model_dump(mode="json")
        shape = [self.size, self.views]
        return digest_json({"case": asdict(case), "config": config, "shape": shape, "code": code})


def code_digest() -> str:
    """Digest of the code of all stages and of the trials, and of the libraries."""
    digests: dict[str, str] = {}
    for module in (*(node.module for node in IMAGE_TO_ASSET.nodes), TRIAL_MODULE):
        digests |= code_digests(module)
    return digest_json({"code": digests, "versions": library_versions()})


def run_case(case: Case, settings: Settings) -> dict[str, Any]:
    """Run a case in a process of its own; how it ended, and what it found."""
    preset, overrides = settings.of(case)
    request = {
        "case": asdict(case),
        "preset": preset,
        "overrides": overrides,
        "size": settings.size,
        "views": settings.views,
        "store": str(settings.store.resolve()),
    }
    return outcome_of(CaseProcess(CASE_MODULE, request, settings.limit_s))
