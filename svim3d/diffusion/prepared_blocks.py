"""The UNet's blocks once more, for inference: the same weights, less work.

Frames lie channel last, `[clip, frame, row, column, channel]`, so that linear layers, norms and
convolutions all read memory as it lies. What does not depend on the noisy latents is passed in.
The plain twins are diffusers' blocks, whose submodules these share.
"""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

CHANNELS_LAST = torch.channels_last


class PreparedResBlock(nn.Module):
    """A residual block in space, then one over frames, mixed.

    Both take the embedding's projections ready made: all blocks share one matrix product.

    Args:
        stock: diffusers' `SpatioTemporalResBlock`.
    """

    def __init__(self, stock: Any) -> None:
        super().__init__()
        self.spatial, self.temporal = stock.spatial_res_block, stock.temporal_res_block
        self.first = frames_kernel(self.temporal.conv1)
        self.second = frames_kernel(self.temporal.conv2)
        self.share = 1.0 - mixed_share(stock.time_mixer)

    def projections(self) -> list[nn.Linear]:
        """What turns the embedding into this block's two shifts."""
        return [self.spatial.time_emb_proj, self.temporal.time_emb_proj]

    def forward(
        self,
        hidden: Float[Tensor, "b k h w c"],
        spatial_shift: Float[Tensor, "b k o"],
        temporal_shift: Float[Tensor, "b k o"],
    ) -> Float[Tensor, "b k h w o"]:
        """Mixing s and s + branch by a leaves s + (1 - a) branch."""
        spatial, temporal = self.spatial, self.temporal
        branch = functional.silu(group_norm(spatial.norm1, hidden))
        branch = conv(spatial.conv1, branch) + spatial_shift[:, :, None, None]
        branch = conv(spatial.conv2, functional.silu(group_norm(spatial.norm2, branch)))
        shortcut = spatial.conv_shortcut
        # A 1 x 1 convolution is a linear layer over channels.
        outer = (
            hidden
            if shortcut is None
            else functional.linear(hidden, shortcut.weight.flatten(1), shortcut.bias)
        )
        outer = outer + branch
        branch = functional.silu(group_norm(temporal.norm1, outer, over_frames=True))
        branch = conv_over_frames(self.first, temporal.conv1.bias, branch)
        branch = branch + temporal_shift[:, :, None, None]
        branch = functional.silu(group_norm(temporal.norm2, branch, over_frames=True))
        branch = conv_over_frames(self.second, temporal.conv2.bias, branch)
        return torch.addcmul(outer, branch, self.share)


class PreparedTransformer(nn.Module):
    """Attention within each frame, then of each place over all frames, mixed.

    Args:
        stock: diffusers' `TransformerSpatioTemporalModel` with one layer.
    """

    def __init__(self, stock: Any) -> None:
        super().__init__()
        self.norm, self.proj_in, self.proj_out = stock.norm, stock.proj_in, stock.proj_out
        (self.spatial,), (self.temporal,) = (
            stock.transformer_blocks,
            stock.temporal_transformer_blocks,
        )
        self.frame_sinusoids, self.frame_embedding = stock.time_proj, stock.time_pos_embed
        self.spatial_qkv = qkv_weight(self.spatial.attn1)
        self.temporal_qkv = qkv_weight(self.temporal.attn1)
        self.mix = mixed_share(stock.time_mixer)

    def bind(
        self, token: Float[Tensor, "b 1 d"], frames: int
    ) -> tuple[Float[Tensor, "b 1 1 c"], Float[Tensor, "b 1 1 c"], Float[Tensor, "k 1 c"]]:
        """What the clip's token adds in space and over frames, and the frames' own embedding.

        Softmax over a single token is 1, so cross-attention gives `to_out(to_v(token))` whatever
        asks; its query, its key and the norm before it play no part.
        """
        index = torch.arange(frames, device=token.device)
        embedding = self.frame_embedding(self.frame_sinusoids(index).to(token.dtype))
        answers = [
            block.attn2.to_out[0](block.attn2.to_v(token))[:, None]
            for block in (self.spatial, self.temporal)
        ]
        return answers[0], answers[1], embedding[:, None]

    def forward(
        self,
        hidden: Float[Tensor, "b k h w c"],
        spatial_answer: Float[Tensor, "b 1 1 c"],
        temporal_answer: Float[Tensor, "b 1 1 c"],
        frame_embedding: Float[Tensor, "k 1 c"],
    ) -> Float[Tensor, "b k h w c"]:
        """As the twin, with what `bind` gave."""
        block = self.spatial
        inner = self.proj_in(group_norm(self.norm, hidden).flatten(2, 3))
        inner = inner + attend(block.attn1, self.spatial_qkv, block.norm1(inner))
        inner = inner + spatial_answer
        inner = inner + feed_forward(block.ff, block.norm3(inner))

        block = self.temporal
        over = (inner + frame_embedding).transpose(1, 2).contiguous()
        over = over + feed_forward(block.ff_in, block.norm_in(over))
        over = over + attend(block.attn1, self.temporal_qkv, block.norm1(over))
        over = over + temporal_answer
        over = over + feed_forward(block.ff, block.norm3(over))
        mixed = torch.lerp(over.transpose(1, 2), inner, self.mix)
        return hidden + self.proj_out(mixed).unflatten(2, hidden.shape[2:4])


class PreparedUpsample(nn.Module):
    """Twice as many rows and columns by repetition, then a 3 x 3 convolution, as one.

    Of the three rows that an even row of the result looks at, the last two repeat one row; of
    those of an odd row, the first two. Four kernels of 2 x 2, one for each parity of row and
    column, do the same with 4/9 of the products.

    Args:
        stock: the 3 x 3 convolution.
    """

    def __init__(self, stock: Any) -> None:
        super().__init__()
        self.kernel = parity_kernels(stock.weight)
        self.bias = stock.bias.repeat(4)

    def forward(self, hidden: Float[Tensor, "b k h w c"]) -> Float[Tensor, "b k h2 w2 o"]:
        """Entry (i, j) of the padded 2 x 2 convolution looks at rows i - 1 and i."""
        height, width = hidden.shape[2:4]
        pictures = hidden.flatten(0, 1).permute(0, 3, 1, 2)
        answer = functional.conv2d(pictures, self.kernel, self.bias, padding=1)
        parities = answer.permute(0, 2, 3, 1).unflatten(-1, (2, 2, -1))
        rows = [
            torch.stack([parities[:, p : p + height, q : q + width, p, q] for q in (0, 1)], 3)
            for p in (0, 1)
        ]
        return torch.stack(rows, 2).flatten(3, 4).flatten(1, 2).unflatten(0, hidden.shape[:2])


def parity_kernels(weight: Float[Tensor, "o c 3 3"]) -> Float[Tensor, "four_o c 2 2"]:
    """Kernels of even and odd rows, each of even and odd columns, one below the other."""
    # Rows 0 and 1 of the 2 x 2 kernel, made of rows 0, 1, 2 of the 3 x 3 one, for both parities.
    merge = weight.new_tensor([[[1, 0, 0], [0, 1, 1]], [[1, 1, 0], [0, 0, 1]]])
    kernels = torch.einsum("pri,qsj,ocij->pqocrs", merge, merge, weight)
    return kernels.flatten(0, 2).contiguous(memory_format=CHANNELS_LAST)


def attend(
    attention: Any, qkv: Float[Tensor, "three_c c"], tokens: Float[Tensor, "b n l c"]
) -> Float[Tensor, "b n l c"]:
    """Self-attention within each row of tokens, by one product for query, key and value."""
    batch, rows, length, width = tokens.shape
    heads = attention.heads
    split = functional.linear(tokens, qkv).view(batch * rows, length, 3, heads, width // heads)
    query, key, value = split.permute(2, 0, 3, 1, 4).unbind(0)
    answer = functional.scaled_dot_product_attention(query, key, value)
    joined: Tensor = attention.to_out[0](answer.transpose(1, 2).reshape(tokens.shape))
    return joined


def feed_forward(stock: Any, tokens: Float[Tensor, "*n c"]) -> Float[Tensor, "*n c"]:
    """Gated linear units, GELU(gate) * value."""
    value, gate = stock.net[0].proj(tokens).chunk(2, -1)
    answer: Tensor = stock.net[2](functional.gelu(gate) * value)
    return answer


def group_norm(
    norm: nn.GroupNorm, hidden: Float[Tensor, "b k h w c"], over_frames: bool = False
) -> Float[Tensor, "b k h w c"]:
    """Normalise groups of channels over each frame, or over all frames of a clip."""
    pictures = hidden.flatten(1, 2) if over_frames else hidden.flatten(0, 1)
    normal = norm(pictures.permute(0, 3, 1, 2)).permute(0, 2, 3, 1)
    return normal.reshape(hidden.shape)


def conv(layer: nn.Conv2d, hidden: Float[Tensor, "b k h w c"]) -> Float[Tensor, "b k h2 w2 o"]:
    """A convolution within each frame."""
    answer = layer(hidden.flatten(0, 1).permute(0, 3, 1, 2)).permute(0, 2, 3, 1)
    return answer.unflatten(0, hidden.shape[:2])


def conv_over_frames(
    kernel: Float[Tensor, "o c taps 1"],
    bias: Float[Tensor, "o"],
    hidden: Float[Tensor, "b k h w c"],
) -> Float[Tensor, "b k h w o"]:
    """A convolution over frames: one in two dimensions, frames by places."""
    places = hidden.flatten(2, 3).permute(0, 3, 1, 2)
    answer = functional.conv2d(places, kernel, bias, padding=(kernel.shape[2] // 2, 0))
    return answer.permute(0, 2, 3, 1).unflatten(2, hidden.shape[2:4])


def frames_kernel(layer: nn.Conv3d) -> Float[Tensor, "o c taps 1"]:
    """A kernel over frames alone, as one in two dimensions."""
    return layer.weight.squeeze(-1).contiguous(memory_format=CHANNELS_LAST)


def qkv_weight(attention: Any) -> Float[Tensor, "three_c c"]:
    """Weights of query, key and value as one matrix."""
    return torch.cat([attention.to_q.weight, attention.to_k.weight, attention.to_v.weight])


def mixed_share(mixer: Any) -> Float[Tensor, "1"]:
    """Share of the spatial branch where it is mixed with the temporal one."""
    return torch.sigmoid(mixer.mix_factor)
