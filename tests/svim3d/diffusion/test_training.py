"""The objective against its definition, and what it must not see."""

import math
from dataclasses import replace

import pytest
import torch

from svim3d.diffusion.conditioning import Conditioning
from svim3d.diffusion.groups import GROUPS
from svim3d.diffusion.karras import c_in, c_noise, denoised, over_batch
from svim3d.diffusion.training import (
    Clips,
    Draws,
    MovingAverage,
    material_difference,
    picture_loss,
    separate_frames,
    velocity_errors,
    weighted_loss,
)
from svim3d.diffusion.unet import MaterialVideoUNet

LATENT, SIDE, VIEWS, TOKEN = 2, 4, 5, 16


@pytest.fixture(scope="module")
def unet() -> MaterialVideoUNet:
    torch.manual_seed(0)
    return MaterialVideoUNet(
        in_channels=5 * LATENT,
        out_channels=4 * LATENT,
        block_out_channels=[32, 32],
        num_attention_heads=[2, 2],
        layers_per_block=1,
        cross_attention_dim=TOKEN,
        addition_time_embed_dim=8,
        attention=[True, True],
    )


def clips_of(count: int, seed: int = 0) -> Clips:
    draw = torch.Generator().manual_seed(seed)
    return Clips(
        latents=torch.randn(count, VIEWS, 4 * LATENT, SIDE, SIDE, generator=draw),
        conditioning=Conditioning(
            token=torch.randn(count, 1, TOKEN, generator=draw),
            latent=torch.randn(count, LATENT, SIDE, SIDE, generator=draw),
            camera=torch.rand(count, VIEWS, 3, generator=draw),
        ),
        has_good_materials=torch.ones(count, dtype=torch.bool),
    )


def draws_of(clips: Clips, seed: int = 1, drop_share: float = 0.5) -> Draws:
    generator = torch.Generator().manual_seed(seed)
    shape = clips.latents.shape
    return Draws.of(shape, generator, mean=1.0, spread=1.6, drop_share=drop_share)


def test_loss_is_the_weighted_denoising_error(unet):
    """lambda |D - z0|^2 with lambda = (1 + sigma^2) / sigma^2 equals |F - v|^2."""
    clips, unet = clips_of(2), unet.double()
    told = clips.conditioning
    clips = Clips(
        clips.latents.double(),
        Conditioning(told.token.double(), told.latent.double(), told.camera.double()),
        clips.has_good_materials,
    )
    draws = draws_of(clips, drop_share=0.0)
    draws = Draws(draws.sigma.double(), draws.noise.double(), draws.drop.double())
    with torch.no_grad():
        errors = velocity_errors(unet, clips, draws).double()
        level = over_batch(draws.sigma, clips.latents)
        noisy = clips.latents + level * draws.noise
        told = clips.conditioning
        answer = unet(told.beside(noisy * c_in(level)), c_noise(draws.sigma), *_rest(told))
        clean = denoised(noisy, answer, draws.sigma)
    unet.float()
    weight = (1.0 + draws.sigma**2) / draws.sigma**2
    squares = ((clean - clips.latents) ** 2).unflatten(2, (len(GROUPS), -1)).mean((1, 3, 4, 5))
    # The errors pass through float32 on their way.
    torch.testing.assert_close(errors, weight[:, None] * squares, rtol=2e-5, atol=1e-6)


def _rest(told: Conditioning) -> tuple[torch.Tensor, torch.Tensor]:
    return told.token, told.camera


def test_one_noise_level_for_all_frames_and_groups():
    draws = draws_of(clips_of(3))
    assert draws.sigma.shape == (3,)
    assert draws.noise.shape == (3, VIEWS, 4 * LATENT, SIDE, SIDE)


def test_noise_levels_are_lognormal():
    generator = torch.Generator().manual_seed(0)
    shape = torch.Size([20_000, 1, 1, 1, 1])
    draws = Draws.of(shape, generator, mean=1.0, spread=1.6, drop_share=0.1)
    logs = draws.sigma.log()
    # Four standard errors of a mean and of a standard deviation over 20,000 draws.
    assert float(logs.mean()) == pytest.approx(1.0, abs=4 * 1.6 / math.sqrt(20_000))
    assert float(logs.std()) == pytest.approx(1.6, abs=4 * 1.6 / math.sqrt(40_000))
    assert float(draws.drop.mean()) == pytest.approx(0.1, abs=4 * 0.3 / math.sqrt(20_000))


def test_poor_materials_teach_colour_and_normals_alone():
    errors = torch.tensor([[1.0, 20.0, 300.0, 4000.0], [5.0, 6.0, 7.0, 8.0]], requires_grad=True)
    loss = weighted_loss(errors, torch.tensor([False, True]))
    assert float(loss.detach()) == pytest.approx(
        ((1.0 + 4000.0) / 2 + (5.0 + 6.0 + 7.0 + 8.0) / 4) / 2
    )
    loss.backward()
    assert errors.grad is not None
    assert errors.grad[0].tolist() == [0.25, 0.0, 0.0, 0.25]


def test_dropped_clips_see_their_cameras_alone(unet):
    clips, nothing = clips_of(1), torch.ones(1)
    told = clips.conditioning
    other = Conditioning(told.token + 1.0, told.latent - 1.0, told.camera)
    turned = Conditioning(told.token, told.latent, told.camera.flip(1))
    draws = draws_of(clips, drop_share=1.0)
    with torch.no_grad():
        one, two, three = (
            velocity_errors(unet, replace(clips, conditioning=c.dropped(nothing)), draws)
            for c in (told, other, turned)
        )
    assert torch.equal(one, two)
    assert not torch.equal(one, three)


def test_separated_frames_do_not_meet_in_attention(unet):
    """Temporal transformers become identities plus the frame's index."""
    separate_frames(unet)
    block = unet.mid_block.attentions[0].temporal_transformer_blocks[0]
    hidden = torch.randn(VIEWS, SIDE, 32)
    context = torch.randn(SIDE, 1, TOKEN)
    with torch.no_grad():
        torch.testing.assert_close(block(hidden, VIEWS, context), hidden)


def test_temporal_attention_is_what_the_first_phase_leaves_alone(unet):
    frozen = {id(p) for p in unet.temporal_attention()}
    names = [n for n, p in unet.named_parameters() if id(p) in frozen]
    assert names
    assert all("temporal_transformer_blocks" in n or "time_pos_embed" in n for n in names)
    free = [n for n, p in unet.named_parameters() if id(p) not in frozen]
    assert any("temporal_res_block" in n for n in free)
    assert any("time_mixer" in n for n in free)


def test_full_size_phase_1_trains_what_the_paper_trains():
    from svim3d.diffusion.model import PAPER

    with torch.device("meta"):
        unet = MaterialVideoUNet(**PAPER.unet)
    everything = sum(p.numel() for p in unet.parameters())
    frozen = sum(p.numel() for p in unet.temporal_attention())
    assert (everything, everything - frozen) == (1_525_347_574, 1_028_541_494)


def test_moving_average_follows_its_recurrence():
    weight = torch.nn.Parameter(torch.tensor([0.0]))
    average = MovingAverage([("w", weight)], decay=0.9)
    expected = 0.0
    for step in range(200):
        with torch.no_grad():
            weight.fill_(float(step % 7))
        average.update({"w": weight}, step)
        decay = min(0.9, (1 + step) / (10 + step))
        expected = decay * expected + (1 - decay) * (step % 7)
    assert float(average.values["w"]) == pytest.approx(expected, rel=1e-5)


def test_picture_terms_in_closed_form():
    pictures = torch.zeros(1, 3, 4, 4)
    answer = torch.zeros(1, 3, 4, 4)
    answer[..., 2:] = 0.5  # a step between two columns
    terms = picture_loss(answer, pictures, edge_weight=2.0)
    assert float(terms["color"]) == pytest.approx(0.5 * 0.5 + 0.5 * 0.25)
    assert float(terms["edges"]) == pytest.approx(2.0 * 0.5 / 3.0)


def decoded(roughness, metallic, share=1.0, length=1.0):
    """Pictures of an object on the left half, in [-1, 1]."""
    orm, normal = torch.zeros(2, 3, 8, 8), torch.zeros(2, 3, 8, 8)
    orm[:, 1, :, :4], orm[:, 2, :, :4] = share * roughness, share * metallic
    facing = torch.tensor([0.0, 0.0, length])
    normal[..., :4] = share * ((facing + 1.0) / 2.0)[None, :, None, None]
    return {"orm": 2.0 * orm - 1.0, "normal": 2.0 * normal - 1.0}


def test_materials_are_compared_where_the_object_is():
    truth = decoded(0.4, 1.0)
    close = {"atol": 1e-5, "rtol": 0.0}
    same = material_difference(truth, truth, 1.0)
    torch.testing.assert_close(same, torch.zeros(2), **close)
    # 0.2 and 0.3 off, whatever share of the pixels the answer covers and however long its normals.
    for share, length in ((1.0, 1.0), (0.6, 1.0), (0.7, 0.78)):
        told = decoded(0.6, 0.7, share, length)
        found = material_difference(told, truth, length)
        torch.testing.assert_close(found, torch.full((2,), 0.5), **close)
    # Where hardly anything is told, nothing is compared.
    faint = decoded(0.6, 0.7, 0.2)
    assert material_difference(faint, truth, 1.0).tolist() == [0.0, 0.0]


def test_outlines_do_not_follow_materials():
    told = {name: p.clone().requires_grad_() for name, p in decoded(0.6, 0.7, 0.8).items()}
    material_difference(told, decoded(0.4, 1.0), 1.0).sum().backward()
    assert told["orm"].grad.abs().sum() > 0.0
    assert told["normal"].grad is None
