"""Training examples as files."""

import pytest
import torch

from svim3d.io.training_data import example_file, is_whole, read_example, write_example
from svim3d.io.weights import load_metadata, load_tensors, save_tensors
from svim3d.synthesis.example import TrainingExample


def example():
    def filled(*shape):
        count = torch.tensor(shape).prod()
        return (torch.arange(int(count)) % 251).to(torch.uint8).view(*shape)

    return TrainingExample(
        rgb=filled(2, 3, 4, 4, 3),
        basecolor=filled(3, 4, 4, 3),
        orm=filled(3, 4, 4, 3),
        normal=filled(3, 4, 4, 3),
        mask=filled(3, 4, 4, 1),
        elevation_deg=torch.tensor([1.0, 2.0, 3.0]),
        azimuth_deg=torch.tensor([120.0, 240.0, 0.0]),
        metadata={"seed": "0:1", "name": "caf\u00e9", "quality": "good"},
    )


def test_examples_come_back_as_they_were(tmp_path):
    file = example_file(tmp_path, 7)
    assert file.name == "000007.safetensors"
    write_example(file, example())
    read = read_example(file)
    assert read.metadata == example().metadata
    for name, tensor in example().tensors().items():
        assert torch.equal(read.tensors()[name], tensor)
    assert [f.name for f in tmp_path.iterdir()] == [file.name]


def test_the_same_example_gives_the_same_bytes(tmp_path):
    # The library shuffles metadata: one of several writes would differ.
    for index in range(8):
        write_example(example_file(tmp_path, index), example())
    assert len({file.read_bytes() for file in tmp_path.iterdir()}) == 1


def test_half_a_file_is_not_whole(tmp_path):
    file = example_file(tmp_path, 0)
    assert not is_whole(file)
    write_example(file, example())
    assert is_whole(file)
    content = file.read_bytes()
    for length in (len(content) - 1, len(content) // 2, 4, 0):
        file.write_bytes(content[:length])
        assert not is_whole(file)


def test_other_tensors_are_refused(tmp_path):
    save_tensors(tmp_path / "x.safetensors", {"weight": torch.zeros(3)})
    with pytest.raises(ValueError, match="wanted a training example"):
        read_example(tmp_path / "x.safetensors")


def test_metadata_and_tensors_pass_through_the_door(tmp_path):
    tensors = {"b": torch.arange(5.0), "a": torch.zeros(2, 3, dtype=torch.int8)}
    save_tensors(tmp_path / "x", tensors, {"z": "1", "a": '{"quoted": "text"}'})
    assert load_metadata(tmp_path / "x") == {"z": "1", "a": '{"quoted": "text"}'}
    read = load_tensors(tmp_path / "x")
    assert all(torch.equal(read[name], tensors[name]) for name in tensors)
    save_tensors(tmp_path / "y", tensors)
    assert load_metadata(tmp_path / "y") == {}
