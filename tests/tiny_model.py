"""A generator of the real classes, tiny and untrained: 16 px pictures, 5 views."""

from pathlib import Path

import torch

from svim3d.diffusion.model import MaterialDiffusion, ModelSpec
from svim3d.io.model_folder import write_model

SPEC = ModelSpec(
    name="tiny",
    image_size=16,
    views=5,
    fov_deg=33.8,
    latent_scale=1.0,
    sigma_max=20.0,
    steps=2,
    guidance_max=2.0,
    unet={
        "in_channels": 20,
        "out_channels": 16,
        "block_out_channels": [32, 32],
        "num_attention_heads": [2, 2],
        "layers_per_block": 1,
        "cross_attention_dim": 16,
        "addition_time_embed_dim": 8,
        "attention": [True, False],
    },
    autoencoder={
        "block_out_channels": [32, 32],
        "down_block_types": ["DownEncoderBlock2D"] * 2,
        "up_block_types": ["UpDecoderBlock2D"] * 2,
        "latent_channels": 4,
        "layers_per_block": 1,
        "sample_size": 16,
    },
    image_encoder={
        "hidden_size": 16,
        "intermediate_size": 32,
        "num_hidden_layers": 1,
        "num_attention_heads": 2,
        "projection_dim": 16,
        "image_size": 16,
        "patch_size": 8,
        "hidden_act": "gelu",
    },
)


def tiny_model(seed: int = 0) -> MaterialDiffusion:
    """Random weights; the caller's random numbers stay as they were."""
    with torch.random.fork_rng():
        torch.random.manual_seed(seed)
        model = MaterialDiffusion.untrained(SPEC)
    for network in model.parts.values():
        network.eval().requires_grad_(False)
    return model


def write_tiny_model(folder: Path, seed: int = 0) -> Path:
    write_model(folder, tiny_model(seed), "A model for tests.\n")
    return folder
