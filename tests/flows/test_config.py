"""Settings: presets and overrides merge in order, and every mistake is named with its cure."""

from dataclasses import dataclass

import pytest

from flows import config as config_module
from flows.config import (
    PRESETS,
    PipelineConfig,
    RunConfig,
    differences,
    load_config,
    preset_about,
    preset_values,
    resolved_preset,
    setting_names,
)
from flows.pipeline import IMAGE_TO_ASSET
from stages.errors import InputError
from stages.settings.base import StageConfig
from stages.settings.generation import GenerationConfig


@dataclass(frozen=True)
class GridSpec:
    levels: int = 8


class FitConfig(StageConfig):
    steps: int = 300
    rate: float = 0.01
    grid: GridSpec = GridSpec()


class Settings(RunConfig):
    fit: FitConfig = FitConfig()
    refine: FitConfig = FitConfig(steps=10)


def load(*overrides: str, skip: tuple[str, ...] = ()) -> Settings:
    return load_config(Settings, "standard", overrides, skip)


@pytest.mark.parametrize("preset", PRESETS)
def test_presets_load_and_leave_out_only_what_can_be(preset):
    config = load_config(PipelineConfig, preset)
    assert config.skip <= set(IMAGE_TO_ASSET.skippable)


def test_standard_is_the_defaults():
    assert preset_values("standard") == {}
    assert load_config(PipelineConfig, "standard") == PipelineConfig()


def test_every_stage_has_settings_of_its_name():
    assert set(IMAGE_TO_ASSET.names) == set(PipelineConfig.model_fields) - {"skip"}
    assert isinstance(PipelineConfig().generation, GenerationConfig)


def test_overrides_reach_nested_values_as_yaml():
    config = load("fit.steps=5", "fit.rate=1e-3", "fit.grid.levels=4")
    assert (config.fit.steps, config.fit.rate, config.fit.grid.levels) == (5, 0.001, 4)
    assert config.refine == Settings().refine


def test_preset_gives_way_to_overrides(monkeypatch):
    preset = {"about": "a test", "fit": {"steps": 7, "rate": 0.5}, "skip": ["refine"]}
    monkeypatch.setattr(config_module, "_read_preset", lambda _: {**preset})
    config = load_config(Settings, "preview", ["fit.steps=9"], ["fit"])
    assert (config.fit.steps, config.fit.rate) == (9, 0.5)
    assert config.skip == {"fit", "refine"}


@pytest.mark.parametrize(
    ("override", "complaint"),
    [
        ("fit.stpes=5", r"--set fit\.stpes: no such setting; did you mean fit\.steps"),
        ("steps=5", r"did you mean .*fit\.steps, refine\.steps"),
        ("fit.grid.level=5", r"did you mean fit\.grid\.levels"),
        ("qqqq=5", "settings belong to skip, fit, refine"),
        ("fit.steps=many", r"fit\.steps: input should be a valid integer.*got 'many'"),
        ("fit=3", "fit: input should be a valid dictionary.*got 3"),
        ("fit.steps", "write it as stage.name=value"),
        ("fit.steps=[1", "is no YAML"),
        ("skip=refine", r"--set skip=refine: wanted a list of stages, like skip=\[dmtet\]"),
        ("skip=3", "wanted a list of stages"),
    ],
)
def test_wrong_overrides_are_named_with_their_cure(override, complaint):
    with pytest.raises(InputError, match=complaint) as caught:
        load(override)
    assert "\n" not in str(caught.value)


def test_what_a_preset_leaves_out_can_be_brought_back(monkeypatch):
    monkeypatch.setattr(config_module, "_read_preset", lambda _: {"skip": ["refine"]})
    assert load("skip=[]").skip == frozenset()
    assert load("skip=[]", skip=("fit",)).skip == {"fit"}


def test_wrong_preset_key_is_named_with_the_nearest(monkeypatch):
    monkeypatch.setattr(config_module, "_read_preset", lambda _: {"fit": {"stepps": 3}})
    with pytest.raises(InputError, match=r"preset fit\.stepps.*did you mean fit\.steps"):
        load()


def test_unknown_preset_lists_the_presets():
    with pytest.raises(InputError, match="'fast' is unknown; choose one of preview, standard"):
        load_config(Settings, "fast")


def test_setting_names_are_dotted():
    assert {"skip", "fit", "fit.steps", "refine.grid.levels"} <= set(setting_names(Settings))


def test_differences_name_values_of_both_sides():
    one, two = {"a": {"b": 1, "c": 2}, "d": 3}, {"a": {"b": 9, "c": 2}, "e": 4}
    assert differences(one, two) == [("a.b", 1, 9), ("d", 3, ...), ("e", ..., 4)]


def test_what_is_left_out_is_written_in_order():
    # Five names, of which a set would be in order by chance once in 120 processes.
    names = ["uv_bake", "env_preopt", "preview", "dmtet", "capacity"]
    page = load_config(PipelineConfig, "standard", skip=names).model_dump(mode="json")
    assert page["skip"] == sorted(names)


def test_a_file_of_ones_own_is_a_preset(tmp_path):
    file = tmp_path / "mine.yaml"
    file.write_text("about: mine\nskip: [dmtet]\nnerf: {steps: 7}\n")
    config = load_config(PipelineConfig, str(file), ["nerf.hidden=8"])
    assert (config.nerf.steps, config.nerf.hidden, config.skip) == (7, 8, frozenset({"dmtet"}))
    assert preset_about(str(file)) == "mine"
    assert resolved_preset(str(file)) == str(file) and resolved_preset("paper") == "paper"
    empty = tmp_path / "empty.yml"
    empty.write_text("")
    assert load_config(PipelineConfig, str(empty)) == PipelineConfig()


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (None, "cannot be read"),
        ("nerf: {", "is no YAML"),
        ("- nerf", "wanted settings by stage"),
        ("nerf: {stops: 7}", "nerf.stops: no such setting; did you mean nerf.steps"),
    ],
)
def test_a_preset_file_that_is_none_is_refused(tmp_path, text, said):
    file = tmp_path / "mine.yaml"
    if text is not None:
        file.write_text(text)
    with pytest.raises(InputError, match=said):
        load_config(PipelineConfig, str(file))
