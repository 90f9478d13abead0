"""From pictures to latents and back, a few pictures at a time."""

from typing import Any, TypeAlias

import torch
from diffusers import AutoencoderKL
from jaxtyping import Float
from torch import Tensor

from svim3d.diffusion.patch_autoencoder import PatchAutoencoder

PICTURES_AT_A_TIME = 21  # one group of a clip: 3 GB of activations at 576 px in bfloat16

Autoencoder: TypeAlias = AutoencoderKL | PatchAutoencoder


def build_autoencoder(arguments: dict[str, Any]) -> Autoencoder:
    """Untrained, of the kind that the arguments are for: a patch is what the small one has."""
    return PatchAutoencoder(**arguments) if "patch" in arguments else AutoencoderKL(**arguments)


def encode(
    autoencoder: Autoencoder,
    pictures: Float[Tensor, "n 3 H W"],
    chunk: int = PICTURES_AT_A_TIME,
) -> Float[Tensor, "n z h w"]:
    """The latents, or the mode of their posterior; not scaled."""
    weights = next(autoencoder.parameters())
    codes = []
    for part in pictures.split(chunk):
        code = autoencoder.encode(part.to(weights.dtype))
        codes.append((code if isinstance(code, Tensor) else code.latent_dist.mode()).float())
    return torch.cat(codes)


def decode(
    autoencoder: Autoencoder,
    latents: Float[Tensor, "n z h w"],
    chunk: int = PICTURES_AT_A_TIME,
) -> Float[Tensor, "n 3 H W"]:
    """Pictures in about [-1, 1] of latents as `encode` gives them."""
    weights = next(autoencoder.parameters())
    pictures = []
    for part in latents.split(chunk):
        picture = autoencoder.decode(part.to(weights.dtype))
        pictures.append((picture if isinstance(picture, Tensor) else picture.sample).float())
    return torch.cat(pictures)
