"""The linear code against what principal components promise."""

import pytest
import torch
from torch.nn.functional import pixel_unshuffle

from svim3d.diffusion.patch_autoencoder import PatchAutoencoder

PATCH = 2


def pictures(count: int, seed: int = 0) -> torch.Tensor:
    """Smooth pictures: neighbouring pixels and channels agree, so that patches can be coded."""
    draw = torch.Generator().manual_seed(seed)
    coarse = torch.randn(count, 3, 4, 4, generator=draw)
    smooth = torch.nn.functional.interpolate(coarse, scale_factor=4, mode="bicubic")
    return smooth @ torch.eye(16) + 0.05 * torch.randn(count, 3, 16, 16, generator=draw)


def fitted(channels: int) -> PatchAutoencoder:
    torch.manual_seed(0)
    coder = PatchAutoencoder(patch=PATCH, latent_channels=channels, hidden=8, layers=1)
    coder.fit_components(pictures(200))
    return coder


@torch.no_grad()
def test_all_components_give_the_picture_back():
    coder = fitted(3 * PATCH**2)
    seen = pictures(4, seed=1)
    torch.testing.assert_close(coder.decode(coder.encode(seen)), seen, atol=1e-5, rtol=0.0)


@torch.no_grad()
def test_what_is_lost_are_the_smallest_variances():
    """The mean squared loss per patch is the sum of the variances left out (Eckart-Young)."""
    seen = pictures(200)
    patches = pixel_unshuffle(seen, PATCH).movedim(1, -1).flatten(0, 2).double()
    variances = torch.linalg.eigvalsh(torch.cov(patches.T, correction=0))
    for channels in (1, 4, 8):
        coder = fitted(channels)
        lost = (coder.decode(coder.encode(seen)) - seen) ** 2
        per_patch = float(lost.double().mean()) * 3 * PATCH**2
        assert per_patch == pytest.approx(float(variances[:-channels].sum()), rel=1e-4)


@torch.no_grad()
def test_codes_are_centred_uncorrelated_and_half_whitened():
    coder = fitted(4)
    codes = coder.encode(pictures(200)).movedim(1, -1).flatten(0, 2).double()
    covariance = torch.cov(codes.T, correction=0)
    patches = pixel_unshuffle(pictures(200), PATCH).movedim(1, -1).flatten(0, 2).double()
    deviations = torch.linalg.eigvalsh(torch.cov(patches.T, correction=0)).sqrt().flip(0)[:4]
    assert float(codes.mean(0).abs().max()) < 1e-5
    torch.testing.assert_close(covariance, torch.diag(deviations), atol=1e-4, rtol=1e-4)


def test_the_mending_network_starts_as_nothing_and_sees_neighbours():
    coder = fitted(4)
    with torch.no_grad():
        latents = coder.encode(pictures(1))
        plain = coder.to_picture(coder.synthesis(latents))
        assert torch.equal(coder.decode(latents), plain)
        torch.nn.init.normal_(coder.mending[-1].weight)
    latents.requires_grad_(True)
    coder.decode(latents)[0, :, 8:10, 8:10].sum().backward()
    touched = latents.grad.abs().sum((0, 1)) > 0
    assert bool(touched[4, 4])
    assert bool(touched[4, 5])
    assert not bool(touched[0, 0]) or int(touched.sum()) == touched.numel()
