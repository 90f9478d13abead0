import math

import pytest
import torch

from svim3d.mesh.regularizers import laplacian_loss, laplacian_loss_reference, sign_change_loss

OCTAHEDRON = torch.tensor(
    [[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], dtype=torch.float64
)
FACES = torch.tensor(
    [[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]]
)


def softplus(x: float) -> float:
    return math.log1p(math.exp(x))


def test_sign_change_of_one_edge_is_two_logistic_losses():
    sdf = torch.tensor([0.7, -0.3, 5.0], dtype=torch.float64, requires_grad=True)
    loss = sign_change_loss(sdf, torch.tensor([[0, 1]]))
    assert float(loss.detach()) == pytest.approx(softplus(0.7) + softplus(0.3))
    (gradient,) = torch.autograd.grad(loss, sdf)
    assert float(gradient[0]) > 0 > float(gradient[1])  # descent pulls both towards zero
    assert float(gradient[2]) == 0


def test_the_laplacian_of_an_octahedron_is_one():
    # The four neighbours of each vertex have their mean at the centre, one away.
    assert float(laplacian_loss(OCTAHEDRON, FACES)) == pytest.approx(1.0)
    assert float(laplacian_loss(3.0 * OCTAHEDRON, FACES)) == pytest.approx(9.0)


def test_gradients_match_finite_differences():
    noise = 0.1 * torch.randn(6, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    vertices = (OCTAHEDRON + noise).requires_grad_()
    assert torch.autograd.gradcheck(lambda v: laplacian_loss(v, FACES), (vertices,))


def test_the_torch_twin_gives_the_same_laplacian_and_gradient():
    draw = torch.Generator().manual_seed(0)
    faces = torch.randint(0, 39, (90, 3), generator=draw)  # open as well, and with an idle vertex
    vertices = torch.randn(40, 3, generator=draw)
    found = []
    for loss in (laplacian_loss, laplacian_loss_reference):
        leaf = vertices.clone().requires_grad_()
        value = 3.0 * loss(leaf, faces)
        found.append((value.detach(), torch.autograd.grad(value, leaf)[0]))
    for fast, plain in zip(*found, strict=True):
        torch.testing.assert_close(fast, plain, rtol=1e-5, atol=1e-7)
