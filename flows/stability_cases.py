"""Cases of the stability suite: what is run, by which settings, and what is known already."""

import json
import sys
import tempfile
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from flows.case_process import Outcome as Outcome
from flows.case_process import ended
from flows.config import PipelineConfig, load_config
from flows.pipeline import IMAGE_TO_ASSET
from flows.stability_options import TINY
from stages.keys import code_digests, digest_json, library_versions

RESULTS = "results.jsonl"
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


class Results:
    """A line of JSON for each case that was run; a killed suite goes on where it was.

    Args:
        folder: of `results.jsonl`, made if it is not there.
        any_code: whether results of other code and settings are taken, too.
    """

    def __init__(self, folder: Path, *, any_code: bool = False) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._file = folder / RESULTS
        self._any_code = any_code
        self._known: dict[str, dict[str, Any]] = {}
        for line in self._lines():
            self._known[line["key"]] = line
            if any_code:
                self._known[digest_json(line["case"])] = line

    def _lines(self) -> Iterable[dict[str, Any]]:
        if not self._file.exists():
            return
        for line in self._file.read_text().splitlines():
            try:
                page = json.loads(line)
            except json.JSONDecodeError:
                continue  # cut off when the suite was killed
            if isinstance(page, dict) and {"key", "case"} <= page.keys():
                yield page

    def get(self, case: Case, key: str) -> dict[str, Any] | None:
        """What is known of a case."""
        other = self._known.get(digest_json(asdict(case))) if self._any_code else None
        return self._known.get(key, other)

    def put(self, case: Case, key: str, result: dict[str, Any]) -> dict[str, Any]:
        """Keep a result."""
        line = {"key": key, "case": asdict(case), **result}
        self._known[key] = line
        with self._file.open("a") as stream:
            # Begun anew, in case the last line was cut.
            stream.write("\n" + json.dumps(line) + "\n")
        return line


def run_case(case: Case, settings: Settings) -> dict[str, Any]:
    """Run a case in a process of its own; how it ended, and what it found."""
    preset, overrides = settings.of(case)
    with tempfile.TemporaryDirectory(prefix="svim3d-stability-") as work:
        out = Path(work) / "result.json"
        request = {
            "case": asdict(case),
            "preset": preset,
            "overrides": overrides,
            "size": settings.size,
            "views": settings.views,
            "store": str(settings.store.resolve()),
            "work": work,
            "out": str(out),
        }
        file = Path(work) / "request.json"
        file.write_text(json.dumps(request))
        failed = ended([sys.executable, "-m", CASE_MODULE, str(file)], settings.limit_s)
        return json.loads(out.read_text()) if out.exists() else failed
