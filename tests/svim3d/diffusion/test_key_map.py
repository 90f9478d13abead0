"""The key map: every tensor finds its place, and the network then computes what the file meant."""

import math

import pytest
import single_file
import single_file_twin as twin
import torch
from diffusers import AutoencoderKL
from transformers import CLIPVisionConfig, CLIPVisionModelWithProjection

from svim3d.diffusion.checkpoint import fill, spec_of
from svim3d.diffusion.key_map import autoencoder_name, find_move, sort_names, unet_name
from svim3d.diffusion.model import PAPER, MaterialDiffusion
from svim3d.diffusion.unet import MaterialVideoUNet

# In float64 only the order of sums differs. The subtlest fault, the libraries' own epsilon in the
# norms of the UNet's residual blocks, makes answers of size 1 differ by 3e-5.
TOLERANCE = 1e-10

FULL, SMALL = single_file.Widths(), single_file.SMALL
PREFIXES = {
    "unet": single_file.UNET,
    "image_encoder": f"{single_file.CLIP}visual.",
    "autoencoder": single_file.AUTOENCODER,
}


def count(shapes):
    return sum(math.prod(shape) for shape in shapes.values())


def seeded(seed):
    return torch.Generator().manual_seed(seed)


def moved(tensors, part):
    """The tensors of a network by the names of the libraries."""
    found = {}
    for move in sort_names(tensors).moves:
        if move.part == part:
            found |= move.carry_out(tensors[move.source])
    return found


def shapes_of(tensors):
    return {name: tuple(tensor.shape) for name, tensor in tensors.items()}


@pytest.fixture(scope="module")
def tensors():
    drawn = single_file.filled(single_file.whole(SMALL))
    return {name: tensor.double() for name, tensor in drawn.items()}


@pytest.fixture(scope="module")
def full():
    """Shapes of the full file's tensors once they are moved, by network."""
    tensors = {n: torch.empty(s, device="meta") for n, s in single_file.whole(FULL).items()}
    return {part: shapes_of(moved(tensors, part)) for part in PREFIXES}


@pytest.fixture(scope="module")
def spec(tensors):
    return spec_of("small", {part: shapes_of(moved(tensors, part)) for part in PREFIXES})


@pytest.fixture(scope="module")
def unet(tensors, spec):
    with torch.device("meta"):
        network = MaterialVideoUNet(**spec.unet)
    fill(network, moved(tensors, "unet"), "unet")
    return network.eval()


def test_the_list_of_blocks_has_the_published_counts():
    # The list is the tests' own; these figures say that it is SV3D's.
    assert len(single_file.unet(FULL)) == 1428
    assert count(single_file.unet(FULL)) == 1_525_278_442
    assert count(single_file.unet(single_file.Widths(told=256))) == 1_523_967_722
    assert count(single_file.autoencoder(FULL)) == 83_653_863
    assert count(single_file.picture_decoder(128)) == 49_490_179
    assert count(single_file.whole(FULL)) == 2_342_222_549  # times 4 bytes: the file's 9.37 GB


def test_every_tensor_of_the_full_file_has_its_place_in_the_full_networks(full):
    with torch.device("meta"):
        model = MaterialDiffusion.untrained(PAPER)
    for part, network in model.parts.items():
        wanted = shapes_of(network.state_dict())
        if part == "unet":
            wanted |= {"conv_in.weight": (320, 8, 3, 3), "conv_out.weight": (4, 320, 3, 3)}
            wanted |= {"conv_out.bias": (4,)}
        assert full[part] == wanted


def test_no_two_tensors_go_to_one_place(tensors):
    names = [(m.part, name) for m in sort_names(tensors).moves for name in m.names]
    assert len(names) == len(set(names))


def test_text_tower_and_second_decoder_are_set_aside(tensors):
    found = sort_names([*tensors, "model_ema.decay"])
    assert len(found.text_tower) == len(single_file.text_tower(SMALL))
    assert set(found.second_decoder) == {n for n in tensors if n.startswith("first_stage_model.")}
    assert all(twin in tensors for twin in found.second_decoder.values())
    assert found.unknown == ["model_ema.decay"]


@pytest.mark.parametrize(
    "name",
    [
        f"{single_file.UNET}input_blocks.13.0.in_layers.0.weight",
        f"{single_file.UNET}input_blocks.1.0.in_layers.1.weight",
        f"{single_file.UNET}input_blocks.1.2.conv.weight",
        f"{single_file.UNET}output_blocks.3.1.view_attention.weight",
        f"{single_file.UNET}middle_block.3.norm.weight",
        f"{single_file.CLIP}visual.attnpool.q_proj.weight",
        f"{single_file.AUTOENCODER}encoder.down.0.attn.0.q.weight",
        f"{single_file.AUTOENCODER}loss.logvar",
        "encoder.conv_in.weight",
    ],
)
def test_names_of_other_networks_have_no_place(name):
    assert find_move(name) is None


def test_names_by_hand():
    assert unet_name("output_blocks.2.1.conv.bias") == "up_blocks.0.upsamplers.0.conv.bias"
    assert unet_name("output_blocks.8.2.conv.bias") == "up_blocks.2.upsamplers.0.conv.bias"
    assert unet_name("input_blocks.9.0.op.weight") == "down_blocks.2.downsamplers.0.conv.weight"
    assert (
        unet_name("input_blocks.8.1.time_stack.0.ff_in.net.0.proj.weight")
        == "down_blocks.2.attentions.1.temporal_transformer_blocks.0.ff_in.net.0.proj.weight"
    )
    assert (
        unet_name("output_blocks.11.0.time_stack.out_layers.3.bias")
        == "up_blocks.3.resnets.2.temporal_res_block.conv2.bias"
    )
    assert (
        autoencoder_name("decoder.up.3.block.0.nin_shortcut.weight")
        == "decoder.up_blocks.0.resnets.0.conv_shortcut.weight"
    )


def test_sizes_are_read_off_the_shapes(spec):
    assert spec.unet == {
        "in_channels": 8,
        "out_channels": 4,
        "block_out_channels": [64, 64, 128, 128],
        "num_attention_heads": [1, 1, 2, 2],
        "layers_per_block": 2,
        "cross_attention_dim": 32,
        "addition_time_embed_dim": 256,
        "attention": [True, True, True, False],
    }
    assert spec.groups == ("rgb",)
    assert spec.image_encoder["image_size"] == 28


def test_full_sizes_are_those_of_the_paper(full):
    spec = spec_of(PAPER.name, full)
    assert spec.unet == PAPER.unet | {"in_channels": 8, "out_channels": 4}
    assert spec.autoencoder == PAPER.autoencoder
    assert spec.image_encoder == PAPER.image_encoder


@torch.no_grad()
def test_unet_computes_what_the_file_means(tensors, unet):
    generator = seeded(1)
    sample = torch.randn(2, 3, 8, 8, 16, generator=generator, dtype=torch.float64)
    context = torch.randn(2, 32, generator=generator, dtype=torch.float64)
    context[1] = 0.0  # as in guidance: one clip without its token
    level = torch.tensor([-1.2, 1.5])
    camera = torch.rand(2, 3, 3, generator=generator) * torch.tensor([1e-5, 3.0, 6.0])
    expected = twin.unet(twin.under(tensors, single_file.UNET), sample, level, context, camera)
    found = unet(sample, level, context[:, None], camera)
    assert expected.std() > 0.1
    torch.testing.assert_close(found, expected, rtol=0.0, atol=TOLERANCE)


@torch.no_grad()
def test_one_residual_block_and_one_transformer_compute_alike(tensors, unet):
    t = twin.under(tensors, single_file.UNET)
    generator = seeded(2)
    hidden = torch.randn(6, 64, 4, 4, generator=generator, dtype=torch.float64)
    embedding = torch.randn(6, 256, generator=generator, dtype=torch.float64)
    context = torch.randn(6, 1, 32, generator=generator, dtype=torch.float64)
    still = torch.zeros(2, 3)  # no frame is a picture by itself
    # Block 7 makes 128 of 64 channels, so its shortcut takes part.
    torch.testing.assert_close(
        unet.down_blocks[2].resnets[0](hidden, embedding, still),
        twin.residual(t, "input_blocks.7.0", hidden, embedding, 3),
        rtol=0.0,
        atol=TOLERANCE,
    )
    torch.testing.assert_close(
        unet.down_blocks[0].attentions[1](hidden, context, still, return_dict=False)[0],
        twin.transformer(t, "input_blocks.2.1", hidden, context, 3),
        rtol=0.0,
        atol=TOLERANCE,
    )


@torch.no_grad()
def test_image_tower_computes_what_the_file_means(tensors, spec):
    tower = CLIPVisionModelWithProjection(CLIPVisionConfig(**spec.image_encoder)).eval()
    fill(tower, moved(tensors, "image_encoder"), "image_encoder")
    pictures = torch.randn(2, 3, 28, 28, generator=seeded(3), dtype=torch.float64)
    expected = twin.image_tower(twin.under(tensors, PREFIXES["image_encoder"]), pictures, heads=2)
    assert expected.std() > 0.1
    torch.testing.assert_close(tower(pictures).image_embeds, expected, rtol=0.0, atol=TOLERANCE)


@torch.no_grad()
def test_autoencoder_computes_what_the_file_means(tensors, spec):
    autoencoder = AutoencoderKL(**spec.autoencoder).eval()
    fill(autoencoder, moved(tensors, "autoencoder"), "autoencoder")
    t = twin.under(tensors, single_file.AUTOENCODER)
    pictures = torch.randn(2, 3, 32, 48, generator=seeded(4), dtype=torch.float64)
    latents = twin.encode(t, pictures)
    assert latents.std() > 0.1
    found = autoencoder.encode(pictures).latent_dist.mode()
    torch.testing.assert_close(found, latents, rtol=0.0, atol=TOLERANCE)
    expected = twin.decode(t, latents)
    assert expected.std() > 0.1
    torch.testing.assert_close(
        autoencoder.decode(latents).sample, expected, rtol=0.0, atol=TOLERANCE
    )
