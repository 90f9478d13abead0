"""Encoding and decoding in chunks is the same as at once."""

import pytest
import torch
from tiny_diffusion import tiny_model

from svim3d.diffusion.autoencoder import decode, encode


@pytest.mark.parametrize("chunk", [1, 3, 21])
def test_chunks_change_nothing_but_memory(chunk):
    autoencoder = tiny_model().autoencoder
    pictures = torch.rand(5, 3, 16, 16, generator=torch.Generator().manual_seed(0))
    latents = encode(autoencoder, pictures, chunk)
    assert latents.shape == (5, 4, 8, 8)
    assert torch.allclose(latents, encode(autoencoder, pictures, 5), atol=1e-5)
    decoded = decode(autoencoder, latents, chunk)
    assert decoded.shape == (5, 3, 16, 16)
    assert torch.allclose(decoded, decode(autoencoder, latents, 5), atol=1e-5)


def test_encoding_takes_the_mode_unscaled():
    autoencoder = tiny_model().autoencoder
    pictures = torch.rand(2, 3, 16, 16, generator=torch.Generator().manual_seed(0))
    mean = autoencoder.quant_conv(autoencoder.encoder(pictures)).chunk(2, 1)[0]
    assert torch.allclose(encode(autoencoder, pictures), mean, atol=1e-6)


def test_weights_of_half_precision_give_full_precision_pictures():
    autoencoder = tiny_model().autoencoder
    pictures = torch.rand(2, 3, 16, 16, generator=torch.Generator().manual_seed(0))
    full = encode(autoencoder, pictures)
    half = encode(autoencoder.to(torch.bfloat16), pictures)
    assert half.dtype == torch.float32
    # bfloat16 keeps 8 bits, and errors of a few layers add up.
    assert float((half - full).square().mean().sqrt() / full.square().mean().sqrt()) < 0.03
