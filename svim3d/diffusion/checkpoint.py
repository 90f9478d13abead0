"""Checkpoints: what kind a single file is, which model it holds, and strict filling of networks."""

import math
import re
from collections.abc import Mapping
from dataclasses import replace
from enum import StrEnum
from typing import Any

from torch import Tensor, nn

from svim3d.diffusion.groups import GROUPS
from svim3d.diffusion.key_map import UNET
from svim3d.diffusion.model import PAPER, ModelSpec

Shape = tuple[int, ...]

TOLD = 3  # names given of each kind of fault
# Not to be read off any tensor's shape: how wide an attention head is.
UNET_HEAD, IMAGE_ENCODER_HEAD = 64, 80  # SV3D's, and that of CLIP's ViT-H
CAMERA_WIDTHS = 5  # sinusoids of the added noise once, of each angle twice as many


class Kind(StrEnum):
    """What a single-file checkpoint holds."""

    SV3D_P = "SV3D_p"
    SV3D_U = "SV3D_u"
    SVD = "Stable Video Diffusion"
    SVIM3D = "SViM3D"


# By how many numbers the UNet is told beside the noise level.
KIND_OF_WIDTH = {1280: Kind.SV3D_P, 256: Kind.SV3D_U, 768: Kind.SVD}


def detect(shapes: Mapping[str, Shape]) -> Kind:
    """The kind of a single-file checkpoint, from the shapes of its tensors.

    Raises:
        ValueError: none of those known.
    """
    told = shapes.get(f"{UNET}label_emb.0.0.weight")
    first = shapes.get(f"{UNET}input_blocks.0.0.weight")
    last = shapes.get(f"{UNET}out.2.weight")
    if told is None or first is None or last is None:
        examples = ", ".join(sorted(shapes)[:TOLD]) or "none at all"
        is_ours = any(name.startswith(("conv_in.", "encoder.", "vision_model.")) for name in shapes)
        hint = "; this is one network of a model folder: name the folder" if is_ours else ""
        raise ValueError(
            f"wanted a single-file SV3D checkpoint with {UNET}* for its UNet, found {len(shapes)} "
            f"tensors such as {examples}{hint}"
        )
    latent_channels = first[1] - last[0]
    if latent_channels > 0 and last[0] > latent_channels and last[0] % latent_channels == 0:
        return Kind.SVIM3D
    if told[1] not in KIND_OF_WIDTH or first[1] != 2 * last[0]:
        raise ValueError(
            f"wanted a UNet told 1280 numbers, with 8 input and 4 output channels (SV3D_p), got "
            f"{told[1]} numbers, {first[1]} and {last[0]} channels"
        )
    return KIND_OF_WIDTH[told[1]]


def require_cameras(kind: Kind) -> None:
    """Refuse models that are not told where each frame's camera stands.

    Raises:
        ValueError: says which file to use.
    """
    if kind is Kind.SV3D_U:
        raise ValueError("this is SV3D_u, which is told no elevation; wanted sv3d_p.safetensors")
    if kind is Kind.SVD:
        raise ValueError(
            "this is Stable Video Diffusion, which is told no cameras; wanted sv3d_p.safetensors"
        )


def spec_of(name: str, shapes: Mapping[str, Mapping[str, Shape]]) -> ModelSpec:
    """The model that networks of these shapes make, sampled as SV3D is.

    Args:
        name: what the model shall be called.
        shapes: by network, of tensors with the names of diffusers and transformers.

    Raises:
        ValueError: a tensor that tells a size is lacking, or sizes that do not belong together.
    """
    unet = _unet_arguments(_Sizes("unet", shapes["unet"]))
    autoencoder = _autoencoder_arguments(_Sizes("autoencoder", shapes["autoencoder"]))
    groups, rest = divmod(unet["out_channels"], autoencoder["latent_channels"])
    if rest or not 1 <= groups <= len(GROUPS):
        raise ValueError(
            f"wanted 1 to {len(GROUPS)} groups of {autoencoder['latent_channels']} output "
            f"channels, got {unet['out_channels']} channels"
        )
    return replace(
        PAPER,
        name=name,
        groups=GROUPS[:groups],
        unet=unet,
        autoencoder=autoencoder,
        image_encoder=_image_encoder_arguments(_Sizes("image_encoder", shapes["image_encoder"])),
    )


def _unet_arguments(sizes: "_Sizes") -> dict[str, Any]:
    """Arguments of `MaterialVideoUNet`."""
    widths = [
        sizes.of(f"down_blocks.{level}.resnets.0.spatial_res_block.conv1.weight", 0)
        for level in range(sizes.count(r"down_blocks\.(\d+)\."))
    ]
    token = "mid_block.attentions.0.transformer_blocks.0.attn2.to_k.weight"
    return {
        "in_channels": sizes.of("conv_in.weight", 1),
        "out_channels": sizes.of("conv_out.weight", 0),
        "block_out_channels": widths,
        "num_attention_heads": [width // UNET_HEAD for width in widths],
        "layers_per_block": sizes.count(r"down_blocks\.0\.resnets\.(\d+)\."),
        "cross_attention_dim": sizes.of(token, 1),
        "addition_time_embed_dim": sizes.of("add_embedding.linear_1.weight", 1) // CAMERA_WIDTHS,
        "attention": [
            sizes.count(rf"down_blocks\.{level}\.attentions\.(\d+)\.") > 0
            for level in range(len(widths))
        ],
    }


def _autoencoder_arguments(sizes: "_Sizes") -> dict[str, Any]:
    """Arguments of diffusers' `AutoencoderKL`."""
    widths = [
        sizes.of(f"encoder.down_blocks.{level}.resnets.0.conv1.weight", 0)
        for level in range(sizes.count(r"encoder\.down_blocks\.(\d+)\."))
    ]
    return {
        **PAPER.autoencoder,
        "block_out_channels": widths,
        "down_block_types": ["DownEncoderBlock2D"] * len(widths),
        "up_block_types": ["UpDecoderBlock2D"] * len(widths),
        "latent_channels": sizes.of("decoder.conv_in.weight", 1),
        "layers_per_block": sizes.count(r"encoder\.down_blocks\.0\.resnets\.(\d+)\."),
    }


def _image_encoder_arguments(sizes: "_Sizes") -> dict[str, Any]:
    """Arguments of transformers' `CLIPVisionConfig`."""
    hidden = sizes.of("vision_model.embeddings.class_embedding", 0)
    patch = sizes.of("vision_model.embeddings.patch_embedding.weight", 3)
    places = sizes.of("vision_model.embeddings.position_embedding.weight", 0)
    return {
        **PAPER.image_encoder,
        "hidden_size": hidden,
        "intermediate_size": sizes.of("vision_model.encoder.layers.0.mlp.fc1.weight", 0),
        "num_hidden_layers": sizes.count(r"vision_model\.encoder\.layers\.(\d+)\."),
        "num_attention_heads": hidden // IMAGE_ENCODER_HEAD,
        "projection_dim": sizes.of("visual_projection.weight", 0),
        "image_size": patch * math.isqrt(places - 1),  # one place is the class's
        "patch_size": patch,
    }


class _Sizes:
    """The shapes of one network, asked for sizes."""

    def __init__(self, part: str, shapes: Mapping[str, Shape]) -> None:
        self._part, self._shapes = part, shapes

    def of(self, name: str, axis: int) -> int:
        """The length of a tensor along an axis."""
        shape = self._shapes.get(name, ())
        if len(shape) <= axis:
            raise ValueError(
                f"{self._part}: the size of {name} is wanted, but "
                f"{f'its shape is {shape}' if name in self._shapes else 'it is missing'}"
            )
        return shape[axis]

    def count(self, pattern: str) -> int:
        """How many different numbers names have where the pattern has its group."""
        return len({found[1] for name in self._shapes if (found := re.match(pattern, name))})


def require_fit(network: nn.Module, shapes: Mapping[str, Shape], part: str) -> None:
    """Ask that tensors of these names and shapes are all that a network has.

    Raises:
        ValueError: counts missing, unexpected and misshapen tensors and names the first of each.
    """
    wanted = {name: tuple(value.shape) for name, value in network.state_dict().items()}
    faults = {
        "missing": sorted(set(wanted) - set(shapes)),
        "unexpected": sorted(set(shapes) - set(wanted)),
        "of another shape": [
            f"{name} {shapes[name]} for {shape}"
            for name, shape in wanted.items()
            if name in shapes and shapes[name] != shape
        ],
    }
    told = [f"{len(names)} {kind} ({_first(names)})" for kind, names in faults.items() if names]
    if told:
        raise ValueError(f"{part}: the tensors do not fit the network: {'; '.join(told)}")


def _first(names: list[str]) -> str:
    return ", ".join(names[:TOLD]) + (", ..." if len(names) > TOLD else "")


def fill(network: nn.Module, tensors: Mapping[str, Tensor], part: str) -> None:
    """Give a network these very tensors as its weights, without a copy.

    Args:
        network: any device; best `meta`, where it took no memory.
        tensors: in the device and dtype that the network shall have.
        part: what to call the network in a complaint.

    Raises:
        ValueError: see `require_fit`.
    """
    require_fit(network, {name: tuple(value.shape) for name, value in tensors.items()}, part)
    network.load_state_dict(tensors, assign=True)
