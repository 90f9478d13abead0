"""The networks of a single file in plain torch, fed with its tensors by its own names.

Written from SV3D's description, block by block, and compared with the loaded networks. All weights
are wanted in float64.
"""

import math

import torch
from torch import Tensor
from torch.nn import functional

Tensors = dict[str, Tensor]

HEAD = 64
RESIDUAL_EPS, TRANSFORMER_EPS, PICTURE_EPS = 1e-5, 1e-6, 1e-6


def under(tensors: Tensors, prefix: str) -> Tensors:
    return {n.removeprefix(prefix): t for n, t in tensors.items() if n.startswith(prefix)}


def linear(t: Tensors, name: str, x: Tensor) -> Tensor:
    return functional.linear(x, t[f"{name}.weight"], t.get(f"{name}.bias"))


def convolve(t: Tensors, name: str, x: Tensor, stride: int = 1) -> Tensor:
    weight = t[f"{name}.weight"]
    padding = tuple(k // 2 for k in weight.shape[2:])
    convolution = functional.conv3d if weight.ndim == 5 else functional.conv2d
    return convolution(x, weight, t[f"{name}.bias"], stride, padding)


def group_norm(t: Tensors, name: str, x: Tensor, eps: float) -> Tensor:
    return functional.group_norm(x, 32, t[f"{name}.weight"], t[f"{name}.bias"], eps)


def layer_norm(t: Tensors, name: str, x: Tensor) -> Tensor:
    return functional.layer_norm(x, x.shape[-1:], t[f"{name}.weight"], t[f"{name}.bias"], 1e-5)


def sinusoids(x: Tensor, width: int) -> Tensor:
    """In float32, as networks of any precision compute them."""
    half = width // 2
    frequency = torch.exp(-math.log(10000.0) * torch.arange(half) / half)
    angle = x[..., None].float() * frequency
    return torch.cat([angle.cos(), angle.sin()], -1).double()


def mixed(t: Tensors, name: str, spatial: Tensor, temporal: Tensor) -> Tensor:
    share = torch.sigmoid(t[f"{name}.time_mixer.mix_factor"])
    return share * spatial + (1.0 - share) * temporal


# UNet: x is [b t, c, h, w]


def half_residual(t: Tensors, at: str, x: Tensor, embedding: Tensor) -> Tensor:
    silu = functional.silu
    h = convolve(t, f"{at}.in_layers.2", silu(group_norm(t, f"{at}.in_layers.0", x, RESIDUAL_EPS)))
    h = h + embedding.reshape(*embedding.shape, *[1] * (h.ndim - embedding.ndim))
    h = group_norm(t, f"{at}.out_layers.0", h, RESIDUAL_EPS)
    h = convolve(t, f"{at}.out_layers.3", silu(h))
    has_skip = f"{at}.skip_connection.weight" in t
    return h + (convolve(t, f"{at}.skip_connection", x) if has_skip else x)


def residual(t: Tensors, at: str, x: Tensor, embedding: Tensor, frames: int) -> Tensor:
    embedding = functional.silu(embedding)
    spatial = half_residual(t, at, x, linear(t, f"{at}.emb_layers.1", embedding))
    volume = spatial.unflatten(0, (-1, frames)).transpose(1, 2)
    stack = f"{at}.time_stack"
    per_frame = linear(t, f"{stack}.emb_layers.1", embedding).unflatten(0, (-1, frames))
    temporal = half_residual(t, stack, volume, per_frame.transpose(1, 2))
    return mixed(t, at, spatial, temporal.transpose(1, 2).flatten(0, 1))


def attend(t: Tensors, at: str, x: Tensor, context: Tensor) -> Tensor:
    def heads(tensor: Tensor) -> Tensor:
        return tensor.unflatten(-1, (-1, HEAD)).transpose(1, 2)

    q = heads(linear(t, f"{at}.to_q", x))
    k, v = (heads(linear(t, f"{at}.to_{n}", context)) for n in "kv")
    weights = (q @ k.transpose(-1, -2) / HEAD**0.5).softmax(-1)
    return linear(t, f"{at}.to_out.0", (weights @ v).transpose(1, 2).flatten(2))


def feed_forward(t: Tensors, at: str, x: Tensor) -> Tensor:
    value, gate = linear(t, f"{at}.net.0.proj", x).chunk(2, -1)
    return linear(t, f"{at}.net.2", value * functional.gelu(gate))


def block(t: Tensors, at: str, x: Tensor, context: Tensor) -> Tensor:
    normed = layer_norm(t, f"{at}.norm1", x)
    x = x + attend(t, f"{at}.attn1", normed, normed)
    x = x + attend(t, f"{at}.attn2", layer_norm(t, f"{at}.norm2", x), context)
    return x + feed_forward(t, f"{at}.ff", layer_norm(t, f"{at}.norm3", x))


def transformer(t: Tensors, at: str, x: Tensor, context: Tensor, frames: int) -> Tensor:
    """Context is [b t, 1, d]."""
    c, h, w = x.shape[1:]
    tokens = group_norm(t, f"{at}.norm", x, TRANSFORMER_EPS).flatten(2).transpose(1, 2)
    spatial = block(t, f"{at}.transformer_blocks.0", linear(t, f"{at}.proj_in", tokens), context)
    place = linear(t, f"{at}.time_pos_embed.0", sinusoids(torch.arange(frames), c))
    place = linear(t, f"{at}.time_pos_embed.2", functional.silu(place))
    stack = f"{at}.time_stack.0"
    series = spatial.unflatten(0, (-1, frames)) + place[None, :, None]
    series = series.transpose(1, 2).flatten(0, 1)  # one series per clip and pixel
    series = series + feed_forward(t, f"{stack}.ff_in", layer_norm(t, f"{stack}.norm_in", series))
    series = block(t, stack, series, context[::frames].repeat_interleave(h * w, 0))
    temporal = series.unflatten(0, (-1, h * w)).transpose(1, 2).flatten(0, 1)
    answer = linear(t, f"{at}.proj_out", mixed(t, at, spatial, temporal))
    return x + answer.transpose(1, 2).reshape(x.shape)


def embed(t: Tensors, noise_level: Tensor, camera: Tensor) -> Tensor:
    """Of every frame; `camera` is added noise, polar angle and azimuth, [b, t, 3]."""
    frames = camera.shape[1]
    width = t["time_embed.0.weight"].shape[1]
    level = linear(t, "time_embed.0", sinusoids(noise_level, width))
    level = linear(t, "time_embed.2", functional.silu(level)).repeat_interleave(frames, 0)
    told = zip(camera.flatten(0, 1).unbind(1), (256, 512, 512), strict=True)
    label = torch.cat([sinusoids(number, width) for number, width in told], 1)
    label = linear(t, "label_emb.0.0", label)
    return level + linear(t, "label_emb.0.2", functional.silu(label))


def unet(t: Tensors, x: Tensor, noise_level: Tensor, context: Tensor, camera: Tensor) -> Tensor:
    """Answer to [b, t, c, h, w], given one context vector [b, d] per clip."""
    frames = x.shape[1]
    embedding = embed(t, noise_level, camera)
    context = context[:, None].repeat_interleave(frames, 0)

    def stage(at: str, hidden: Tensor) -> Tensor:
        hidden = residual(t, f"{at}.0", hidden, embedding, frames)
        is_attentive = f"{at}.1.norm.weight" in t
        return transformer(t, f"{at}.1", hidden, context, frames) if is_attentive else hidden

    hidden = convolve(t, "input_blocks.0.0", x.flatten(0, 1))
    skips = [hidden]
    for i in range(1, 12):
        at = f"input_blocks.{i}"
        is_smaller = f"{at}.0.op.weight" in t
        hidden = convolve(t, f"{at}.0.op", hidden, 2) if is_smaller else stage(at, hidden)
        skips.append(hidden)
    hidden = residual(t, "middle_block.0", hidden, embedding, frames)
    hidden = transformer(t, "middle_block.1", hidden, context, frames)
    hidden = residual(t, "middle_block.2", hidden, embedding, frames)
    for i in range(12):
        hidden = stage(f"output_blocks.{i}", torch.cat([hidden, skips.pop()], 1))
        for at in (f"output_blocks.{i}.1.conv", f"output_blocks.{i}.2.conv"):
            if f"{at}.weight" in t:
                hidden = convolve(t, at, functional.interpolate(hidden, scale_factor=2.0))
    hidden = functional.silu(group_norm(t, "out.0", hidden, RESIDUAL_EPS))
    return convolve(t, "out.2", hidden).unflatten(0, (-1, frames))


# Image tower


def image_tower(t: Tensors, pictures: Tensor, heads: int) -> Tensor:
    patches = functional.conv2d(pictures, t["conv1.weight"], stride=14).flatten(2).transpose(1, 2)
    first = t["class_embedding"].expand(len(pictures), 1, -1)
    x = layer_norm(t, "ln_pre", torch.cat([first, patches], 1) + t["positional_embedding"])
    layer = 0
    while (at := f"transformer.resblocks.{layer}") + ".ln_1.weight" in t:
        normed = layer_norm(t, f"{at}.ln_1", x).transpose(0, 1)
        attended, _ = functional.multi_head_attention_forward(
            normed,
            normed,
            normed,
            x.shape[-1],
            heads,
            t[f"{at}.attn.in_proj_weight"],
            t[f"{at}.attn.in_proj_bias"],
            None,
            None,
            False,
            0.0,
            t[f"{at}.attn.out_proj.weight"],
            t[f"{at}.attn.out_proj.bias"],
            need_weights=False,
        )
        x = x + attended.transpose(0, 1)
        inner = functional.gelu(linear(t, f"{at}.mlp.c_fc", layer_norm(t, f"{at}.ln_2", x)))
        x = x + linear(t, f"{at}.mlp.c_proj", inner)
        layer += 1
    return layer_norm(t, "ln_post", x[:, 0]) @ t["proj"]


# Autoencoder


def picture_block(t: Tensors, at: str, x: Tensor) -> Tensor:
    h = convolve(t, f"{at}.conv1", functional.silu(group_norm(t, f"{at}.norm1", x, PICTURE_EPS)))
    h = convolve(t, f"{at}.conv2", functional.silu(group_norm(t, f"{at}.norm2", h, PICTURE_EPS)))
    has_skip = f"{at}.nin_shortcut.weight" in t
    return h + (convolve(t, f"{at}.nin_shortcut", x) if has_skip else x)


def picture_attention(t: Tensors, at: str, x: Tensor) -> Tensor:
    normed = group_norm(t, f"{at}.norm", x, PICTURE_EPS)
    q, k, v = (convolve(t, f"{at}.{name}", normed).flatten(2) for name in "qkv")
    weights = (q.transpose(1, 2) @ k / x.shape[1] ** 0.5).softmax(-1)
    return x + convolve(t, f"{at}.proj_out", (v @ weights.transpose(1, 2)).reshape(x.shape))


def picture_middle(t: Tensors, x: Tensor) -> Tensor:
    x = picture_attention(t, "mid.attn_1", picture_block(t, "mid.block_1", x))
    return picture_block(t, "mid.block_2", x)


def encode(t: Tensors, pictures: Tensor) -> Tensor:
    """The mode of the posterior."""
    inner = under(t, "encoder.")
    x = convolve(inner, "conv_in", pictures)
    for level in range(4):
        for index in range(2):
            x = picture_block(inner, f"down.{level}.block.{index}", x)
        if level < 3:
            at = f"down.{level}.downsample.conv"
            padded = functional.pad(x, (0, 1, 0, 1))
            x = functional.conv2d(padded, inner[f"{at}.weight"], inner[f"{at}.bias"], stride=2)
    x = functional.silu(group_norm(inner, "norm_out", picture_middle(inner, x), PICTURE_EPS))
    return convolve(t, "quant_conv", convolve(inner, "conv_out", x)).chunk(2, 1)[0]


def decode(t: Tensors, latents: Tensor) -> Tensor:
    inner = under(t, "decoder.")
    x = picture_middle(inner, convolve(inner, "conv_in", convolve(t, "post_quant_conv", latents)))
    for level in (3, 2, 1, 0):
        for index in range(3):
            x = picture_block(inner, f"up.{level}.block.{index}", x)
        if level > 0:
            wider = functional.interpolate(x, scale_factor=2.0)
            x = convolve(inner, f"up.{level}.upsample.conv", wider)
    return convolve(
        inner, "conv_out", functional.silu(group_norm(inner, "norm_out", x, PICTURE_EPS))
    )
