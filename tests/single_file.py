"""A single-file checkpoint in the layout of SV3D_p, from a list of its blocks alone.

Written from the published layout and not from `svim3d.diffusion.key_map`: names and shapes of every
tensor, at any width.
"""

import json
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import torch

Shapes = dict[str, tuple[int, ...]]

UNET = "model.diffusion_model."
CLIP = "conditioner.embedders.0.open_clip.model."
AUTOENCODER = "conditioner.embedders.1.encoder."
SECOND_DECODER = "first_stage_model.decoder."


@dataclass(frozen=True)
class Widths:
    """SV3D_p's by default."""

    unet: int = 320
    multiples: tuple[int, ...] = (1, 2, 4, 4)
    context: int = 1024
    told: int = 1280
    inputs: int = 8
    outputs: int = 4
    tower: int = 1280
    layers: int = 32
    places: int = 257
    vocabulary: int = 49408
    autoencoder: int = 128


SMALL = Widths(
    unet=64,
    multiples=(1, 1, 2, 2),
    context=32,
    tower=160,
    layers=2,
    places=5,
    vocabulary=50,
    autoencoder=32,
)


def weight_and_bias(name: str, *shape: int) -> Shapes:
    return {f"{name}.weight": shape, f"{name}.bias": (shape[0],)}


def residual(name: str, inputs: int, outputs: int, embedding: int) -> Shapes:
    shapes: Shapes = {}
    for stack, kernel, first in (("", (3, 3), inputs), ("time_stack.", (3, 1, 1), outputs)):
        at = f"{name}.{stack}"
        shapes |= weight_and_bias(f"{at}in_layers.0", first)
        shapes |= weight_and_bias(f"{at}in_layers.2", outputs, first, *kernel)
        shapes |= weight_and_bias(f"{at}emb_layers.1", outputs, embedding)
        shapes |= weight_and_bias(f"{at}out_layers.0", outputs)
        shapes |= weight_and_bias(f"{at}out_layers.3", outputs, outputs, *kernel)
        if first != outputs:
            shapes |= weight_and_bias(f"{at}skip_connection", outputs, first, 1, 1)
    return shapes | {f"{name}.time_mixer.mix_factor": (1,)}


def feed_forward(name: str, c: int) -> Shapes:
    return weight_and_bias(f"{name}.net.0.proj", 8 * c, c) | weight_and_bias(
        f"{name}.net.2", c, 4 * c
    )


def attention(name: str, c: int, context: int) -> Shapes:
    shapes: Shapes = {f"{name}.to_q.weight": (c, c)}
    shapes |= {f"{name}.to_{x}.weight": (c, context) for x in "kv"}
    return shapes | weight_and_bias(f"{name}.to_out.0", c, c)


def transformer(name: str, c: int, context: int) -> Shapes:
    shapes = weight_and_bias(f"{name}.norm", c)
    shapes |= weight_and_bias(f"{name}.proj_in", c, c) | weight_and_bias(f"{name}.proj_out", c, c)
    for at in (f"{name}.transformer_blocks.0", f"{name}.time_stack.0"):
        for norm in ("norm1", "norm2", "norm3"):
            shapes |= weight_and_bias(f"{at}.{norm}", c)
        shapes |= attention(f"{at}.attn1", c, c) | attention(f"{at}.attn2", c, context)
        shapes |= feed_forward(f"{at}.ff", c)
    shapes |= weight_and_bias(f"{name}.time_stack.0.norm_in", c)
    shapes |= feed_forward(f"{name}.time_stack.0.ff_in", c)
    shapes |= weight_and_bias(f"{name}.time_pos_embed.0", 4 * c, c)
    shapes |= weight_and_bias(f"{name}.time_pos_embed.2", c, 4 * c)
    return shapes | {f"{name}.time_mixer.mix_factor": (1,)}


def unet(w: Widths) -> Shapes:
    """Block by block, as the network is built."""
    c, e = w.unet, 4 * w.unet
    c1, c2, c3, c4 = (w.unet * m for m in w.multiples)
    shapes = weight_and_bias("time_embed.0", e, c) | weight_and_bias("time_embed.2", e, e)
    shapes |= weight_and_bias("label_emb.0.0", e, w.told) | weight_and_bias("label_emb.0.2", e, e)
    shapes |= weight_and_bias("input_blocks.0.0", c, w.inputs, 3, 3)
    down = {1: (c, c1), 2: (c1, c1), 4: (c1, c2), 5: (c2, c2), 7: (c2, c3), 8: (c3, c3)}
    down |= {10: (c3, c4), 11: (c4, c4)}
    for i, (inputs, outputs) in down.items():
        shapes |= residual(f"input_blocks.{i}.0", inputs, outputs, e)
        if i < 10:
            shapes |= transformer(f"input_blocks.{i}.1", outputs, w.context)
    for i, width in {3: c1, 6: c2, 9: c3}.items():
        shapes |= weight_and_bias(f"input_blocks.{i}.0.op", width, width, 3, 3)
    shapes |= residual("middle_block.0", c4, c4, e) | residual("middle_block.2", c4, c4, e)
    shapes |= transformer("middle_block.1", c4, w.context)
    # Width that comes up, width of the skip beside it, width that goes on.
    up = [(c4, c4, c4), (c4, c4, c4), (c4, c3, c4), (c4, c3, c3), (c3, c3, c3), (c3, c2, c3)]
    up += [(c3, c2, c2), (c2, c2, c2), (c2, c1, c2), (c2, c1, c1), (c1, c1, c1), (c1, c, c1)]
    for i, (below, skip, outputs) in enumerate(up):
        shapes |= residual(f"output_blocks.{i}.0", below + skip, outputs, e)
        if i > 2:
            shapes |= transformer(f"output_blocks.{i}.1", outputs, w.context)
        if i in (2, 5, 8):
            at = f"output_blocks.{i}.{1 if i == 2 else 2}.conv"
            shapes |= weight_and_bias(at, outputs, outputs, 3, 3)
    return shapes | weight_and_bias("out.0", c) | weight_and_bias("out.2", w.outputs, c, 3, 3)


def image_tower(w: Widths) -> Shapes:
    c = w.tower
    shapes: Shapes = {
        "class_embedding": (c,),
        "positional_embedding": (w.places, c),
        "proj": (c, w.context),
        "conv1.weight": (c, 3, 14, 14),
    }
    shapes |= weight_and_bias("ln_pre", c) | weight_and_bias("ln_post", c)
    for i in range(w.layers):
        at = f"transformer.resblocks.{i}"
        shapes |= weight_and_bias(f"{at}.ln_1", c) | weight_and_bias(f"{at}.ln_2", c)
        shapes |= {f"{at}.attn.in_proj_weight": (3 * c, c), f"{at}.attn.in_proj_bias": (3 * c,)}
        shapes |= weight_and_bias(f"{at}.attn.out_proj", c, c)
        shapes |= weight_and_bias(f"{at}.mlp.c_fc", 4 * c, c)
        shapes |= weight_and_bias(f"{at}.mlp.c_proj", c, 4 * c)
    return shapes


def text_tower(w: Widths) -> Shapes:
    """What is left of it in the file."""
    shapes: Shapes = {
        "token_embedding.weight": (w.vocabulary, w.context),
        "positional_embedding": (77, w.context),
        "text_projection": (w.context, w.context),
        "logit_scale": (),
    }
    return shapes | weight_and_bias("ln_final", w.context)


def picture_block(name: str, inputs: int, outputs: int) -> Shapes:
    shapes = weight_and_bias(f"{name}.norm1", inputs) | weight_and_bias(f"{name}.norm2", outputs)
    shapes |= weight_and_bias(f"{name}.conv1", outputs, inputs, 3, 3)
    shapes |= weight_and_bias(f"{name}.conv2", outputs, outputs, 3, 3)
    if inputs != outputs:
        shapes |= weight_and_bias(f"{name}.nin_shortcut", outputs, inputs, 1, 1)
    return shapes


def picture_middle(c: int) -> Shapes:
    shapes = picture_block("mid.block_1", c, c) | picture_block("mid.block_2", c, c)
    shapes |= weight_and_bias("mid.attn_1.norm", c)
    for name in ("q", "k", "v", "proj_out"):
        shapes |= weight_and_bias(f"mid.attn_1.{name}", c, c, 1, 1)
    return shapes


def picture_encoder(c: int) -> Shapes:
    shapes = weight_and_bias("conv_in", c, 3, 3, 3)
    widths = [c, c, 2 * c, 4 * c, 4 * c]
    for level in range(4):
        inputs, outputs = widths[level], widths[level + 1]
        shapes |= picture_block(f"down.{level}.block.0", inputs, outputs)
        shapes |= picture_block(f"down.{level}.block.1", outputs, outputs)
        if level < 3:
            shapes |= weight_and_bias(f"down.{level}.downsample.conv", outputs, outputs, 3, 3)
    shapes |= picture_middle(4 * c) | weight_and_bias("norm_out", 4 * c)
    return shapes | weight_and_bias("conv_out", 8, 4 * c, 3, 3)


def picture_decoder(c: int) -> Shapes:
    shapes = weight_and_bias("conv_in", 4 * c, 4, 3, 3) | picture_middle(4 * c)
    widths = {3: (4 * c, 4 * c), 2: (4 * c, 4 * c), 1: (4 * c, 2 * c), 0: (2 * c, c)}
    for level, (inputs, outputs) in widths.items():
        shapes |= picture_block(f"up.{level}.block.0", inputs, outputs)
        for block in (1, 2):
            shapes |= picture_block(f"up.{level}.block.{block}", outputs, outputs)
        if level > 0:
            shapes |= weight_and_bias(f"up.{level}.upsample.conv", outputs, outputs, 3, 3)
    return shapes | weight_and_bias("norm_out", c) | weight_and_bias("conv_out", 3, c, 3, 3)


def autoencoder(w: Widths) -> Shapes:
    shapes = below("encoder.", picture_encoder(w.autoencoder))
    shapes |= below("decoder.", picture_decoder(w.autoencoder))
    shapes |= weight_and_bias("quant_conv", 8, 8, 1, 1)
    return shapes | weight_and_bias("post_quant_conv", 4, 4, 1, 1)


def below(prefix: str, shapes: Shapes) -> Shapes:
    return {prefix + name: shape for name, shape in shapes.items()}


def whole(w: Widths) -> Shapes:
    """Every tensor of the file."""
    return (
        below(UNET, unet(w))
        | below(f"{CLIP}visual.", image_tower(w))
        | below(CLIP, text_tower(w))
        | below(AUTOENCODER, autoencoder(w))
        | below(SECOND_DECODER, picture_decoder(w.autoencoder))
    )


def filled(shapes: Shapes, seed: int = 0) -> dict[str, torch.Tensor]:
    """Float32 weights as large as networks begin with; the second decoder copies the first."""
    tensors = dict(_drawn(shapes, torch.Generator().manual_seed(seed)))
    for name in shapes:
        if name.startswith(SECOND_DECODER):
            twin = AUTOENCODER + name.removeprefix("first_stage_model.")
            tensors[name] = tensors[twin].clone()
    return tensors


def _drawn(shapes: Shapes, generator: torch.Generator) -> Iterator[tuple[str, torch.Tensor]]:
    for name, shape in shapes.items():
        noise = torch.randn(shape, generator=generator)
        fan_in = max(1, noise[0].numel()) if len(shape) > 1 else 25
        centre = float(name.endswith("weight") and len(shape) == 1)  # scales of norms
        yield name, centre + noise / fan_in**0.5


def write_zeros(file: Path, shapes: Shapes, kind: str = "F8_E4M3") -> dict[str, int]:
    """A file of these tensors, all 0, that takes no room on the disk; tells where each begins.

    Eight-bit numbers keep even the full size within what a small machine maps.
    """
    size = {"F8_E4M3": 1, "F32": 4}[kind]
    header, starts, end = {}, {}, 0
    for name, shape in shapes.items():
        starts[name], end = end, end + size * math.prod(shape)
        header[name] = {"dtype": kind, "shape": shape, "data_offsets": [starts[name], end]}
    text = json.dumps(header).encode()
    with file.open("wb") as stream:
        stream.write(len(text).to_bytes(8, "little") + text)
        stream.truncate(8 + len(text) + end)
    return {name: 8 + len(text) + start for name, start in starts.items()}
