"""Inflation: a network given one latent in all groups answers in each as the one it came from."""

import pytest
import torch
from torch.nn import functional

from svim3d.diffusion.checkpoint import fill
from svim3d.diffusion.inflation import Inflation, inflate_input, inflate_output
from svim3d.diffusion.model import PAPER
from svim3d.diffusion.unet import MaterialVideoUNet

LATENT, GROUPS = 4, 4
SMALL = {
    **PAPER.unet,
    "in_channels": 2 * LATENT,
    "out_channels": LATENT,
    "block_out_channels": [32, 64],
    "num_attention_heads": [1, 2],
    "layers_per_block": 1,
    "cross_attention_dim": 16,
    "addition_time_embed_dim": 8,
    "attention": [True, False],
}
WIDE = {**SMALL, "in_channels": 20, "out_channels": 16}


def drawn(*shape, seed=0):
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@pytest.mark.parametrize("groups", [1, 2, 4])
def test_equal_groups_give_what_one_gave(groups):
    weight, noisy, reference = (
        drawn(6, 8, 3, 3),
        drawn(2, 4, 5, 5, seed=1),
        drawn(2, 4, 5, 5, seed=2),
    )
    wide = inflate_input(weight, LATENT, groups, "mean")
    assert wide.shape == (6, 4 * groups + 4, 3, 3)
    one = functional.conv2d(torch.cat([noisy, reference], 1), weight)
    many = functional.conv2d(torch.cat([*[noisy] * groups, reference], 1), wide)
    torch.testing.assert_close(many, one, rtol=0.0, atol=1e-13)


def test_groups_share_the_answer_by_their_mean():
    weight, groups = drawn(6, 8, 3, 3), drawn(3, 2, 4, 5, 5, seed=1)
    reference = drawn(2, 4, 5, 5, seed=2)
    wide = inflate_input(weight, LATENT, 3, "mean")
    many = functional.conv2d(torch.cat([*groups, reference], 1), wide)
    of_mean = functional.conv2d(torch.cat([groups.mean(0), reference], 1), weight)
    torch.testing.assert_close(many, of_mean, rtol=0.0, atol=1e-13)


def test_plain_copies_add_up_and_leave_the_reference_alone():
    weight = drawn(6, 8, 3, 3)
    wide = inflate_input(weight, LATENT, GROUPS, "copy")
    for group in wide[:, :16].split(LATENT, 1):
        assert torch.equal(group, weight[:, :4])
    for copies in ("copy", "mean"):
        wide = inflate_input(weight, LATENT, GROUPS, copies)
        assert torch.equal(wide[:, 16:], weight[:, 4:])


def test_outputs_are_copies_in_the_order_of_groups():
    weight, bias = drawn(4, 6, 3, 3), drawn(4)
    assert torch.equal(inflate_output(weight, GROUPS)[4:8], weight)
    assert torch.equal(inflate_output(bias, GROUPS), torch.cat([bias] * GROUPS))


def test_only_one_group_can_be_inflated():
    with pytest.raises(ValueError, match=r"wanted 8 input channels, .* got 20"):
        inflate_input(drawn(6, 20, 3, 3), LATENT, GROUPS, "mean")


def test_the_paper_s_network_has_its_size():
    inflation = Inflation(LATENT, GROUPS, "mean")
    with torch.device("meta"):
        one = MaterialVideoUNet(**{**PAPER.unet, "in_channels": 8, "out_channels": 4})
        wide = MaterialVideoUNet(**PAPER.unet)
    inflated = {n: inflation.carry_out(n, t) for n, t in one.state_dict().items()}
    assert sum(t.numel() for t in one.state_dict().values()) == 1_525_278_442
    assert sum(t.numel() for t in inflated.values()) == 1_525_347_574
    fill(wide, inflated, "unet")  # meta tensors, but all of the right name and shape


@torch.no_grad()
def test_a_whole_network_answers_in_each_group_as_before():
    torch.manual_seed(0)
    one = MaterialVideoUNet(**SMALL).double().eval()
    with torch.device("meta"):
        wide = MaterialVideoUNet(**WIDE)
    inflation = Inflation(LATENT, GROUPS, "mean")
    fill(wide, {n: inflation.carry_out(n, t) for n, t in one.state_dict().items()}, "unet")
    wide.eval()
    noisy, reference = drawn(1, 3, 4, 4, 4, seed=1), drawn(1, 3, 4, 4, 4, seed=2)
    told = {
        "noise_level": torch.tensor([0.3]),
        "token": drawn(1, 1, 16, seed=3),
        "camera": torch.rand(1, 3, 3, generator=torch.Generator().manual_seed(4)),
    }
    before = one(torch.cat([noisy, reference], 2), **told)
    after = wide(torch.cat([*[noisy] * GROUPS, reference], 2), **told)
    assert before.std() > 0.1
    for group in after.split(LATENT, 2):
        torch.testing.assert_close(group, before, rtol=0.0, atol=1e-10)


def test_untouched_tensors_are_the_very_same():
    tensor = drawn(3)
    assert Inflation(LATENT, GROUPS, "copy").carry_out("conv_in.bias", tensor) is tensor
