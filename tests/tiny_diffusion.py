"""The generator's networks at a size that tests can afford, with weights that all matter."""

from dataclasses import replace

import torch

from svim3d.diffusion.conditioning import Conditioning, camera_numbers
from svim3d.diffusion.model import MaterialDiffusion, ModelSpec
from svim3d.diffusion.unet import MaterialVideoUNet

FRAMES, SIDE, GROUP_CHANNELS = 5, 8, 4

SPEC = ModelSpec(
    name="tiny",
    image_size=16,
    views=FRAMES,
    fov_deg=33.8,
    latent_scale=0.5,
    sigma_max=80.0,
    steps=4,
    guidance_max=2.5,
    unet={
        "in_channels": 5 * GROUP_CHANNELS,
        "out_channels": 4 * GROUP_CHANNELS,
        "block_out_channels": [64, 64],
        "num_attention_heads": [2, 4],
        "layers_per_block": 1,
        "cross_attention_dim": 16,
        "addition_time_embed_dim": 8,
        "attention": [True, False],
    },
    autoencoder={
        "block_out_channels": [32, 32],
        "down_block_types": ["DownEncoderBlock2D"] * 2,
        "up_block_types": ["UpDecoderBlock2D"] * 2,
        "latent_channels": GROUP_CHANNELS,
        "layers_per_block": 1,
        "sample_size": 16,
    },
    image_encoder={
        "hidden_size": 16,
        "intermediate_size": 32,
        "num_hidden_layers": 1,
        "num_attention_heads": 2,
        "projection_dim": 16,
        "image_size": 8,
        "patch_size": 4,
        "hidden_act": "gelu",
    },
)


def stir(network: torch.nn.Module, generator: torch.Generator) -> None:
    """Move every weight: fresh biases are 0 and fresh norms 1, which would hide mistakes."""
    for weight in network.parameters():
        with torch.no_grad():
            weight += 0.1 * torch.randn(weight.shape, generator=generator)


def tiny_unet(**changed) -> MaterialVideoUNet:
    """A UNet with fixed random weights."""
    with torch.random.fork_rng():
        torch.manual_seed(0)
        unet = MaterialVideoUNet(**(SPEC.unet | changed)).eval().requires_grad_(False)
    stir(unet, torch.Generator().manual_seed(1))
    return unet


# The same with an expectation, which its network sees as well.
EXPECTING = replace(
    SPEC,
    unet=SPEC.unet | {"in_channels": 9 * GROUP_CHANNELS},
    expectation={"width": 16, "layers": 1, "heads": 2, "harmonics": 2},
    residual_scale=0.6,
)


def tiny_model(spec: ModelSpec = SPEC) -> MaterialDiffusion:
    """A whole generator with fixed random weights."""
    with torch.random.fork_rng():
        torch.manual_seed(0)
        model = MaterialDiffusion.untrained(spec)
    for part in model.parts.values():
        stir(part.eval().requires_grad_(False), torch.Generator().manual_seed(1))
    return model


def some_conditioning(clips: int = 1, seed: int = 0) -> Conditioning:
    """Another token, latent and orbit for each clip."""
    generator = torch.Generator().manual_seed(seed)
    azimuth = 360.0 * torch.arange(1, FRAMES + 1) / FRAMES
    elevation = 20.0 * torch.randn(clips, 1, generator=generator).expand(-1, FRAMES)
    return Conditioning(
        token=torch.randn(clips, 1, 16, generator=generator),
        latent=torch.randn(clips, GROUP_CHANNELS, SIDE, SIDE, generator=generator),
        camera=camera_numbers(elevation, azimuth.expand(clips, -1), 1e-5),
        picture=torch.rand(clips, 3, SIDE, SIDE, generator=generator),
    )


def some_latents(clips: int = 1, seed: int = 0) -> torch.Tensor:
    """Noisy latents of all groups."""
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(clips, FRAMES, 4 * GROUP_CHANNELS, SIDE, SIDE, generator=generator)
