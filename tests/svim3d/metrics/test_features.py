import numpy as np
import pytest
import torch
from scipy import linalg
from scipy.spatial.distance import cdist

from svim3d.metrics.features import clip_similarity, cmmd, frechet_distance


def draw(count: int, width: int, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    mixing = torch.randn(width, width, generator=generator)
    return torch.randn(count, width, generator=generator) @ mixing


@pytest.mark.parametrize("counts", [(60, 80), (7, 90), (5, 6)])
def test_frechet_distance_is_the_matrix_root_one(counts):
    # With fewer pictures than features, the root of the singular product still has its trace.
    a, b = draw(counts[0], 12), draw(counts[1], 12, seed=1) + 0.3
    cov_a, cov_b = np.cov(a.numpy(), rowvar=False), np.cov(b.numpy(), rowvar=False)
    eigenvalues = linalg.eigvals(cov_a @ cov_b)
    apart = np.square(a.numpy().mean(0) - b.numpy().mean(0)).sum()
    root = np.sqrt(np.maximum(eigenvalues.real, 0.0)).sum()
    expected = apart + np.trace(cov_a) + np.trace(cov_b) - 2 * root
    assert frechet_distance(a, b) == pytest.approx(expected, rel=1e-5)
    if min(counts) > 12:
        root = np.trace(linalg.sqrtm(cov_a @ cov_b)).real
        expected = apart + np.trace(cov_a) + np.trace(cov_b) - 2 * root
        assert frechet_distance(a, b) == pytest.approx(expected, rel=1e-5)


def test_frechet_distance_on_a_line_is_the_closed_form():
    a = torch.tensor([[0.0], [2.0]])  # mean 1, variance 2
    b = torch.tensor([[1.0], [9.0]])  # mean 5, variance 32
    expected = 4.0**2 + (32**0.5 - 2**0.5) ** 2
    assert frechet_distance(a, b) == pytest.approx(expected, rel=1e-12)


def test_equal_sets_are_at_no_distance():
    a = draw(20, 8)
    assert frechet_distance(a, a.flip(0)) == pytest.approx(0.0, abs=1e-9)
    assert cmmd(a, a.flip(0)) == pytest.approx(0.0, abs=1e-9)
    assert clip_similarity(a, 3.0 * a) == pytest.approx(100.0)


def test_one_picture_has_no_spread():
    with pytest.raises(ValueError, match="at least 2 pictures"):
        frechet_distance(draw(1, 4), draw(5, 4))


def test_cmmd_is_the_kernel_written_out():
    a, b = draw(30, 6).double(), draw(40, 6, seed=1).double()
    x, y = (t.numpy() / np.linalg.norm(t.numpy(), axis=1, keepdims=True) for t in (a, b))

    def kernel(p, q):
        return np.exp(-cdist(p, q, "sqeuclidean") / (2 * 10.0**2)).mean()

    expected = 1000 * (kernel(x, x) + kernel(y, y) - 2 * kernel(x, y))
    assert cmmd(a, b) == pytest.approx(expected, rel=1e-9)


def test_cmmd_of_opposite_points_is_the_closed_form():
    a = torch.tensor([[2.0, 0.0]])
    assert cmmd(a, -a) == pytest.approx(1000 * 2 * (1 - np.exp(-4 / 200)), rel=1e-12)


def test_cmmd_of_many_rows_does_not_depend_on_the_blocks(monkeypatch):
    a, b = draw(30, 6), draw(40, 6, seed=1)
    whole = cmmd(a, b)
    monkeypatch.setattr("svim3d.metrics.features.CMMD_ROWS", 7)
    assert cmmd(a, b) == pytest.approx(whole, rel=1e-9)


def test_similarity_is_of_pairs():
    a = torch.tensor([[1.0, 0.0], [0.0, 2.0]])
    b = torch.tensor([[1.0, 1.0], [0.0, -1.0]])
    assert clip_similarity(a, b) == pytest.approx(100 * (0.5**0.5 - 1) / 2)
