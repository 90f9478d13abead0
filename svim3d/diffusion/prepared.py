"""The UNet prepared for sampling: what stays the same over all steps is computed once.

`PreparedUNet` answers as `MaterialVideoUNet.forward` does, its plain twin, up to rounding. It saves

- cross-attention, which with a single token does not depend on what asks;
- the embeddings of cameras and frame indices, which do not depend on the noise level;
- a product per block for the embedding, and one for each of query, key and value;
- copies: frames stay channel last from end to end.

No gradients: training uses the twin.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch._dynamo import config as dynamo_config
from torch.nn import functional

from svim3d.diffusion.conditioning import Conditioning
from svim3d.diffusion.prepared_blocks import (
    PreparedResBlock,
    PreparedTransformer,
    PreparedUpsample,
    conv,
    group_norm,
)
from svim3d.diffusion.unet import MaterialVideoUNet


@dataclass(frozen=True)
class BoundConditioning:
    """What a conditioning means to a `PreparedUNet`.

    Attributes:
        camera: embedding of each frame's camera.
        pictures: `Conditioning.pictures` after the first convolution, with its bias.
        transformers: what `PreparedTransformer.bind` gave for each of them.
    """

    camera: Float[Tensor, "b k d"]
    pictures: Float[Tensor, "b k_or_1 h w c"]
    transformers: list[tuple[Tensor, ...]]


class PreparedUNet:
    """A UNet arranged for repeated calls on one orbit.

    Args:
        unet: its weights are shared where they can be; those arranged anew are copies, so prepare
            again after training.
        compiled: compile each residual block and each transformer. It takes minutes once, pays on
            CUDA devices, and fuses what lies between matrix products.
    """

    @torch.no_grad()
    def __init__(self, unet: MaterialVideoUNet, *, compiled: bool = False) -> None:
        self.unet = unet
        self._steps = list(_steps(unet))
        blocks = [layer for kind, layer in self._steps if kind in ("res", "attend")]
        res = [block for block in blocks if isinstance(block, PreparedResBlock)]
        projections = [layer for block in res for layer in block.projections()]
        self._shift_weight = torch.cat([layer.weight for layer in projections])
        self._shift_bias = torch.cat([layer.bias for layer in projections])
        self._shift_widths = [layer.out_features for layer in projections]
        if compiled:
            for block in blocks:
                block.compile(dynamic=False)
        # All blocks share the code that is compiled; the full-size network has 18 shapes of them,
        # where torch gives up after 8.
        self._shapes_allowed = {"recompile_limit": max(8, len(blocks))} if compiled else {}

    @torch.no_grad()
    def bind(self, conditioning: Conditioning) -> BoundConditioning:
        """Compute what stays the same over all noise levels."""
        unet, first = self.unet, self.unet.conv_in
        batch, frames, _ = conditioning.camera.shape
        seen = conditioning.pictures.to(first.weight.dtype)
        weight = first.weight[:, -seen.shape[2] :]
        pictures = functional.conv2d(
            seen.flatten(0, 1), weight, first.bias, padding=first.padding
        ).unflatten(0, seen.shape[:2])
        token = conditioning.token.to(first.weight.dtype)
        return BoundConditioning(
            camera=unet.embed_camera(conditioning.camera).unflatten(0, (batch, frames)),
            pictures=pictures.permute(0, 1, 3, 4, 2).contiguous(),
            transformers=[
                layer.bind(token, frames)
                for _, layer in self._steps
                if isinstance(layer, PreparedTransformer)
            ],
        )

    @torch.no_grad()
    def __call__(
        self,
        noisy: Float[Tensor, "n k c h w"],
        noise_level: Float[Tensor, "1"],
        bound: BoundConditioning,
    ) -> Float[Tensor, "b k o h w"]:
        """Answer with v, once for each conditioning.

        Args:
            noisy: scaled noisy latents of all groups. Fewer clips than conditionings are repeated
                over them: both branches of guidance begin with the same latents, unless they
                expect different ones.
            noise_level: `karras.c_noise`, the same for all.
            bound: from `bind`.

        Raises:
            ValueError: sides that cannot be halved as often as the network does.
        """
        unet, told = self.unet, iter(bound.transformers)
        unet.check_sides(noisy)
        shifts = iter(self._shifts(noise_level, bound.camera))
        clips = len(bound.pictures) // len(noisy)
        hidden = self._first(noisy).repeat(clips, 1, 1, 1, 1) + bound.pictures
        with dynamo_config.patch(self._shapes_allowed):
            hidden = self._walk(hidden, shifts, told)
        hidden = functional.silu(group_norm(unet.conv_norm_out, hidden))
        return conv(unet.conv_out, hidden).permute(0, 1, 4, 2, 3)

    def _walk(
        self,
        hidden: Float[Tensor, "b k h w c"],
        shifts: Iterator[Tensor],
        told: Iterator[tuple[Tensor, ...]],
    ) -> Float[Tensor, "b k h w c"]:
        """Through all blocks, down and up again."""
        skips: list[Tensor] = []
        for kind, layer in self._steps:
            if kind == "keep":
                skips.append(hidden)
            elif kind == "join":
                hidden = torch.cat([hidden, skips.pop()], -1)
            elif kind == "res":
                hidden = layer(hidden, next(shifts), next(shifts))
            elif kind == "attend":
                hidden = layer(hidden, *next(told))
            elif kind == "down":
                hidden = conv(layer, hidden)
            else:
                hidden = layer(hidden)
        return hidden

    def _first(self, noisy: Float[Tensor, "n k c h w"]) -> Float[Tensor, "n k h w o"]:
        """The first convolution's share of the noisy latents; the rest of it is bound."""
        layer = self.unet.conv_in
        weight = layer.weight[:, : noisy.shape[2]]
        pictures = noisy.flatten(0, 1).to(weight.dtype)
        answer = functional.conv2d(pictures, weight, padding=layer.padding)
        return answer.permute(0, 2, 3, 1).unflatten(0, noisy.shape[:2])

    def _shifts(
        self, noise_level: Float[Tensor, "1"], camera: Float[Tensor, "b k d"]
    ) -> tuple[Tensor, ...]:
        """What noise level and cameras add in each residual block, in space and over frames."""
        unet = self.unet
        level = unet.time_embedding(unet.time_proj(noise_level).to(camera.dtype))
        embedding = functional.silu(camera + level)
        shifts = functional.linear(embedding, self._shift_weight, self._shift_bias)
        return shifts.split(self._shift_widths, -1)


def _steps(unet: MaterialVideoUNet) -> Iterator[tuple[str, Any]]:
    """The UNet's layers in the order of a call, between its first and last convolution."""
    yield "keep", None
    for block in unet.down_blocks:
        for layers in _pairs(block):
            yield from layers
            yield "keep", None
        for sampler in block.downsamplers or ():
            yield "down", sampler.conv
            yield "keep", None
    for layers in _pairs(unet.mid_block):
        yield from layers
    for block in unet.up_blocks:
        for layers in _pairs(block):
            yield "join", None
            yield from layers
        for sampler in block.upsamplers or ():
            yield "up", PreparedUpsample(sampler.conv)


def _pairs(block: Any) -> Iterator[list[tuple[str, Any]]]:
    """A block's residual blocks, each with the transformer that follows it, if one does."""
    attentions = list(getattr(block, "attentions", ()))
    for index, res in enumerate(block.resnets):
        following = attentions[index : index + 1]
        yield [
            ("res", PreparedResBlock(res)),
            *[("attend", PreparedTransformer(attention)) for attention in following],
        ]
