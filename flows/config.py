"""Settings of a run: defaults in the code, then a preset, then overrides from the command line."""

import copy
import dataclasses
import difflib
import importlib.resources
import typing
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_serializer

from stages.errors import InputError
from stages.settings.capacity import CapacityConfig
from stages.settings.dmtet import DmtetConfig
from stages.settings.env_preopt import EnvPreoptConfig
from stages.settings.export import ExportConfig
from stages.settings.generation import GenerationConfig
from stages.settings.nerf import NerfConfig
from stages.settings.prepare import PrepareConfig
from stages.settings.preview import PreviewConfig
from stages.settings.relight import RelightConfig
from stages.settings.uv_bake import UvBakeConfig

PRESETS = ("preview", "standard", "paper", "auto")  # from quick to thorough, and what is needed
PRESET_SUFFIXES = (".yaml", ".yml")  # what ends so is a file of one's own
ABOUT = "about"  # the one key of a preset file that is no setting: a line for `svim3d presets`
NEAREST_NAMES = 3


class RunConfig(BaseModel):
    """What every pipeline's settings have beside one field per stage."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    skip: frozenset[str] = Field(frozenset(), description="stages to leave out")

    @field_serializer("skip", when_used="json")
    def _in_order(self, skip: frozenset[str]) -> list[str]:
        """A set's own order changes from process to process, and keys of cases are made of it."""
        return sorted(skip)


class PipelineConfig(RunConfig):
    """Settings of all stages from photo to asset."""

    skip: frozenset[str] = Field(
        frozenset({"capacity"}), description="stages to leave out; preset `auto` has them all"
    )
    prepare: PrepareConfig = PrepareConfig()
    # Made when it is needed: it digests the files of a model.
    generation: GenerationConfig = Field(default_factory=GenerationConfig)
    capacity: CapacityConfig = CapacityConfig()
    env_preopt: EnvPreoptConfig = EnvPreoptConfig()
    nerf: NerfConfig = NerfConfig()
    dmtet: DmtetConfig = DmtetConfig()
    uv_bake: UvBakeConfig = UvBakeConfig()
    export: ExportConfig = ExportConfig()
    preview: PreviewConfig = PreviewConfig()


class RelightRunConfig(RunConfig):
    """Settings of relighting."""

    relight: RelightConfig = RelightConfig()


ConfigT = TypeVar("ConfigT", bound=RunConfig)
SettingsT = TypeVar("SettingsT", bound=BaseModel)


def load_config(
    schema: type[ConfigT], preset: str, overrides: Sequence[str] = (), skip: Iterable[str] = ()
) -> ConfigT:
    """Defaults of `schema`, changed by a preset, then by `key.path=value` overrides.

    Args:
        schema: the settings of a pipeline.
        preset: name of a file in `configs`, or path of a file like those.
        overrides: as given to `--set`; values are YAML.
        skip: stages to leave out beside those that the preset leaves out.

    Raises:
        InputError: an unknown name (with the nearest valid ones) or a value out of bounds.
    """
    values = preset_values(preset)
    _override(schema, values, overrides)
    left_out = values.get("skip", sorted(schema.model_fields["skip"].default))
    if not isinstance(left_out, list):
        raise InputError(f"--set skip={left_out}: wanted a list of stages, like skip=[dmtet]")
    values["skip"] = [*left_out, *skip]
    return validated(schema, values)


def _override(schema: type[BaseModel], values: dict[str, Any], overrides: Sequence[str]) -> None:
    """Change nested values as `--set` says."""
    for override in overrides:
        path, value = _parse_override(override)
        _require_known(schema, path, origin="--set")
        _set(values, path, value)


def validated(
    schema: type[SettingsT], values: Mapping[str, Any], overrides: Sequence[str] = ()
) -> SettingsT:
    """Settings made of nested names and values, then of `key.path=value` overrides.

    Raises:
        InputError: an unknown name (with the nearest valid ones) or a value out of bounds.
    """
    changed = copy.deepcopy(dict(values))
    _override(schema, changed, overrides)
    try:
        return schema.model_validate(changed)
    except ValidationError as error:
        raise InputError(_in_short(error, schema)) from error


def preset_values(preset: str) -> dict[str, Any]:
    """What a preset changes, as nested names and values."""
    values = _read_preset(preset)
    values.pop(ABOUT, None)
    return values


def preset_about(preset: str) -> str:
    """What a preset is for, in a line."""
    return str(_read_preset(preset).get(ABOUT, ""))


def _read_preset(preset: str) -> dict[str, Any]:
    if is_preset_file(preset):
        return _read_preset_file(Path(preset))
    if preset not in PRESETS:
        raise InputError(
            f"preset {preset!r} is unknown; choose one of {', '.join(PRESETS)}, or give a .yaml "
            "file"
        )
    file = importlib.resources.files("configs") / f"{preset}.yaml"
    values: dict[str, Any] = yaml.safe_load(file.read_text()) or {}
    return values


def is_preset_file(preset: str) -> bool:
    """Whether a preset is a file of one's own, not one of ours by name."""
    return preset.endswith(PRESET_SUFFIXES)


def resolved_preset(preset: str) -> str:
    """The same preset for a command that starts in another folder."""
    return str(Path(preset).resolve()) if is_preset_file(preset) else preset


def _read_preset_file(file: Path) -> dict[str, Any]:
    try:
        values = yaml.safe_load(file.read_text())
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"preset {file} cannot be read: {error}; check the path") from error
    except yaml.YAMLError as error:
        raise InputError(f"preset {file} is no YAML: {error}") from error
    if not isinstance(values, dict | None):
        raise InputError(
            f"wanted settings by stage in preset {file}, like 'nerf: {{steps: 400}}', got a "
            f"{type(values).__name__}"
        )
    return values or {}


def setting_names(schema: type[Any]) -> list[str]:
    """Every dotted name that `--set` understands."""
    return list(_walk_names(schema, ""))


def _walk_names(schema: type[Any], prefix: str) -> Iterator[str]:
    for name, annotation in _fields(schema).items():
        yield prefix + name
        for option in (annotation, *typing.get_args(annotation)):
            if isinstance(option, type):
                yield from _walk_names(option, f"{prefix}{name}.")


def _fields(schema: type[Any]) -> dict[str, Any]:
    """Names and types of a settings class; empty for a plain value."""
    if issubclass(schema, BaseModel):
        return {name: field.annotation for name, field in schema.model_fields.items()}
    if dataclasses.is_dataclass(schema):
        return typing.get_type_hints(schema)
    return {}


def _parse_override(override: str) -> tuple[str, Any]:
    path, separator, text = override.partition("=")
    if not separator or not path:
        raise InputError(f"--set {override!r} is no setting; write it as stage.name=value")
    try:
        return path.strip(), yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise InputError(f"--set {override!r}: the value is no YAML; quote it") from error


def _require_known(schema: type[BaseModel], path: str, *, origin: str) -> None:
    names = setting_names(schema)
    if path in names:
        return
    # A right name under the wrong stage is as likely as a misspelt one.
    last = path.rpartition(".")[2]
    same_name = [name for name in names if name.rpartition(".")[2] == last]
    nearest = dict.fromkeys([*difflib.get_close_matches(path, names, NEAREST_NAMES), *same_name])
    hint = (
        f"did you mean {', '.join(list(nearest)[:NEAREST_NAMES])}?"
        if nearest
        else f"settings belong to {', '.join(schema.model_fields)}"
    )
    raise InputError(f"{origin} {path}: no such setting; {hint}")


def _set(values: dict[str, Any], path: str, value: Any) -> None:
    *parents, name = path.split(".")
    for parent in parents:
        below = values.setdefault(parent, {})
        if not isinstance(below, dict):
            raise InputError(f"--set {path}: {parent} was set to {below!r} before")
        values = below
    values[name] = value


def _in_short(error: ValidationError, schema: type[BaseModel]) -> str:
    """A validation error in one line, with suggestions for unknown names."""
    problems = []
    for problem in error.errors(include_url=False):
        path = ".".join(str(part) for part in problem["loc"])
        if problem["type"] in ("extra_forbidden", "unexpected_keyword_argument"):
            _require_known(schema, path, origin="preset")
        message = problem["msg"][0].lower() + problem["msg"][1:]
        problems.append(f"{path}: {message}, got {problem['input']!r}")
    return "; ".join(problems)


def differences(config: Mapping[str, Any], other: Mapping[str, Any]) -> list[tuple[str, Any, Any]]:
    """Dotted names whose values differ, with both values; `...` where a side has no such name."""
    one, two = dict(_flatten(config, "")), dict(_flatten(other, ""))
    return [
        (name, one.get(name, ...), two.get(name, ...))
        for name in sorted({*one, *two})
        if one.get(name, ...) != two.get(name, ...)
    ]


def _flatten(values: Mapping[str, Any], prefix: str) -> Iterator[tuple[str, Any]]:
    for name, value in values.items():
        if isinstance(value, Mapping):
            yield from _flatten(value, f"{prefix}{name}.")
        else:
            yield prefix + name, value
