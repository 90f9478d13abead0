"""`svim3d train` from examples to a model folder, in pieces, and what it refuses."""

import json
from dataclasses import asdict, replace
from pathlib import Path

import pytest
import torch
from tiny_model import EXPECTING, TINY

from flows.cli import main
from flows.train import LOCK
from stages.locks import file_lock
from stages.training_folder import TrainingFolder
from svim3d.io.model_folder import FORMAT, read_model
from svim3d.io.training_data import write_example
from svim3d.synthesis.example import TrainingExample

AUTOENCODER = {"patch": 4, "latent_channels": 2, "hidden": 8, "layers": 1}
SPEC = replace(TINY, autoencoder=AUTOENCODER)
SETTINGS = (
    "autoencoder.steps=4",
    "autoencoder.batch=4",
    "expectation.steps=3",
    "expectation.batch=2",
    "generator.phase_1_steps=2",
    "generator.phase_2_steps=2",
    "generator.warm_up=1",
    "generator.precision=float32",
)


@pytest.fixture
def data(tmp_path: Path) -> Path:
    folder = tmp_path / "data"
    folder.mkdir()
    for index in range(2):
        draw = torch.Generator().manual_seed(index)

        def picture(*lead: int, draw: torch.Generator = draw) -> torch.Tensor:
            shape = (*lead, SPEC.views, SPEC.image_size, SPEC.image_size, 3)
            return torch.randint(256, shape, generator=draw, dtype=torch.uint8)

        example = TrainingExample(
            rgb=picture(2),
            basecolor=picture(),
            orm=picture(),
            normal=picture(),
            mask=picture()[..., :1],
            elevation_deg=torch.full((SPEC.views,), 10.0),
            azimuth_deg=(torch.arange(1, SPEC.views + 1) * (360.0 / SPEC.views)) % 360.0,
            metadata={"quality": "good"},
        )
        write_example(folder / f"{index:06d}.safetensors", example)
    return folder


@pytest.fixture
def spec(tmp_path: Path) -> Path:
    file = tmp_path / "tiny.json"
    file.write_text(json.dumps({"format": FORMAT, **asdict(SPEC)}))
    return file


def command(data: Path, out: Path, model: Path, *more: str) -> list[str]:
    settings = [part for setting in SETTINGS for part in ("--set", setting)]
    given = ["train", str(data), "-o", str(out), "--model", str(model), "--device", "cpu"]
    return [*given, *settings, *more]


def test_it_leaves_a_model_losses_and_sheets(data, spec, tmp_path):
    out = tmp_path / "run"
    assert main(command(data, out, spec)) == 0
    model = read_model(out / "model", torch.device("cpu"))
    assert model.spec.name == "tiny"
    assert model.spec.latent_scale != SPEC.latent_scale
    assert (out / "generator" / "sheet-0000004.png").stat().st_size > 0
    assert (out / "autoencoder" / "sheet.png").stat().st_size > 0
    rows = (out / "generator" / "scalars.csv").read_text().splitlines()
    assert {row.split(",")[0] for row in rows} == {"1", "2", "3", "4"}
    assert {row.split(",")[1] for row in rows} >= {"loss", "rgb", "orm", "gradient"}


def test_pieces_leave_the_same_model(data, spec, tmp_path):
    whole, pieces = tmp_path / "whole", tmp_path / "pieces"
    assert main(command(data, whole, spec)) == 0
    for _ in range(5):
        assert main(command(data, pieces, spec, "--minutes", "0")) == 0
    for name in ("unet", "autoencoder", "image_encoder"):
        file = f"model/{name}.safetensors"
        assert (whole / file).read_bytes() == (pieces / file).read_bytes(), name


@pytest.fixture
def expecting(tmp_path: Path) -> Path:
    file = tmp_path / "expecting.json"
    spec = replace(EXPECTING, autoencoder=AUTOENCODER)
    file.write_text(json.dumps({"format": FORMAT, **asdict(spec)}))
    return file


def test_an_expectation_is_trained_before_the_generator_and_in_pieces(data, expecting, tmp_path):
    spec = expecting
    whole, pieces = tmp_path / "whole", tmp_path / "pieces"
    assert main(command(data, whole, spec)) == 0
    # A step each, 3 of the expectation (the last one goes on with the generator) and 4 more.
    for _ in range(7):
        assert main(command(data, pieces, spec, "--minutes", "0")) == 0
    one, two = (read_model(run / "model", torch.device("cpu")) for run in (whole, pieces))
    assert one.spec == two.spec
    assert one.spec.residual_scale not in (0.0, 1.0)
    for part, network in one.parts.items():
        for name, value in network.state_dict().items():
            assert torch.equal(value, two.parts[part].state_dict()[name]), (part, name)
    assert one.expectation.head.weight.any()


def test_a_run_holds_to_its_settings_but_may_be_longer(data, spec, tmp_path, capsys):
    out = tmp_path / "run"
    assert main(command(data, out, spec)) == 0
    assert main(command(data, out, spec, "--set", "generator.phase_2_steps=3")) == 0
    assert main(command(data, out, spec, "--set", "generator.batch=3")) == 2
    assert "begun with other settings (config.generator.batch)" in capsys.readouterr().err


def test_other_examples_are_not_trained_on_by_the_old_latents(data, spec, tmp_path, capsys):
    out = tmp_path / "run"
    assert main(command(data, out, spec)) == 0
    files = sorted(data.iterdir())
    files[0].write_bytes(files[1].read_bytes())
    assert main(command(data, out, spec)) == 2
    assert "begun with other settings (first_example)" in capsys.readouterr().err


def test_training_goes_on_from_a_model_folder_and_its_terms(data, spec, tmp_path):
    """With its weights, its card and its notice, but another number of steps."""
    assert main(command(data, tmp_path / "first", spec)) == 0
    source = tmp_path / "first" / "model"
    (source / "README.md").write_text("Only for research.\n")
    (source / "NOTICE").write_text("By somebody.\n")
    out = tmp_path / "second"
    assert main(command(data, out, source, "--set", "generator.rate_1=1e-9")) == 0
    assert "Only for research." in (out / "model" / "README.md").read_text()
    assert (out / "model" / "NOTICE").read_text() == "By somebody.\n"
    old, new = (read_model(f, torch.device("cpu")) for f in (source, out / "model"))
    assert torch.equal(old.autoencoder.analysis.weight, new.autoencoder.analysis.weight)
    for name, value in old.image_encoder.state_dict().items():
        assert torch.equal(value, new.image_encoder.state_dict()[name]), name


def test_the_expectation_of_a_model_folder_goes_on_if_asked(data, expecting, tmp_path):
    assert main(command(data, tmp_path / "first", expecting)) == 0
    source = tmp_path / "first" / "model"
    left, whole, pieces = tmp_path / "left", tmp_path / "whole", tmp_path / "pieces"
    assert main(command(data, left, source)) == 0
    on = ("--set", "expectation.steps_on=2", "--set", "expectation.warm_up=1")
    assert main(command(data, whole, source, *on)) == 0
    for _ in range(6):
        assert main(command(data, pieces, source, *on, "--minutes", "0")) == 0
    first, same, one, two = (
        read_model(folder, torch.device("cpu"))
        for folder in (source, left / "model", whole / "model", pieces / "model")
    )
    assert torch.equal(first.expectation.head.weight, same.expectation.head.weight)
    assert same.spec.residual_scale == first.spec.residual_scale
    assert not torch.equal(first.expectation.head.weight, one.expectation.head.weight)
    assert one.spec.residual_scale not in (first.spec.residual_scale, 0.0)
    assert one.spec == two.spec
    for name, value in one.expectation.state_dict().items():
        assert torch.equal(value, two.expectation.state_dict()[name]), name


def test_a_look_is_trained_once_and_goes_along(data, tmp_path):
    file = tmp_path / "looking.json"
    spec = replace(EXPECTING, autoencoder=AUTOENCODER, look={"hidden": 4})
    file.write_text(json.dumps({"format": FORMAT, **asdict(spec)}))
    more = ("--set", "look.steps=5", "--set", "look.batch=4")
    whole, pieces = tmp_path / "whole", tmp_path / "pieces"
    assert main(command(data, whole, file, *more)) == 0
    for _ in range(7):
        assert main(command(data, pieces, file, *more, "--minutes", "0")) == 0
    one, two = (read_model(run / "model", torch.device("cpu")) for run in (whole, pieces))
    assert one.look.centre.any()
    for name, value in one.look.state_dict().items():
        assert torch.equal(value, two.look.state_dict()[name]), name
    rows = (pieces / "look" / "scalars.csv").read_text().splitlines()
    assert [row.split(",")[0] for row in rows if "roughness" in row] == list("12345")


def test_a_kill_between_checkpoint_and_model_loses_nothing(data, spec, tmp_path, monkeypatch):
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    assert main(command(data, whole, spec)) == 0
    keep = TrainingFolder.keep_model

    def stop(self: TrainingFolder, model: object, steps: int = 0) -> None:
        if steps:
            raise KeyboardInterrupt
        keep(self, model)

    monkeypatch.setattr(TrainingFolder, "keep_model", stop)
    assert main(command(data, killed, spec)) == 130
    monkeypatch.setattr(TrainingFolder, "keep_model", keep)
    assert main(command(data, killed, spec)) == 0
    for name in ("unet", "autoencoder", "image_encoder"):
        file = f"model/{name}.safetensors"
        assert (whole / file).read_bytes() == (killed / file).read_bytes(), name


def test_two_trainings_do_not_meet_in_a_folder(data, spec, tmp_path, capsys):
    out = tmp_path / "run"
    with file_lock(out / LOCK) as is_held:
        assert is_held
        assert main(command(data, out, spec)) == 2
    assert "another process trains in" in capsys.readouterr().err
    assert not (out / "model").exists()
    assert main(command(data, out, spec)) == 0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("--set", "generator.speed=1"), "no such setting"),
        (("--config", "nowhere.yaml"), "cannot be read"),
        (("--model", "nowhere"), "wanted a model folder"),
    ],
)
def test_wrong_options_are_told_in_a_line(data, spec, tmp_path, capsys, change, message):
    assert main(command(data, tmp_path / "run", spec, *change)) == 2
    assert message in capsys.readouterr().err


def test_without_examples_it_says_how_to_make_some(spec, tmp_path, capsys):
    assert main(command(tmp_path / "none", tmp_path / "run", spec)) == 2
    assert "svim3d data render" in capsys.readouterr().err


def test_a_foreign_autoencoder_needs_a_model_folder(data, tmp_path, capsys):
    file = tmp_path / "kl.json"
    file.write_text(json.dumps({"format": FORMAT, **asdict(TINY)}))
    assert main(command(data, tmp_path / "run", file)) == 2
    assert "--model FOLDER" in capsys.readouterr().err
