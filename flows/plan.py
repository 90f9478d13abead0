"""What a run will do, stage by stage, and why: known before anything is computed or imported."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import cache
from pathlib import Path
from typing import Any

from flows.config import RunConfig, differences
from flows.pipeline import SOURCE, Node, Pipeline
from stages.errors import InputError
from stages.keys import SKIPPED_INPUT, Recipe, code_digests, digest_input, library_versions
from stages.manifest import Manifest
from stages.store import Store, Stored

MAX_REASONS = 3  # shown; the rest is counted
MAX_MANIFESTS = 300  # latest artifacts that an explanation looks at


class Verdict(StrEnum):
    """What a run does about a stage."""

    CACHED = "cached"
    COMPUTE = "compute"
    SKIPPED = "skipped"
    NOT_ASKED = "not asked for"


@dataclass(frozen=True)
class Selection:
    """Which part of the pipeline is asked for.

    Attributes:
        skip: stages to leave out; later ones do without.
        start: recompute this stage and all after it.
        until: stop after this stage.
        only: this stage alone, from artifacts that exist.
        force: recompute these though the store has them.
    """

    skip: frozenset[str] = frozenset()
    start: str | None = None
    until: str | None = None
    only: str | None = None
    force: frozenset[str] = frozenset()

    def check(self, pipeline: Pipeline) -> None:
        """Refuse names that do not exist and wishes that contradict each other.

        Raises:
            InputError: naming the options.
        """
        names = pipeline.names
        named = {"--from": self.start, "--until": self.until, "--only": self.only}
        wishes = [(option, name) for option, name in named.items() if name is not None]
        wishes += [("--force", name) for name in sorted(self.force)]
        for option, name in [*wishes, *(("--skip", name) for name in sorted(self.skip))]:
            if name not in names:
                raise InputError(f"{option} {name}: no such stage; choose from {', '.join(names)}")
        for name in sorted(self.skip - set(pipeline.skippable)):
            can = ", ".join(pipeline.skippable)
            raise InputError(f"--skip {name}: later stages need it; {can} can be left out")
        for option, name in wishes:
            if name in self.skip:
                raise InputError(f"{option} {name}: the stage is skipped; drop one of the two")
        if self.only and (self.start or self.until):
            raise InputError("--only names the one stage to run; drop --from and --until")
        if self.only and self.force - {self.only}:
            raise InputError(f"--only {self.only} runs no other stage; drop --force of others")
        if self.until:
            last = names.index(self.until)
            for option, name in wishes:
                if names.index(name) > last:
                    raise InputError(f"{option} {name} comes after --until {self.until}")

    def check_idle(self, idle: set[str], source: Path) -> None:
        """Refuse wishes for a stage that does nothing for this input.

        Raises:
            InputError: naming the option.
        """
        named = {"--from": self.start, "--until": self.until, "--only": self.only}
        wishes = [*named.items(), *(("--force", name) for name in sorted(self.force))]
        for option, name in wishes:
            if name in idle:
                raise InputError(
                    f"{option} {name}: the stage has nothing to do for {source.name}; drop it"
                )

    def wants(self, pipeline: Pipeline, name: str) -> bool:
        """Whether the run needs the stage's artifact."""
        if self.only:
            return name == self.only or name in _ancestors(pipeline, self.only)
        return self.until is None or pipeline.names.index(name) <= pipeline.names.index(self.until)

    def forced_by(self, pipeline: Pipeline, name: str) -> str | None:
        """The option that wants the stage computed though the store has it."""
        if name in self.force:
            return "--force"
        names = pipeline.names
        is_after = self.start is not None and names.index(name) >= names.index(self.start)
        return f"--from {self.start}" if is_after else None


@dataclass(frozen=True)
class Step:
    """One stage in a plan.

    Attributes:
        node: the stage in the pipeline.
        verdict: what will be done.
        reason: why, in words.
        recipe: what its artifact depends on; None when skipped.
        stored: the artifact, where there is a sound one.
    """

    node: Node
    verdict: Verdict
    reason: str
    recipe: Recipe | None
    stored: Stored | None

    @property
    def key8(self) -> str:
        """Short name of the artifact."""
        return self.recipe.key[:8] if self.recipe else ""


def state_of(step: Step, stored: Stored | None) -> str:
    """What became of a step, in a word."""
    if stored is None:
        return str(step.verdict)
    return "cached" if stored.is_cached else "computed"


@dataclass(frozen=True)
class Plan:
    """All that a run needs to know.

    Attributes:
        pipeline: its stages and products.
        steps: in order, one for each stage of the pipeline.
        source: the input from outside.
        config: settings of all stages.
        seed: of the run.
        selection: which part was asked for.
    """

    pipeline: Pipeline
    steps: tuple[Step, ...]
    source: Path
    config: RunConfig
    seed: int
    selection: Selection

    @property
    def to_compute(self) -> tuple[Step, ...]:
        """Steps that cost time."""
        return tuple(step for step in self.steps if step.verdict is Verdict.COMPUTE)


def make_plan(
    pipeline: Pipeline,
    config: RunConfig,
    *,
    source: Path,
    seed: int,
    store: Store,
    selection: Selection,
    code: Callable[[str], dict[str, str]] | None = None,
    explained: bool = True,
) -> Plan:
    """Look up every stage in the store and say why those that are missing are.

    Args:
        pipeline: stages and products.
        config: settings of all stages.
        source: the input from outside.
        seed: of the run.
        store: where artifacts are.
        selection: which part is asked for.
        code: tells the digests of a module and of what it imports; by default they are read.
        explained: whether to look for the nearest artifact of each that is missing, which reads
            hundreds of manifests.

    Raises:
        InputError: the input is not there or of no use, the wishes contradict each other, or
            `--only` lacks an artifact that it starts from.
    """
    pipeline.check(source)
    selection = replace(selection, skip=selection.skip | config.skip)
    selection.check(pipeline)
    idle = {node.name for node in pipeline.nodes if not node.has_work_for(source)}
    selection.check_idle(idle, source)
    recipes = _recipes(pipeline, config, source, seed, selection.skip | idle, code or code_digests)
    explain = _Explainer(store) if explained else _call_missing
    steps = []
    for node in pipeline.nodes:
        recipe = recipes.get(node.name)
        if node.name in idle:
            steps.append(Step(node, Verdict.SKIPPED, "nothing to do for this input", None, None))
            continue
        steps.append(_step(node, recipe, pipeline, selection, store, explain))
    _require_inputs_of_only(steps, selection)
    return Plan(pipeline, tuple(steps), source, config, seed, selection)


def _recipes(
    pipeline: Pipeline,
    config: RunConfig,
    source: Path,
    seed: int,
    skip: Iterable[str],
    code: Callable[[str], dict[str, str]],
) -> dict[str, Recipe]:
    """Recipes of all stages that are not skipped: each names its inputs by their keys."""
    keys: dict[str, str] = {SOURCE: digest_input(source)}
    keys |= {name: SKIPPED_INPUT for name in skip}
    versions = library_versions()
    recipes = {}
    for node in pipeline.nodes:
        if node.name in keys:
            continue
        recipes[node.name] = Recipe(
            stage=node.name,
            config=getattr(config, node.name).model_dump(mode="json"),
            seed=seed,
            inputs={name: keys[name] for name in node.inputs},
            code=code(node.module),
            versions=versions,
        )
        keys[node.name] = recipes[node.name].key
    return recipes


def _step(
    node: Node,
    recipe: Recipe | None,
    pipeline: Pipeline,
    selection: Selection,
    store: Store,
    explain: Callable[[Recipe], str],
) -> Step:
    if recipe is None:
        return Step(node, Verdict.SKIPPED, "left out by --skip or the preset", None, None)
    if not selection.wants(pipeline, node.name):
        option = f"--only {selection.only}" if selection.only else f"--until {selection.until}"
        return Step(node, Verdict.NOT_ASKED, f"by {option}", recipe, None)
    health = store.check(recipe.key)
    if health.stored is None:
        reason = f"damaged: {health.damage}" if health.damage else explain(recipe)
        return Step(node, Verdict.COMPUTE, reason, recipe, None)
    if forced_by := selection.forced_by(pipeline, node.name):
        return Step(node, Verdict.COMPUTE, f"asked for by {forced_by}", recipe, health.stored)
    return Step(node, Verdict.CACHED, "nothing changed", recipe, health.stored)


def _require_inputs_of_only(steps: Iterable[Step], selection: Selection) -> None:
    for step in steps:
        is_missing = step.verdict is Verdict.COMPUTE and step.node.name != selection.only
        if selection.only and is_missing:
            raise InputError(
                f"--only {selection.only} starts from {step.node.name}, which is not in the store "
                f"({step.reason}); use --until {selection.only} to compute what it needs"
            )


def _ancestors(pipeline: Pipeline, name: str) -> set[str]:
    """Stages that feed `name`, directly or through others."""
    inputs = {node.name: node.inputs for node in pipeline.nodes}
    found: set[str] = set()
    queue = list(inputs[name])
    while queue:
        upstream = queue.pop()
        if upstream != SOURCE and upstream not in found:
            found.add(upstream)
            queue.extend(inputs[upstream])
    return found


def _call_missing(_: Recipe) -> str:
    return "not in the store"


class _Explainer:
    """Says why a recipe has no artifact, by comparing it with the nearest one that has."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._manifests = cache(self._read_manifests)

    def __call__(self, recipe: Recipe) -> str:
        resumes = self._store.work(recipe.key).exists()
        suffix = "; an interrupted attempt will be taken up" if resumes else ""
        candidates = [
            reasons_to_differ(recipe, manifest.recipe)
            for manifest in self._manifests()
            if manifest.recipe.stage == recipe.stage
        ]
        if not candidates:
            return f"never computed{suffix}"
        reasons = min(candidates, key=len)  # of equally near ones the latest
        shown = reasons[:MAX_REASONS]
        if len(reasons) > MAX_REASONS:
            shown.append(f"and {len(reasons) - MAX_REASONS} more")
        return f"{', '.join(shown)}{suffix}"

    def _read_manifests(self) -> list[Manifest]:
        return list(self._store.recent(MAX_MANIFESTS))


def reasons_to_differ(recipe: Recipe, earlier: Recipe) -> list[str]:
    """What makes `recipe` another than `earlier`: settings, seed, inputs, code, versions."""
    reasons = [
        f"{recipe.stage}.{name} {_shown(old)} -> {_shown(new)}"
        for name, new, old in differences(recipe.config, earlier.config)
    ]
    if recipe.seed != earlier.seed:
        reasons.append(f"seed {earlier.seed} -> {recipe.seed}")
    reasons += [
        _input_reason(name, new, old)
        for name, new, old in differences(recipe.inputs, earlier.inputs)
    ]
    reasons += [f"code of {name}" for name, _, _ in differences(recipe.code, earlier.code)]
    reasons += [
        f"{name} {_shown(old)} -> {_shown(new)}"
        for name, new, old in differences(recipe.versions, earlier.versions)
    ]
    return reasons


def _input_reason(name: str, new: Any, old: Any) -> str:
    if new == SKIPPED_INPUT:
        return f"without {name} now"
    if old == SKIPPED_INPUT:
        return f"with {name} now"
    return "another input" if name == SOURCE else f"another {name}"


def _shown(value: Any) -> str:
    return "(none)" if value is ... else str(value)
