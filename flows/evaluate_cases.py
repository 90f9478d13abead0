"""Cases of an evaluation: an object made by a row's settings, and the scores that it comes to.

A case is known by the key of its scores: what the store has is not computed again, so that a
killed evaluation goes on where it was.
"""

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from flows.cases import CaseProcess, outcome_of
from flows.config import PipelineConfig, load_config
from flows.pipeline import IMAGE_TO_ASSET
from flows.plan import Plan, Selection, make_plan
from flows.stability_cases import TINY_SETTINGS
from flows.stability_options import TINY
from stages.errors import InputError
from stages.keys import SKIPPED_INPUT, Recipe, code_digests, digest_input, library_versions
from stages.settings.table_scores import TableScoresConfig
from stages.store import Store

MODULE, STAGE = "stages.table_scores", "table_scores"
CASE_MODULE = "flows.evaluate_case"
MISSING = "missing_scores"
SCORES = "scores.json"
LAST_STAGE, VIEWS_STAGE = "export", "generation"
TINY_PX = 64  # rows of the views that settings of preset tiny are for
# As exact as an orbit's index writes its cameras; beyond this the generator is not asked for them.
MAX_AIM_ERROR_DEG = 2.0
MIN_DRAWN = 3  # cameras of a list, the photo's among them
STEEPEST_DEG = 60.0  # the generator's cameras stand between -60 and 89 degrees

Angles = tuple[tuple[float, float], ...]  # elevation and azimuth of cameras, degrees


@dataclass(frozen=True)
class Subject:
    """One object of a suite.

    Attributes:
        name: of the object.
        truth: folder in the layout of benchmark orbits.
    """

    name: str
    truth: Path


@dataclass(frozen=True)
class Row:
    """One way to make assets.

    Attributes:
        name: in the tables.
        preset: tiny, or one of the presets.
        overrides: as given to `--set`.
        skip: stages that are left out.
    """

    name: str
    preset: str
    overrides: tuple[str, ...] = ()
    skip: tuple[str, ...] = ()

    def config(self, more: Sequence[str] = ()) -> PipelineConfig:
        """Settings of all stages, with further overrides."""
        tiny = [*TINY_SETTINGS, *(f"{stage}.image_size={TINY_PX}" for stage in ("nerf", "dmtet"))]
        is_tiny = self.preset == TINY
        overrides = [*(tiny if is_tiny else ()), *more, *self.overrides]
        return load_config(
            PipelineConfig, "standard" if is_tiny else self.preset, overrides, self.skip
        )


def rows_of(preset: str, shared: Sequence[str], more: Sequence[Sequence[str]]) -> list[Row]:
    """The first row, by preset, and those that `--row` adds.

    Raises:
        InputError: a name is given twice, or a setting is wrong.
    """
    rows = [Row(preset, preset, tuple(shared))]
    for name, *settings in more:
        row = replace(rows[0], name=name)
        for setting in settings:
            key, _, value = setting.partition("=")
            if key == "preset":
                row = replace(row, preset=value)
            elif key == "skip":
                row = replace(row, skip=(*row.skip, value))
            else:
                row = replace(row, overrides=(*row.overrides, setting))
        rows.append(row)
    names = [row.name for row in rows]
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"--row {name}: there is a row of this name; give each another")
    for row in rows:
        row.config()
        Selection(skip=frozenset(row.skip)).check(IMAGE_TO_ASSET)
    return rows


@dataclass(frozen=True)
class Case:
    """What has to be known to score an object.

    Attributes:
        subject: the object.
        row: how it is made.
        plan: of the asset.
        novel: of what the generator draws at the test cameras; None for true views, or where the
            test cameras do not look at the object's centre.
        recipe: of the scores.
        config: of the scores.
    """

    subject: Subject
    row: Row
    plan: Plan
    novel: Plan | None
    recipe: Recipe
    config: TableScoresConfig


def plan_case(
    subject: Subject,
    row: Row,
    store: Store,
    *,
    from_photo: bool,
    config: TableScoresConfig,
    seed: int,
) -> Case:
    """Look a case up.

    Raises:
        InputError: the object lacks a photo, or views with materials.
    """
    index = json.loads((subject.truth / "orbit.json").read_text())
    source, angles = subject.truth, _angles(index.get("train", [])) if from_photo else ()
    if from_photo:
        source = _photo(subject, index)

    def plan(cameras: Sequence[tuple[float, float]], until: str) -> Plan:
        return make_plan(
            IMAGE_TO_ASSET,
            row.config(_drawn_at(cameras)),
            source=source,
            seed=seed,
            store=store,
            selection=Selection(until=until, skip=frozenset(row.skip)),
            explained=False,
        )

    asset = plan(angles, LAST_STAGE)
    tests = _angles(index.get("test", [])) if angles else ()
    novel = None
    if angles and len(tests) + 1 >= MIN_DRAWN:
        novel = plan((*tests, angles[-1]), VIEWS_STAGE)
    keys = {step.node.name: step.recipe.key for step in asset.steps if step.recipe}
    novel_keys = {s.node.name: s.recipe.key for s in novel.steps if s.recipe} if novel else {}
    recipe = Recipe(
        stage=STAGE,
        config=config.model_dump(mode="json"),
        seed=seed,
        inputs={
            "truth": digest_input(subject.truth),
            LAST_STAGE: keys[LAST_STAGE],
            VIEWS_STAGE: keys[VIEWS_STAGE],
            "novel": novel_keys.get(VIEWS_STAGE, SKIPPED_INPUT),
        },
        code=code_digests(MODULE),
        versions=library_versions(),
    )
    return Case(subject, row, asset, novel, recipe, config)


def _photo(subject: Subject, index: dict[str, Any]) -> Path:
    reference = index.get("reference")
    name = reference.get("file") if isinstance(reference, dict) else None
    if name is None or not (subject.truth / name).is_file():
        raise InputError(
            f"{subject.name} has no photo: wanted reference.file in "
            f"{subject.truth / 'orbit.json'}; say --from views"
        )
    return subject.truth / name


def _angles(frames: Sequence[dict[str, Any]]) -> Angles:
    """Elevation and azimuth of cameras that look at the origin; none where some do not."""
    angles = []
    for frame in frames:
        pose = frame["c2w"]
        x, y, z = (row[3] for row in pose[:3])
        distance = math.sqrt(x * x + y * y + z * z)
        backward = [row[2] for row in pose[:3]]
        aim = sum(a * b for a, b in zip(backward, (x, y, z), strict=True)) / distance
        elevation = math.degrees(math.asin(y / distance))
        if aim < math.cos(math.radians(MAX_AIM_ERROR_DEG)) or abs(elevation) >= STEEPEST_DEG:
            return ()
        angles.append((round(elevation, 4), round(math.degrees(math.atan2(x, z)), 4) % 360.0))
    return tuple(angles)


def _drawn_at(angles: Sequence[tuple[float, float]]) -> list[str]:
    """Overrides that let the generator draw at these cameras, where the last is the photo's."""
    if len(angles) < MIN_DRAWN or angles[-1][1] != 0.0:
        return []
    listed = json.dumps([list(pair) for pair in angles])
    return ["generation.path=list", f"generation.angles={listed}"]


def known_scores(case: Case, store: Store) -> dict[str, Any] | None:
    """Scores that the store has."""
    stored = store.check(case.recipe.key).stored
    if stored is None:
        return None
    page: dict[str, Any] = json.loads((stored.folder / SCORES).read_text())
    return page | {"cost": _cost(case, store), "folder": str(stored.folder)}


def missing_scores(subject: Subject, store: Store, config: TableScoresConfig) -> dict[str, Any]:
    """What Stanford-ORB's script tells of an object that has no asset.

    Raises:
        InputError: the truth cannot be read.
    """
    from stages.execution import choose_device, run_stage
    from stages.missing_scores import MISSING_SCORES

    recipe = Recipe(
        stage=MISSING,
        config=config.model_dump(mode="json"),
        seed=0,
        inputs={"truth": digest_input(subject.truth)},
        code=code_digests(f"stages.{MISSING}"),
        versions=library_versions(),
    )
    inputs = {"truth": subject.truth}
    device = choose_device("cpu")  # nothing is rendered
    stored = run_stage(store, recipe, MISSING_SCORES, inputs, config=config, device=device)
    page: dict[str, Any] = json.loads((stored.folder / SCORES).read_text())
    return page


def _cost(case: Case, store: Store) -> dict[str, float]:
    """What the asset took, by its artifacts' own records."""
    records = [
        stored.manifest.record
        for step in case.plan.steps
        if step.recipe is not None and (stored := store.check(step.recipe.key).stored)
    ]
    return {
        "seconds": sum(float(record.get("seconds", 0.0)) for record in records),
        "cpu_s": sum(float(record.get("cpu_seconds", 0.0)) for record in records),
    }


def run_case(
    case: Case, *, from_photo: bool, seed: int, device: str, store: Store, limit_s: float
) -> str | None:
    """Compute a case in a process of its own; why it failed, if it did."""
    request = {
        "subject": case.subject.name,
        "truth": str(case.subject.truth.resolve()),
        "row": [case.row.name, case.row.preset, case.row.overrides, case.row.skip],
        "config": case.config.model_dump(mode="json"),
        "from_photo": from_photo,
        "seed": seed,
        "device": device,
        "store": str(store.root.resolve()),
    }
    found = outcome_of(CaseProcess(CASE_MODULE, request, limit_s))
    error: str | None = found["error"]
    return f"{found['outcome']}: {error}" if "outcome" in found else error
