"""LPIPS against the published implementations, on weights that a formula gives."""

import pytest
import torch
from lpips_weights import blank_state, formula_weights

from svim3d.losses.lpips import Lpips

# What the packages give for `pictures()` on `formula_weights` of their own state: lpips 0.1.4
# (LPIPS(net=..., pnet_rand=True)) and stlpips-pytorch 0.0.2 (LPIPS(net="alex",
# variant="shift_tolerant")), mean over the pictures, inputs 2 x - 1.
ALEX, VGG, SHIFT_TOLERANT = 1.9873478, 1.2416356, 0.7000663


def network(net, kind=None):
    return Lpips.of(formula_weights(blank_state(net, kind or net)))


def pictures(size=64):
    """Two pairs of pictures of waves, in [0, 1]."""
    wave = torch.arange(2 * 2 * size * size * 3).double().view(2, 2, size, size, 3)
    first, second = (0.5 + 0.5 * torch.sin(0.013 * wave.square().sqrt() * 1.7)).float()
    return first, 0.5 * first + 0.5 * second


@pytest.mark.parametrize(
    ("net", "kind", "expected"),
    [("alex", "alex", ALEX), ("vgg", "vgg", VGG), ("alex", "shift tolerant", SHIFT_TOLERANT)],
)
def test_it_gives_what_the_published_code_gives(net, kind, expected):
    found = network(net, kind)
    assert found.is_shift_tolerant == (kind == "shift tolerant")
    assert float(found(*pictures())) == pytest.approx(expected, rel=1e-4)


def test_alike_pictures_have_no_distance_and_no_gradient():
    """Black ones through a network without biases: all features are off."""
    state = formula_weights(blank_state("alex", "alex"))
    state = {name: v * 0.0 if name.endswith("bias") else v for name, v in state.items()}
    state["net.slice1.0.weight"] = -state["net.slice1.0.weight"].abs()
    black = torch.full((1, 32, 32, 3), 0.5).requires_grad_()
    distance = Lpips.of(state)(black, black.detach())
    distance.backward()
    assert float(distance.detach()) == 0.0
    assert torch.equal(black.grad, torch.zeros_like(black))


def test_a_descent_step_brings_pictures_closer():
    near, far = pictures(32)
    near.requires_grad_()
    distance = network("alex")(near, far)
    distance.backward()
    with torch.no_grad():
        after = network("alex")(near - 0.2 * near.grad / near.grad.norm(), far)
    assert float(after) < float(distance.detach())


def test_what_is_no_such_state_is_refused():
    state = formula_weights(blank_state("alex", "alex"))
    backbone_only = {name: v for name, v in state.items() if not name.startswith("lin")}
    with pytest.raises(ValueError, match=r"without lin0\.model\.1\.weight"):
        Lpips.of(backbone_only)
    with pytest.raises(ValueError, match="the backbone belongs into the file too"):
        Lpips.of({name: v for name, v in state.items() if name.startswith("lin")})
    wide = state | {"net.slice1.0.weight": torch.zeros(96, 3, 11, 11)}
    with pytest.raises(ValueError, match=r"a network of form \(\(96, 3, 11, 11\), 5\)"):
        Lpips.of(wide)


def test_small_pictures_are_refused_with_advice():
    with pytest.raises(ValueError, match=r"at least 32 x 32 pixels, got \(31, 40\)"):
        network("alex")(torch.zeros(1, 31, 40, 3), torch.zeros(1, 31, 40, 3))
