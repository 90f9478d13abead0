import os
import threading

import pytest
import torch

from stages import prefilter_cache
from stages.prefilter_cache import cached_operator, operator_file
from svim3d.shading.prefilter import PyramidOperator
from svim3d.shading.prefilter_spec import PrefilterSpec

SIZE = 16


@pytest.fixture(autouse=True)
def forget():
    cached_operator.cache_clear()
    yield
    cached_operator.cache_clear()


def texels_and_gradient(operator: PyramidOperator) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    radiance = torch.rand(SIZE, SIZE, 3, generator=generator).requires_grad_()
    texels = operator(radiance).texels
    (gradient,) = torch.autograd.grad((texels**2).sum(), radiance)
    return texels.detach(), gradient


def refuse_to_build(*_, **__):
    raise AssertionError("the operator was computed although it is stored")


@pytest.mark.parametrize("mode", ["sampled", "exact", "hybrid"])
def test_stored_operator_is_the_computed_one_bit_for_bit(tmp_path, monkeypatch, mode):
    first = texels_and_gradient(cached_operator(tmp_path, SIZE, mode))
    cached_operator.cache_clear()
    monkeypatch.setattr(PyramidOperator, "build", refuse_to_build)
    second = texels_and_gradient(cached_operator(tmp_path, SIZE, mode))
    assert all(torch.equal(a, b) for a, b in zip(first, second, strict=True))


def test_damaged_file_is_computed_anew(tmp_path):
    spec = PrefilterSpec(SIZE)
    expected = texels_and_gradient(cached_operator(tmp_path, SIZE))
    file = operator_file(tmp_path, spec)
    whole = file.read_bytes()
    # Cut short; empty; a bit flipped among the numbers; another spec's content, a sound file.
    cached_operator(tmp_path, SIZE, "sampled")
    other = operator_file(tmp_path, PrefilterSpec(SIZE, "sampled")).read_bytes()
    flipped = whole[:-4] + bytes([whole[-4] ^ 1]) + whole[-3:]
    for content in (whole[: len(whole) // 2], b"", flipped, other):
        file.write_bytes(content)
        cached_operator.cache_clear()
        found = texels_and_gradient(cached_operator(tmp_path, SIZE))
        assert all(torch.equal(a, b) for a, b in zip(found, expected, strict=True))
        assert file.read_bytes() == whole


def test_folder_that_cannot_be_written_costs_only_time(tmp_path):
    # A file where the folder should be: refused even to a user who may write everywhere.
    blocked = tmp_path / "shared"
    blocked.write_text("")
    found = texels_and_gradient(cached_operator(blocked, SIZE))
    expected = texels_and_gradient(PyramidOperator.build(SIZE))
    assert all(torch.equal(a, b) for a, b in zip(found, expected, strict=True))


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write into a read-only folder")
def test_read_only_folder_costs_only_time(tmp_path):
    tmp_path.chmod(0o500)
    cached_operator(tmp_path, SIZE)
    assert not list(tmp_path.iterdir())


def test_interrupted_write_leaves_nothing(tmp_path, monkeypatch):
    def fail(file, tensors):
        file.write_bytes(b"half")
        raise OSError("no space left on device")

    monkeypatch.setattr(prefilter_cache, "save_sealed", fail)
    cached_operator(tmp_path, SIZE)
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]


def test_concurrent_builders_leave_one_whole_file(tmp_path, monkeypatch):
    # The computing itself is left out: numba's thread pool may belong to one thread at a time.
    computed = PyramidOperator.build(SIZE)
    monkeypatch.setattr(PyramidOperator, "build", lambda *_: computed)
    operators = []

    def build():
        operators.append(cached_operator.__wrapped__(tmp_path, SIZE))

    threads = [threading.Thread(target=build) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(operators) == 4
    files = [path for path in tmp_path.rglob("*") if path.is_file()]
    assert files == [operator_file(tmp_path, PrefilterSpec(SIZE))]
    results = [texels_and_gradient(operator) for operator in operators]
    assert all(torch.equal(r[0], results[0][0]) for r in results)


def test_file_name_tells_specs_code_and_libraries_apart(tmp_path, monkeypatch):
    names = {
        operator_file(tmp_path, PrefilterSpec(size, mode, profile))
        for size in (8, 16)
        for mode in ("sampled", "exact", "hybrid")
        for profile in ("optimisation", "relighting")
    }
    assert len(names) == 12
    spec = PrefilterSpec(SIZE)
    before = operator_file(tmp_path, spec)
    with monkeypatch.context() as patch:
        patch.setattr(prefilter_cache, "code_digests", lambda _: {"svim3d.shading.x": "0"})
        assert operator_file(tmp_path, spec) != before
    monkeypatch.setattr(prefilter_cache, "library_versions", lambda: {"numba": "0"})
    assert operator_file(tmp_path, spec) != before
