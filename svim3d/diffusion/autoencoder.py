"""From pictures to latents and back, a few pictures at a time."""

import torch
from diffusers import AutoencoderKL
from jaxtyping import Float
from torch import Tensor

__all__ = ["AutoencoderKL", "decode", "encode"]

PICTURES_AT_A_TIME = 21  # one group of a clip: 3 GB of activations at 576 px in bfloat16


def encode(
    autoencoder: AutoencoderKL,
    pictures: Float[Tensor, "n 3 H W"],
    chunk: int = PICTURES_AT_A_TIME,
) -> Float[Tensor, "n z h w"]:
    """The mode of the encoder's posterior, not scaled."""
    weights = next(autoencoder.parameters())
    return torch.cat(
        [
            autoencoder.encode(part.to(weights.dtype)).latent_dist.mode().float()
            for part in pictures.split(chunk)
        ]
    )


def decode(
    autoencoder: AutoencoderKL,
    latents: Float[Tensor, "n z h w"],
    chunk: int = PICTURES_AT_A_TIME,
) -> Float[Tensor, "n 3 H W"]:
    """Pictures in about [-1, 1] of latents as `encode` gives them."""
    weights = next(autoencoder.parameters())
    return torch.cat(
        [autoencoder.decode(part.to(weights.dtype)).sample.float() for part in latents.split(chunk)]
    )
