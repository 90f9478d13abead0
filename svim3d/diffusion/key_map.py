"""Names: the single-file layout of Stability's models as that of diffusers and transformers.

A single file holds four networks under prefixes. Of these the UNet, the image tower and the whole
autoencoder are taken. A second picture decoder and what is left of CLIP's text tower are not.

Only names are matched here; whether the tensors fit is asked of the networks themselves.
"""

import re
from collections.abc import Iterable
from dataclasses import dataclass
from enum import Enum

from torch import Tensor

UNET = "model.diffusion_model."
IMAGE_TOWER = "conditioner.embedders.0.open_clip.model.visual."
CLIP = "conditioner.embedders.0.open_clip.model."
AUTOENCODER = "conditioner.embedders.1.encoder."
SECOND_DECODER = "first_stage_model.decoder."

BLOCKS_PER_LEVEL = 3  # two residual blocks and a change of size on the way down, three blocks up
LEVELS = 4


class Change(Enum):
    """What becomes of a tensor beside its name."""

    NONE = "none"
    SQUEEZED = "a 1x1 convolution as a linear layer"
    TRANSPOSED = "applied from the other side"
    SPLIT = "query, key and value apart"


@dataclass(frozen=True)
class Move:
    """Where a tensor of a single file goes.

    Attributes:
        source: its name there.
        part: network: `unet`, `autoencoder` or `image_encoder`.
        names: in that network; three where it is split.
        change: beside the name.
    """

    source: str
    part: str
    names: tuple[str, ...]
    change: Change = Change.NONE

    def carry_out(self, tensor: Tensor) -> dict[str, Tensor]:
        """The tensors that the network wants, by name."""
        if self.change is Change.SQUEEZED:
            tensor = tensor.flatten(1)
        elif self.change is Change.TRANSPOSED:
            tensor = tensor.T
        elif self.change is Change.SPLIT:
            return dict(zip(self.names, tensor.chunk(3), strict=True))
        return {self.names[0]: tensor}


@dataclass(frozen=True)
class Sorted:
    """The tensors of a single file by what they are for.

    Attributes:
        moves: of the networks that are taken.
        second_decoder: names of the decoder that is not taken, each with its twin that is.
        text_tower: names of CLIP's other half, not taken.
        unknown: names that the layout does not have.
    """

    moves: list[Move]
    second_decoder: dict[str, str]
    text_tower: list[str]
    unknown: list[str]


def sort_names(names: Iterable[str]) -> Sorted:
    """Say of each tensor of a single file where it goes."""
    found = Sorted([], {}, [], [])
    for name in names:
        if name.startswith(SECOND_DECODER):
            found.second_decoder[name] = AUTOENCODER + name.removeprefix("first_stage_model.")
        elif name.startswith(CLIP) and not name.startswith(IMAGE_TOWER):
            found.text_tower.append(name)
        elif (move := find_move(name)) is not None:
            found.moves.append(move)
        else:
            found.unknown.append(name)
    return found


def find_move(name: str) -> Move | None:
    """Where a tensor goes; None where it has no place in the networks that are taken."""
    if name.startswith(UNET):
        found = unet_name(name.removeprefix(UNET))
        return None if found is None else Move(name, "unet", (found,))
    if name.startswith(IMAGE_TOWER):
        return _image_tower_move(name)
    if name.startswith(AUTOENCODER):
        found = autoencoder_name(name.removeprefix(AUTOENCODER))
        is_linear = re.search(r"\.mid\.attn_1\.(q|k|v|proj_out)\.weight$", name)
        change = Change.SQUEEZED if is_linear else Change.NONE
        return None if found is None else Move(name, "autoencoder", (found,), change)
    return None


def _renamed(name: str, table: dict[str, str]) -> str | None:
    """A name whose beginning stands in a table; None if none does."""
    for old, new in table.items():
        if name.startswith(f"{old}."):
            return f"{new}.{name[len(old) + 1 :]}"
    return None


# UNet

OUTER = {
    "time_embed.0": "time_embedding.linear_1",
    "time_embed.2": "time_embedding.linear_2",
    "label_emb.0.0": "add_embedding.linear_1",
    "label_emb.0.2": "add_embedding.linear_2",
    "input_blocks.0.0": "conv_in",
    "out.0": "conv_norm_out",
    "out.2": "conv_out",
}
RESIDUAL = {
    "in_layers.0": "norm1",
    "in_layers.2": "conv1",
    "emb_layers.1": "time_emb_proj",
    "out_layers.0": "norm2",
    "out_layers.3": "conv2",
    "skip_connection": "conv_shortcut",
}
TRANSFORMER = {
    "norm": "norm",
    "proj_in": "proj_in",
    "proj_out": "proj_out",
    "transformer_blocks": "transformer_blocks",
    "time_stack": "temporal_transformer_blocks",
    "time_pos_embed.0": "time_pos_embed.linear_1",
    "time_pos_embed.2": "time_pos_embed.linear_2",
    "time_mixer": "time_mixer",
}


def unet_name(name: str) -> str | None:
    """The name of a UNet tensor in diffusers' `UNetSpatioTemporalConditionModel`."""
    if (outer := _renamed(name, OUTER)) is not None:
        return outer
    if matched := re.fullmatch(r"middle_block\.([012])\.(.+)", name):
        place, rest = int(matched[1]), matched[2]
        if place == 1:
            return _below("mid_block.attentions.0", _transformer_name(rest))
        return _below(f"mid_block.resnets.{place // 2}", _residual_name(rest))
    matched = re.fullmatch(r"(input|output)_blocks\.(\d+)\.([012])\.(.+)", name)
    if matched is None:
        return None
    is_down, place, rest = matched[1] == "input", int(matched[3]), matched[4]
    # The way down starts behind conv_in, which counts as its block 0.
    level, index = divmod(int(matched[2]) - is_down, BLOCKS_PER_LEVEL)
    if not 0 <= level < LEVELS:
        return None
    block = f"{'down' if is_down else 'up'}_blocks.{level}"
    if is_down and place == 0 and rest.startswith("op."):
        return f"{block}.downsamplers.0.conv.{rest[3:]}"
    if not is_down and place > 0 and rest.startswith("conv."):
        return f"{block}.upsamplers.0.{rest}"
    if place == 0:
        return _below(f"{block}.resnets.{index}", _residual_name(rest))
    return _below(f"{block}.attentions.{index}", _transformer_name(rest)) if place == 1 else None


def _below(parent: str, name: str | None) -> str | None:
    return None if name is None else f"{parent}.{name}"


def _residual_name(name: str) -> str | None:
    """Inside a residual block: its spatial half, its temporal half and the mixer of both."""
    if name.startswith("time_mixer."):
        return name
    half = "temporal" if name.startswith("time_stack.") else "spatial"
    return _below(f"{half}_res_block", _renamed(name.removeprefix("time_stack."), RESIDUAL))


def _transformer_name(name: str) -> str | None:
    return _renamed(name, TRANSFORMER)


# Image tower

TOWER = {
    "conv1": "vision_model.embeddings.patch_embedding",
    "ln_pre": "vision_model.pre_layrnorm",  # sic
    "ln_post": "vision_model.post_layernorm",
}
TOWER_BLOCK = {
    "ln_1": "layer_norm1",
    "ln_2": "layer_norm2",
    "attn.out_proj": "self_attn.out_proj",
    "mlp.c_fc": "mlp.fc1",
    "mlp.c_proj": "mlp.fc2",
}


def _image_tower_move(source: str) -> Move | None:
    """From open_clip's visual tower to transformers' `CLIPVisionModelWithProjection`."""
    name, part = source.removeprefix(IMAGE_TOWER), "image_encoder"
    if name == "class_embedding":
        return Move(source, part, ("vision_model.embeddings.class_embedding",))
    if name == "positional_embedding":
        return Move(source, part, ("vision_model.embeddings.position_embedding.weight",))
    if name == "proj":
        return Move(source, part, ("visual_projection.weight",), Change.TRANSPOSED)
    found = _renamed(name, TOWER)
    if matched := re.fullmatch(r"transformer\.resblocks\.(\d+)\.(.+)", name):
        layer, rest = f"vision_model.encoder.layers.{matched[1]}", matched[2]
        if joint := re.fullmatch(r"attn\.in_proj_(weight|bias)", rest):
            names = tuple(f"{layer}.self_attn.{x}_proj.{joint[1]}" for x in "qkv")
            return Move(source, part, names, Change.SPLIT)
        found = _below(layer, _renamed(rest, TOWER_BLOCK))
    return None if found is None else Move(source, part, (found,))


# Autoencoder

ATTENTION = {
    "norm": "group_norm",
    "q": "to_q",
    "k": "to_k",
    "v": "to_v",
    "proj_out": "to_out.0",
}


def autoencoder_name(name: str) -> str | None:
    """The name of an autoencoder's tensor in diffusers' `AutoencoderKL`."""
    if name.startswith(("quant_conv.", "post_quant_conv.")):
        return name
    side, _, rest = name.partition(".")
    if side not in ("encoder", "decoder"):
        return None
    return _below(side, _coder_name(rest))


def _coder_name(name: str) -> str | None:
    """Inside the encoder or the decoder."""
    ends = {"conv_in": "conv_in", "norm_out": "conv_norm_out", "conv_out": "conv_out"}
    if (end := _renamed(name, ends)) is not None:
        return end
    if matched := re.fullmatch(r"mid\.block_([12])\.(.+)", name):
        return f"mid_block.resnets.{int(matched[1]) - 1}.{_shortcut(matched[2])}"
    if name.startswith("mid.attn_1."):
        return _below(
            "mid_block.attentions.0", _renamed(name.removeprefix("mid.attn_1."), ATTENTION)
        )
    matched = re.fullmatch(r"(down|up)\.(\d+)\.(?:block\.(\d+)|(down|up)sample)\.(.+)", name)
    if matched is None:
        return None
    way, level, block, resizing, rest = matched.groups()
    # Levels are counted from the finest there, in the order of their use here.
    level = int(level) if way == "down" else LEVELS - 1 - int(level)
    if block is None:
        return f"{way}_blocks.{level}.{resizing}samplers.0.{rest}"
    return f"{way}_blocks.{level}.resnets.{block}.{_shortcut(rest)}"


def _shortcut(name: str) -> str:
    return name.replace("nin_shortcut.", "conv_shortcut.")
