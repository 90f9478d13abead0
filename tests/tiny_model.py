"""The smallest model that has every part: 16 px pictures, five views, random weights."""

from dataclasses import replace
from pathlib import Path

import torch

from svim3d.diffusion.model import MaterialDiffusion, ModelSpec
from svim3d.io.model_folder import write_model

TINY = ModelSpec(
    name="tiny",
    image_size=16,
    views=5,
    fov_deg=33.8,
    latent_scale=1.0,
    sigma_max=80.0,
    steps=4,
    guidance_max=1.5,
    unet={
        "in_channels": 10,
        "out_channels": 8,
        "block_out_channels": [32, 32],
        "num_attention_heads": [2, 2],
        "layers_per_block": 1,
        "cross_attention_dim": 16,
        "addition_time_embed_dim": 8,
        "attention": [True, True],
    },
    autoencoder={
        "block_out_channels": [8, 8, 8],
        "down_block_types": ["DownEncoderBlock2D"] * 3,
        "up_block_types": ["UpDecoderBlock2D"] * 3,
        "latent_channels": 2,
        "layers_per_block": 1,
        "norm_num_groups": 4,
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


# The same with an expectation, which its network sees as well.
EXPECTING = replace(
    TINY,
    unet=TINY.unet | {"in_channels": 18},
    expectation={"width": 16, "layers": 1, "heads": 2, "harmonics": 2},
)


def tiny_model(spec: ModelSpec = TINY, seed: int = 0) -> MaterialDiffusion:
    """Random weights, a function of the seed."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        model = MaterialDiffusion.untrained(spec)
    for part in model.parts.values():
        part.eval()
    return model


def write_tiny_model(folder: Path, seed: int = 0) -> Path:
    """The same as a folder; returns it."""
    write_model(folder, tiny_model(seed=seed), "A model for tests.\n")
    return folder
