"""The prepared UNet answers as its plain twin does; each of its shortcuts against what it cuts."""

import subprocess
import sys

import pytest
import torch
from tiny_diffusion import FRAMES, some_conditioning, some_latents, tiny_unet
from torch import nn
from torch.nn import functional
from torch.utils.flop_counter import FlopCounterMode

from svim3d.diffusion.conditioning import Conditioning
from svim3d.diffusion.prepared import PreparedUNet
from svim3d.diffusion.prepared_blocks import (
    PreparedResBlock,
    PreparedTransformer,
    PreparedUpsample,
)

LEVEL = torch.tensor([0.3])


def plain(unet, told: Conditioning, noisy: torch.Tensor) -> torch.Tensor:
    level = LEVEL.expand(len(noisy))
    return unet(told.beside(noisy), level, told.token, told.camera)


def hidden_frames(clips: int, side: int, channels: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(3)
    return torch.randn(clips, FRAMES, side, side, channels, generator=generator)


def channel_first(frames: torch.Tensor) -> torch.Tensor:
    return frames.flatten(0, 1).permute(0, 3, 1, 2)


@pytest.mark.parametrize("clips", [1, 2])
@pytest.mark.parametrize("layers", [1, 2])
def test_prepared_unet_is_the_plain_one(clips, layers):
    unet = tiny_unet(layers_per_block=layers)
    told, noisy = some_conditioning(clips), some_latents(clips)
    prepared = PreparedUNet(unet)
    fast = prepared(noisy, LEVEL, prepared.bind(told))
    assert torch.allclose(fast, plain(unet, told, noisy), atol=1e-5)


def test_in_double_precision_only_rounding_is_left():
    unet = tiny_unet().double()
    told, noisy = some_conditioning(2), some_latents(2).double()
    # Sinusoids are float32 in diffusers; both see the same ones.
    prepared = PreparedUNet(unet)
    fast = prepared(noisy, LEVEL, prepared.bind(told))
    slow = unet(told.beside(noisy), LEVEL.expand(2), told.token.double(), told.camera)
    assert torch.allclose(fast, slow, atol=1e-12)


def test_both_branches_of_guidance_begin_with_the_same_latents():
    unet, told, noisy = tiny_unet(), some_conditioning(), some_latents()
    both = told.beside_unconditional()
    prepared = PreparedUNet(unet)
    fast = prepared(noisy, LEVEL, prepared.bind(both))
    assert torch.allclose(fast, plain(unet, both, torch.cat([noisy, noisy])), atol=1e-5)
    # One batch of two branches is two calls of one branch.
    nothing = told.dropped(torch.ones(1))
    alone = [prepared(noisy, LEVEL, prepared.bind(one)) for one in (nothing, told)]
    assert torch.allclose(fast, torch.cat(alone), atol=1e-5)


def test_what_is_bound_holds_at_every_level():
    unet, told, noisy = tiny_unet(), some_conditioning(), some_latents()
    prepared = PreparedUNet(unet)
    bound = prepared.bind(told)
    for level in (-1.5, 0.0, 1.6):
        slow = unet(told.beside(noisy), torch.tensor([level]), told.token, told.camera)
        fast = prepared(noisy, torch.tensor([level]), bound)
        assert torch.allclose(fast, slow, atol=1e-5)


@pytest.mark.parametrize("which", ["spatial", "temporal"])
def test_cross_attention_to_one_token_does_not_depend_on_what_asks(which):
    stock = tiny_unet().down_blocks[0].attentions[0]
    told = some_conditioning(2)
    answers = dict(
        zip(("spatial", "temporal"), PreparedTransformer(stock).bind(told.token, 3), strict=False)
    )
    blocks = {"spatial": stock.transformer_blocks, "temporal": stock.temporal_transformer_blocks}
    asking = torch.randn(2, 7, 64, generator=torch.Generator().manual_seed(0))
    attended = blocks[which][0].attn2(asking, encoder_hidden_states=told.token)
    assert torch.allclose(attended, answers[which][:, 0].expand(-1, 7, -1), atol=1e-6)


def test_prepared_residual_block_is_the_stock_one():
    unet = tiny_unet()
    stock = unet.up_blocks[0].resnets[0]
    hidden = hidden_frames(2, 4, stock.spatial_res_block.in_channels)
    embedding = torch.randn(2 * FRAMES, 256, generator=torch.Generator().manual_seed(0))
    slow = stock(channel_first(hidden), embedding, torch.zeros(2, FRAMES))
    block = PreparedResBlock(stock)
    shifts = [
        layer(functional.silu(embedding)).view(2, FRAMES, -1) for layer in block.projections()
    ]
    assert torch.allclose(channel_first(block(hidden, *shifts)), slow, atol=1e-5)


def test_prepared_transformer_is_the_stock_one():
    stock = tiny_unet().down_blocks[0].attentions[0]
    hidden, token = hidden_frames(2, 4, 64), some_conditioning(2).token
    context = token.repeat_interleave(FRAMES, 0)
    slow = stock(channel_first(hidden), context, torch.zeros(2, FRAMES)).sample
    block = PreparedTransformer(stock)
    fast = block(hidden, *block.bind(token, FRAMES))
    assert torch.allclose(channel_first(fast), slow, atol=1e-5)


def test_upsampling_by_parity_is_repetition_and_a_convolution():
    stock = nn.Conv2d(6, 10, 3, padding=1, dtype=torch.float64)
    hidden = hidden_frames(2, 5, 6)[:, :, :4].double()
    doubled = functional.interpolate(channel_first(hidden), scale_factor=2.0, mode="nearest")
    fast = PreparedUpsample(stock)(hidden)
    assert fast.shape == (2, FRAMES, 8, 10, 10)
    assert torch.allclose(channel_first(fast), stock(doubled), atol=1e-14)


def test_attention_is_the_fused_kernel():
    names = {type(m.processor).__name__ for m in tiny_unet().modules() if hasattr(m, "processor")}
    assert names == {"AttnProcessor2_0"}


def test_preparing_moves_no_weight():
    unet, told = tiny_unet(), some_conditioning()
    before = {name: weight.clone() for name, weight in unet.state_dict().items()}
    prepared = PreparedUNet(unet)
    prepared(some_latents(), LEVEL, prepared.bind(told))
    after = unet.state_dict()
    assert list(before) == list(after)
    assert all(torch.equal(before[name], after[name]) for name in before)
    assert all(after[name].is_contiguous() for name in after)


def test_it_computes_less():
    unet, told, noisy = tiny_unet(), some_conditioning(), some_latents()
    prepared = PreparedUNet(unet)
    bound = prepared.bind(told)
    with FlopCounterMode(display=False) as slow:
        plain(unet, told, noisy)
    with FlopCounterMode(display=False) as fast:
        prepared(noisy, LEVEL, bound)
    assert fast.get_total_flops() < 0.95 * slow.get_total_flops()


COMPILED = """
import functools, sys
import torch
sys.path.insert(0, "tests")
# Tracing is what can fail; turning graphs into code is torch's own affair and takes minutes.
torch.compile = functools.partial(torch.compile, backend="eager", fullgraph=True)
torch._dynamo.config.fail_on_recompile_limit_hit = True
from tiny_diffusion import some_conditioning, some_latents, tiny_unet
from svim3d.diffusion.prepared import PreparedUNet
answers, level = [], torch.tensor([0.3])
unet, noisy = tiny_unet(), some_latents()
for compiled in (False, True, True):
    prepared = PreparedUNet(unet, compiled=compiled)
    answers.append(prepared(noisy, level, prepared.bind(some_conditioning())))
    graphs = torch._dynamo.utils.counters["stats"]["unique_graphs"]
    print(graphs, float((answers[-1] - answers[0]).abs().max()))
"""


def test_blocks_compile_whole_and_a_second_orbit_finds_them_compiled():
    # In a process of its own: here every function is wrapped to check shapes.
    ran = subprocess.run(
        [sys.executable, "-c", COMPILED], capture_output=True, text=True, check=True
    )
    plain, first, again = (line.split() for line in ran.stdout.splitlines())
    assert plain == ["0", "0.0"]
    assert first == again
    assert int(first[0]) > 0
    assert float(first[1]) < 1e-5


def test_sides_that_cannot_be_halved_are_refused():
    unet, told = tiny_unet(), some_conditioning()
    prepared = PreparedUNet(unet)
    with pytest.raises(ValueError, match="multiples of 2"):
        prepared(some_latents()[..., :7], LEVEL, prepared.bind(told))
