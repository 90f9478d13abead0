"""The video UNet: its size, its stock parts, what each input may alter."""

import pytest
import torch
from diffusers import UNetSpatioTemporalConditionModel
from tiny_diffusion import FRAMES, some_conditioning, some_latents, tiny_unet
from torch import nn

from svim3d.diffusion.conditioning import Conditioning
from svim3d.diffusion.model import PAPER, MaterialDiffusion
from svim3d.diffusion.unet import MaterialVideoUNet

LEVEL = torch.tensor([0.3])


def answer(unet: MaterialVideoUNet, told: Conditioning, noisy: torch.Tensor) -> torch.Tensor:
    level = LEVEL.expand(len(noisy))
    return unet(told.beside(noisy), level, told.token, told.camera)


def test_full_size_has_the_papers_parameters():
    with torch.device("meta"):
        model = MaterialDiffusion.untrained(PAPER)
    sizes = {
        name: sum(weight.numel() for weight in part.parameters())
        for name, part in model.parts.items()
    }
    assert sizes == {
        "unet": 1_525_347_574,
        "autoencoder": 83_653_863,
        "image_encoder": 632_076_800,  # CLIP ViT-H/14's image tower with its projection
    }
    assert len(model.unet.state_dict()) == 1428
    assert model.unet.conv_in.weight.shape == (320, 20, 3, 3)
    assert model.unet.conv_out.weight.shape == (16, 320, 3, 3)
    assert model.device.type == "meta"
    assert {weight.device.type for weight in model.unet.parameters()} == {"meta"}
    frozen = sum(weight.numel() for weight in model.unet.temporal_attention())
    assert 1_525_347_574 - frozen == 1_028_541_494


def test_norms_have_the_eps_they_were_trained_with():
    norms = {n: m.eps for n, m in tiny_unet().named_modules() if isinstance(m, nn.GroupNorm)}
    assert {eps for name, eps in norms.items() if name.endswith(".norm")} == {1e-6}
    assert {eps for name, eps in norms.items() if not name.endswith(".norm")} == {1e-5}


def test_parity_with_the_stock_forward_when_all_frames_share_a_camera():
    # Stock embeds one vector of equally wide sinusoids per clip. With angle sinusoids as wide as
    # the noise's, and one camera for all frames, that is what ours does too.
    unet = tiny_unet().double()
    width = 5 * 8
    stock = UNetSpatioTemporalConditionModel(
        in_channels=20,
        out_channels=16,
        down_block_types=("CrossAttnDownBlockSpatioTemporal", "DownBlockSpatioTemporal"),
        up_block_types=("UpBlockSpatioTemporal", "CrossAttnUpBlockSpatioTemporal"),
        block_out_channels=(64, 64),
        addition_time_embed_dim=8,
        projection_class_embeddings_input_dim=width,
        layers_per_block=1,
        cross_attention_dim=16,
        num_attention_heads=(2, 4),
        num_frames=FRAMES,
    ).double()
    stock.load_state_dict(unet.state_dict())
    ours, theirs = dict(unet.named_modules()), dict(stock.named_modules())
    for name, module in theirs.items():
        if isinstance(module, nn.GroupNorm):
            module.eps = ours[name].eps
    told, noisy = some_conditioning(), some_latents().double()
    camera = told.camera[:, :1].expand(-1, FRAMES, -1)
    told = Conditioning(told.token.double(), told.latent, camera)
    sinusoids = torch.cat(
        [
            unet.add_time_proj(told.camera[0, :1, 0]),
            unet.angle_proj(told.camera[0, :1, 1]),
            unet.angle_proj(told.camera[0, :1, 2]),
        ],
        1,
    )
    # Feed stock those very numbers instead of its own sinusoids of three scalars.
    stock.add_time_proj = nn.Identity()
    with torch.no_grad():
        expected = stock(told.beside(noisy), LEVEL, told.token, sinusoids).sample
    assert torch.allclose(answer(unet, told, noisy), expected, atol=1e-12)


def test_sinusoids_are_cosines_then_sines_of_noise_polar_and_azimuth():
    unet = tiny_unet()
    seen = []
    unet.add_embedding.register_forward_hook(lambda _m, given, _out: seen.append(given[0]))
    camera = torch.tensor([[[1e-5, 1.4, 2.0]]])
    unet.embed_camera(camera)

    def sinusoid(value: float, dim: int) -> torch.Tensor:
        rates = 10000.0 ** (-torch.arange(dim // 2) / (dim // 2))
        return torch.cat([torch.cos(value * rates), torch.sin(value * rates)])

    expected = torch.cat([sinusoid(1e-5, 8), sinusoid(1.4, 16), sinusoid(2.0, 16)])
    assert torch.allclose(seen[0][0], expected, atol=1e-6)


def test_a_frames_azimuth_alters_that_frames_azimuth_sinusoids_alone():
    with torch.device("meta"):
        widths = MaterialVideoUNet(**PAPER.unet).add_embedding.linear_1.in_features
    assert widths == 256 + 512 + 512
    unet = tiny_unet(addition_time_embed_dim=256)
    seen = []
    unet.add_embedding.register_forward_hook(lambda _m, given, _out: seen.append(given[0]))
    camera = some_conditioning().camera
    turned = camera.clone()
    turned[0, 2, 2] += 0.1
    embedded = [unet.embed_camera(c) for c in (camera, turned)]
    assert (seen[0] != seen[1]).nonzero()[:, 0].unique().tolist() == [2]
    columns = (seen[0] != seen[1]).nonzero()[:, 1]
    assert int(columns.min()) >= 768
    assert int(columns.max()) < 1280
    assert (embedded[0] != embedded[1]).any(1).nonzero().flatten().tolist() == [2]


def test_two_clips_at_once_are_two_clips():
    # One of them without a reference view, as in guidance: no clip sees the other's token.
    unet, noisy = tiny_unet(), some_latents(clips=2)
    told = some_conditioning(clips=2).dropped(torch.tensor([1.0, 0.0]))
    together = answer(unet, told, noisy)
    for clip in range(2):
        one = slice(clip, clip + 1)
        alone = Conditioning(told.token[one], told.latent[one], told.camera[one])
        assert torch.allclose(answer(unet, alone, noisy[one])[0], together[clip], atol=1e-5)


def test_frames_alter_each_other_and_know_their_index():
    # A clip that repeats one frame under one camera: only the frame index, and the ends of the
    # convolution over frames, can make its answers differ.
    unet, told = tiny_unet(), some_conditioning()
    still = Conditioning(told.token, told.latent, told.camera[:, :1].expand(-1, FRAMES, -1))
    noisy = some_latents()[:, :1].expand(-1, FRAMES, -1, -1, -1)
    same = answer(unet, still, noisy)
    assert not torch.allclose(same[0, 1], same[0, 2], atol=1e-3)
    moved = noisy.clone()
    moved[0, 4] += 1.0
    assert not torch.allclose(answer(unet, still, moved)[0, 0], same[0, 0], atol=1e-4)


def test_without_temporal_layers_frames_are_equivariant():
    # The mixers' share of the spatial branch at 1: frames keep to themselves, so any order of
    # frames gives the same answers in that order.
    unet, told, noisy = tiny_unet(), some_conditioning(), some_latents()
    for name, weight in unet.named_parameters():
        if name.endswith("mix_factor"):
            weight.fill_(100.0)
    order = [3, 0, 4, 1, 2]
    shuffled = Conditioning(told.token, told.latent, told.camera[:, order])
    straight = answer(unet, told, noisy)[:, order]
    assert torch.allclose(answer(unet, shuffled, noisy[:, order]), straight, atol=1e-5)


def test_every_weight_that_can_matter_gets_a_gradient():
    unet, told = tiny_unet().requires_grad_(True), some_conditioning()
    answer(unet, told, some_latents()).square().sum().backward()
    steepest = {name: float(p.grad.abs().max()) for name, p in unet.named_parameters()}
    silent = {name for name, gradient in steepest.items() if gradient < 1e-3}
    # With one token, softmax is 1 whatever asks: query, key and the norm before them are idle.
    parts = ("attn2.to_q", "attn2.to_k", "transformer_blocks.0.norm2")
    idle = {name for name in steepest if any(part in name for part in parts)}
    assert silent == idle


def test_sides_that_cannot_be_halved_are_refused():
    unet, told = tiny_unet(), some_conditioning()
    odd = Conditioning(told.token, told.latent[..., :7], told.camera)
    with pytest.raises(ValueError, match="multiples of 2"):
        answer(unet, odd, some_latents()[..., :7])
