"""What `svim3d chart` measures: points (settings) and cases (a point of an orbit)."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from flows.cases import CaseProcess
from flows.chart_knobs import PHOTO, SCALES, VIEWS, Knob, Turn
from flows.config import PipelineConfig, load_config
from flows.pipeline import IMAGE_TO_ASSET
from stages.keys import code_digests, digest_input, digest_json, library_versions
from stages.settings.evaluation import EvaluationConfig

CASE_MODULE = "flows.chart_case"
MEASURED_BY = ("stages.given_views", "stages.evaluation")  # beside the stages of the pipeline
PRESET, SCALE = "presets", "scale"  # groups of points beside the knobs
STEPPED = ("env_preopt", "nerf", "dmtet")
# Distances of 30,000 points are within 1 % of those of 100,000; volumes are not charted.
SCORING = EvaluationConfig(surface_samples=30_000, volume_cells=64)


@dataclass(frozen=True)
class Point:
    """Settings whose cost and quality are measured.

    Attributes:
        name: of the point; short, without its like.
        group: a knob's name, `presets` or `scale`.
        about: what is turned.
        preset: name or file that the settings start from.
        overrides: as `--set` takes them.
        views: of the orbit that are given; None is all.
        size: longest side of the given views, pixels; None is as they are.
    """

    name: str
    group: str
    about: str
    preset: str
    overrides: tuple[str, ...] = ()
    views: int | None = None
    size: int | None = None

    @cached_property
    def config(self) -> PipelineConfig:
        """Its settings; raises `InputError` where they are wrong."""
        return load_config(PipelineConfig, self.preset, self.overrides)

    @property
    def is_preset(self) -> bool:
        """Whether a file of settings can say all of it; what is given to a run it cannot."""
        return self.views is None and self.size is None


@dataclass(frozen=True)
class Case:
    """One run: a point of an orbit, with a seed."""

    point: str
    orbit: str
    seed: int

    @property
    def name(self) -> str:
        """For a person."""
        return f"{self.point}, {self.orbit}" + (f", seed {self.seed}" if self.seed else "")


@dataclass(frozen=True)
class Bench:
    """What all cases share.

    Attributes:
        orbits: folders with their truth, by name.
        size: longest side that all views are averaged down to; None is as they are.
        photos: whether runs start from each orbit's photo instead of its views.
        store: where artifacts are kept.
        limit_s: seconds after which a case is ended.
        scoring: how finely assets are scored.
    """

    orbits: dict[str, Path]
    size: int | None
    photos: bool
    store: Path
    limit_s: float
    scoring: EvaluationConfig = SCORING
    code: str = field(default_factory=lambda: code_digest())

    @cached_property
    def _digests(self) -> dict[str, str]:
        return {name: digest_input(folder) for name, folder in self.orbits.items()}

    def request(self, point: Point, case: Case) -> dict[str, Any]:
        """What the process of a case reads."""
        return {
            "orbit": str(self.orbits[case.orbit].resolve()),
            "preset": point.preset,
            "overrides": list(point.overrides),
            "views": point.views,
            "size": point.size or self.size,
            "photos": self.photos,
            "seed": case.seed,
            "store": str(self.store.resolve()),
            "scoring": self.scoring.model_dump(mode="json"),
        }

    def key(self, point: Point, case: Case) -> str:
        """Names all that a result depends on."""
        asked = self.request(point, case)
        for name in ("orbit", "preset", "overrides", "store"):
            del asked[name]
        asked["config"] = point.config.model_dump(mode="json")
        asked |= {"truth": self._digests[case.orbit], "code": self.code}
        return digest_json(asked)

    def start(self, point: Point, case: Case) -> CaseProcess:
        """A process that carries a case out."""
        return CaseProcess(CASE_MODULE, self.request(point, case), self.limit_s)


def code_digest() -> str:
    """Digest of the code that makes and scores assets, and of the libraries."""
    digests: dict[str, str] = {}
    for module in (*(node.module for node in IMAGE_TO_ASSET.nodes), *MEASURED_BY):
        digests |= code_digests(module)
    return digest_json({"code": digests, "versions": library_versions()})


def points_of(
    base: str,
    presets: Sequence[str],
    knobs: Sequence[Knob],
    *,
    scales: Sequence[float] = SCALES,
    changes: Sequence[str] = (),
    given_px: int | None = None,
    photos: bool = False,
) -> list[Point]:
    """All points, the base first; each differs from those before it in what it computes.

    Args:
        base: preset, or file of one, that knobs are turned at.
        presets: to be measured as they are.
        knobs: to be turned.
        scales: factors of all step counts of the base.
        changes: overrides of all points, before their own.
        given_px: longest side of the views, by which larger images are no different ones.
        photos: whether runs start from photos.
    """
    changes = tuple(changes)
    found = [_preset_point(name, changes) for name in dict.fromkeys((base, *presets))]
    for knob in knobs:
        if knob.input in ("", PHOTO if photos else VIEWS):
            found += [_turned(found[0], knob, turn) for turn in knob.turns]
    found += [_scaled(found[0], factor) for factor in scales]
    seen: dict[str, Point] = {}
    for point in found:
        seen.setdefault(_effect(point, given_px), point)
    return list(seen.values())


def _preset_point(preset: str, changes: tuple[str, ...]) -> Point:
    return Point(Path(preset).stem, PRESET, "a preset as it is", preset, changes)


def _turned(base: Point, knob: Knob, turn: Turn) -> Point:
    """The base with one knob turned; a stage that the knob needs is brought back."""
    brought: tuple[str, ...] = ()
    skip = base.config.skip
    if knob.stage in skip:
        steps = [] if knob.steps is None else [f"{knob.stage}.steps={knob.steps}"]
        brought = (f"skip=[{', '.join(sorted(skip - {knob.stage}))}]", *steps)
    return Point(
        f"{knob.name} {turn.label}",
        knob.name,
        knob.about,
        base.preset,
        (*base.overrides, *brought, *turn.overrides),
        turn.views,
        turn.size,
    )


def _scaled(base: Point, factor: float) -> Point:
    """The base with all its step counts scaled."""
    counts = {stage: getattr(base.config, stage).steps for stage in STEPPED}
    changes = tuple(
        f"{stage}.steps={max(1, round(count * factor))}"
        for stage, count in counts.items()
        if stage not in base.config.skip
    )
    about = "steps of all phases"
    return Point(f"steps x{factor:g}", SCALE, about, base.preset, (*base.overrides, *changes))


def _effect(point: Point, given_px: int | None) -> str:
    """Names what a point computes: a stage that is left out has no settings."""
    page = point.config.model_dump(mode="json")
    skip = page["skip"] = sorted(page["skip"])
    for stage in skip:
        page.pop(stage, None)
    size = point.size
    if given_px is not None:
        for stage in ("nerf", "dmtet"):
            if stage in page:
                page[stage]["image_size"] = min(page[stage]["image_size"], given_px)
        size = None if size is not None and size >= given_px else size
    return digest_json({"config": page, "views": point.views, "size": size})
