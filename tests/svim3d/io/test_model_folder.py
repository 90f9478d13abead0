"""Model folders: what is written is read, whole and to the bit; what is missing is named."""

import json

import pytest
import torch
from tiny_model import TINY, tiny_model, write_tiny_model

from svim3d.io import model_folder
from svim3d.io.model_folder import bundled_model, read_model, read_spec

CPU = torch.device("cpu")
ELEVATION = torch.full((5,), 10.0)
AZIMUTH = torch.tensor([72.0, 144.0, 216.0, 288.0, 0.0])


def test_a_read_model_answers_as_the_written_one(tmp_path):
    """Weights are stored as half floats: the model rounded to them is what comes back."""
    model = tiny_model()
    read = read_model(write_tiny_model(tmp_path), CPU)
    for network in model.parts.values():
        # Convolutions whose weights ask for gradients take another path, with other last bits.
        network.requires_grad_(False)
        for parameter in network.parameters():
            parameter.data = parameter.data.half().float()
    picture = torch.rand(16, 16, 3, generator=torch.Generator().manual_seed(1))
    told, told_read = (m.condition(picture, ELEVATION, AZIMUTH) for m in (model, read))
    assert torch.equal(told.token, told_read.token)
    assert torch.equal(told.latent, told_read.latent)
    latents = model.draw(told, seed=3)
    assert torch.equal(latents, read.draw(told_read, seed=3))
    views, views_read = model.decode(latents), read.decode(latents)
    assert all(torch.equal(image, getattr(views_read, name)) for name, image in vars(views).items())


def test_nothing_stays_on_the_meta_device(tmp_path):
    read = read_model(write_tiny_model(tmp_path), CPU)
    for network in read.parts.values():
        tensors = [*network.parameters(), *network.buffers()]
        assert not [t for t in tensors if t.is_meta]


def test_a_spec_comes_back_and_mistakes_in_it_are_named(tmp_path):
    write_tiny_model(tmp_path)
    assert read_spec(tmp_path) == TINY
    file = tmp_path / "model.json"
    said = json.loads(file.read_text())
    for change, complaint in (
        ({"format": "other/1"}, "says 'other/1'"),
        ({"colour": 1}, "unknown entries: colour"),
    ):
        file.write_text(json.dumps(said | change))
        with pytest.raises(ValueError, match=complaint):
            read_spec(tmp_path)
    file.write_text("{")
    with pytest.raises(ValueError, match="is no JSON"):
        read_spec(tmp_path)
    with pytest.raises(ValueError, match="leave the model out to use the bundled one"):
        read_spec(tmp_path / "nowhere")


def test_a_copy_without_the_bundled_model_is_told(tmp_path, monkeypatch):
    monkeypatch.setattr(model_folder, "BUNDLED", "models/none")
    with pytest.raises(ValueError, match="name a model folder with --model"):
        bundled_model()
