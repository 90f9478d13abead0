"""Training the look: what follows from colour is learnt, poor materials teach nothing."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from tiny_model import TINY, tiny_model

from stages.base import Context
from stages.errors import InputError
from stages.look_training import train_look
from stages.settings.training import LookTrainingConfig
from svim3d.diffusion.model import MaterialDiffusion
from svim3d.io.training_data import write_example
from svim3d.synthesis.example import TrainingExample

CPU = torch.device("cpu")
SPEC = replace(TINY, look={"hidden": 16})


def example(red: float, quality: str = "good") -> TrainingExample:
    """A flat object whose roughness is its red, and that is metal where it is blue."""
    views, side = SPEC.views, SPEC.image_size
    mask = torch.zeros(views, side, side, 1, dtype=torch.uint8)
    mask[:, 4:12, 4:12] = 255
    inside = mask > 0

    def flat(color: list[float], background: int) -> torch.Tensor:
        values = (torch.tensor(color) * 255.0).round().to(torch.uint8)
        return torch.where(inside, values, torch.tensor(background, dtype=torch.uint8))

    blue = 1.0 - red
    picture = flat([red, 0.3, blue], 255)
    return TrainingExample(
        rgb=picture[None],
        basecolor=picture.clone(),
        orm=flat([0.0, red, float(blue > 0.5)], 0),
        normal=flat([0.5, 0.5, 1.0], 0),
        mask=mask,
        elevation_deg=torch.full((views,), 10.0),
        azimuth_deg=torch.arange(views) * 72.0,
        metadata={"quality": quality},
    )


def run(folder: Path, examples: list[TrainingExample]) -> MaterialDiffusion:
    folder.mkdir(parents=True, exist_ok=True)
    files = [folder / f"{i}.safetensors" for i in range(len(examples))]
    for file, one in zip(files, examples, strict=True):
        write_example(file, one)
    model = tiny_model(SPEC)
    config = LookTrainingConfig(steps=400, batch=32, rate=1e-2, noise=0.05)
    with Context("training look", CPU, 0, folder / "work", folder / "shared") as ctx:
        train_look(model, files, config, ctx)
    return model


def told(model: MaterialDiffusion, red: float) -> list[float]:
    picture = example(red).rgb[0, :1].permute(0, 3, 1, 2) / 127.5 - 1.0
    return model.look(picture)[0].tolist()


def test_it_learns_what_follows_from_colour(tmp_path):
    model = run(tmp_path, [example(i / 40.0) for i in range(41)])
    for red in (0.22, 0.83):
        roughness, metallic = told(model, red)
        assert roughness == pytest.approx(red, abs=0.05)
        assert metallic == pytest.approx(float(red < 0.5), abs=0.15)
    assert not any(p.requires_grad for p in model.look.parameters())


def test_poor_materials_teach_nothing(tmp_path):
    good = [example(i / 10.0) for i in range(11)]
    poor = [replace(one, orm=255 - one.orm, metadata={"quality": "low"}) for one in good]
    one, two = run(tmp_path / "one", good), run(tmp_path / "two", [*good, *poor])
    for name, value in one.look.state_dict().items():
        assert torch.equal(value, two.look.state_dict()[name]), name
    with pytest.raises(InputError, match="wanted examples of good materials"):
        run(tmp_path / "three", poor)
