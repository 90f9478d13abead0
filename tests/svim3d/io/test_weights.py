"""Safetensors files: written one tensor at a time, looked into without reading.

What torch.save wrote is read only where that is asked for, and only tensors are.
"""

import pickle

import pytest
import torch
from safetensors.torch import load_file, save_file

from svim3d.io.weights import (
    load_sealed,
    load_state,
    load_tensors,
    open_tensors,
    save_one_by_one,
    save_sealed,
    save_tensors,
)

TENSORS = {
    "matrix": torch.arange(6.0).reshape(2, 3),
    "number": torch.tensor(0.5),
    "nothing": torch.zeros(0, 4),
    "turned": torch.arange(6.0).reshape(3, 2).T,
}
SHAPES = {name: tuple(tensor.shape) for name, tensor in TENSORS.items()}


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16, torch.float16])
def test_what_is_written_one_by_one_the_library_reads(tmp_path, dtype):
    file = tmp_path / "a.safetensors"
    save_one_by_one(file, SHAPES, dtype, reversed(TENSORS.items()))
    found = load_file(file)
    assert set(found) == set(TENSORS)
    for name, tensor in TENSORS.items():
        assert found[name].dtype == dtype
        assert torch.equal(found[name], tensor.to(dtype))


def test_names_shapes_and_types_are_known_before_reading(tmp_path):
    file = tmp_path / "a.safetensors"
    save_file({"a": torch.ones(2, 3), "b": torch.ones(1, dtype=torch.bfloat16)}, file)
    with open_tensors(file) as tensors:
        assert tensors.shapes == {"a": (2, 3), "b": (1,)}
        assert tensors.types == {"a": "F32", "b": "BF16"}
        assert torch.equal(tensors.read("a"), torch.ones(2, 3))


@pytest.mark.parametrize(
    ("given", "complaint"),
    [
        ([("matrix", torch.zeros(3, 2))], r"matrix \(3, 2\) was not announced so"),
        ([("other", torch.zeros(1))], "other"),
        ([("number", torch.tensor(1.0))] * 2, "came twice"),
        ([("number", torch.tensor(1.0))], r"3 tensors never came: matrix, nothing, turned"),
        ([("number", torch.tensor(1e6))], "number is not finite in F16; .* choose bf16 or fp32"),
    ],
)
def test_what_was_not_announced_is_refused(tmp_path, given, complaint):
    with pytest.raises(ValueError, match=complaint):
        save_one_by_one(tmp_path / "a.safetensors", SHAPES, torch.float16, given)


class Trap:
    """Unpickling it fails the test."""

    def __reduce__(self):
        return pytest.fail, ("a pickle was opened",)


@pytest.mark.parametrize("name", ["a.ckpt", "a.pt", "a.safetensors"])
@pytest.mark.parametrize("is_zip", [True, False])
def test_pickles_are_never_opened_whatever_their_name(tmp_path, name, is_zip):
    file = tmp_path / name
    if is_zip:
        torch.save({"a": Trap()}, file)
    else:
        file.write_bytes(pickle.dumps(Trap()))
    with pytest.raises(ValueError, match=r"is pickled, .* wanted the \.safetensors file"):
        load_tensors(file)


def test_a_header_that_begins_as_a_pickle_does_is_none(tmp_path):
    file = tmp_path / "a.safetensors"
    name = next(n for n in ("a" * k for k in range(1, 300)) if header_length(file, n) % 256 == 0x80)
    save_file({name: torch.ones(1)}, file)
    assert file.read_bytes()[:1] == b"\x80"
    assert list(load_tensors(file)) == [name]


def header_length(file, name):
    save_file({name: torch.ones(1)}, file)
    return int.from_bytes(file.read_bytes()[:8], "little")


@pytest.mark.parametrize(
    "content", [b"", b"abc", b"\xff" * 64, b"<!DOCTYPE html><html></html>" * 9], ids=repr
)
def test_files_of_another_kind_are_refused(tmp_path, content):
    file = tmp_path / "a.safetensors"
    file.write_bytes(content)
    with pytest.raises(ValueError, match=r"is no complete safetensors file .* again"):
        load_tensors(file)


def test_a_file_cut_short_is_refused(tmp_path):
    file = tmp_path / "a.safetensors"
    save_file({"a": torch.ones(100)}, file)
    for length in (file.stat().st_size - 1, 40, 4):
        file.write_bytes(file.read_bytes()[:length])
        with pytest.raises(ValueError, match="is no complete safetensors file"):
            load_tensors(file)


def test_missing_files_and_folders_are_refused(tmp_path):
    for path in (tmp_path / "none.safetensors", tmp_path):
        with pytest.raises(ValueError, match="there is no file"):
            load_tensors(path)


def test_sealed_tensors_come_back_whatever_they_are(tmp_path):
    draw = torch.Generator().manual_seed(0)
    tensors = {
        "view": torch.randn(4, 3, generator=draw).T,
        "scalar": torch.tensor(7),
        "bool": torch.tensor([True, False]),
        "half": torch.ones(3, dtype=torch.bfloat16),
        "none": torch.empty(0, 2),
    }
    save_sealed(tmp_path / "x", tensors)
    read = load_sealed(tmp_path / "x")
    assert all(torch.equal(read[name], value) for name, value in tensors.items())
    assert set(read) == set(tensors)
    save_tensors(tmp_path / "old", tensors)  # from before there were seals
    assert set(load_sealed(tmp_path / "old")) == set(tensors)


def test_flipped_bit_anywhere_is_noticed_or_harmless(tmp_path):
    tensors = {"a": torch.arange(6.0).view(2, 3), "b": torch.tensor(3)}
    file = tmp_path / "x"
    save_sealed(file, tensors)
    whole = file.read_bytes()
    noticed = 0
    for place in range(len(whole)):
        spoilt = bytearray(whole)
        spoilt[place] ^= 1
        file.write_bytes(spoilt)
        try:
            read = load_sealed(file)
        except Exception:
            noticed += 1
            continue
        assert set(read) == set(tensors)
        assert all(torch.equal(read[name], value) for name, value in tensors.items())
    assert noticed > 0.8 * len(whole)  # the name of the seal, and spaces, may be anything


def test_a_state_is_read_from_either_kind_of_file(tmp_path):
    torch.save(TENSORS, tmp_path / "a.pth")
    save_tensors(tmp_path / "a.safetensors", TENSORS)
    for name in ("a.pth", "a.safetensors"):
        found = load_state(tmp_path / name)
        assert set(found) == set(TENSORS)
        assert all(torch.equal(found[key], tensor) for key, tensor in TENSORS.items())


class Harmful:
    def __reduce__(self):
        return print, ("unpickled",)


def test_a_pickle_of_anything_else_is_refused_and_never_run(tmp_path, capsys):
    file = tmp_path / "a.pth"
    torch.save({"a": Harmful()}, file)
    with pytest.raises(ValueError, match="holds no state of a network"):
        load_state(file)
    assert capsys.readouterr().out == ""
    torch.save([torch.ones(1)], file)
    with pytest.raises(ValueError, match="wanted named tensors"):
        load_state(file)
