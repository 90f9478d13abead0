"""What the generator's benchmarks share: networks with random weights, plain twins, timing.

Random weights give the same times as trained ones: nothing in the network depends on values.
"""

import statistics
import time
from collections.abc import Callable
from dataclasses import replace

import torch

from svim3d.cameras import CameraPath
from svim3d.diffusion.conditioning import Conditioning
from svim3d.diffusion.guidance import guide
from svim3d.diffusion.model import PAPER, MaterialDiffusion, ModelSpec, Sampling
from svim3d.diffusion.sampler import Denoiser

VAE = {"layers_per_block": 1, "latent_channels": 16, "sample_size": 64}

# The shape of the bundled model's UNet; its autoencoder stands in for the real one.
SMALL = ModelSpec(
    name="small",
    image_size=64,
    views=21,
    fov_deg=33.8,
    latent_scale=1.0,
    sigma_max=700.0,
    steps=50,
    guidance_max=2.5,
    unet={
        "in_channels": 80,
        "out_channels": 64,
        "block_out_channels": [96, 192],
        "num_attention_heads": [3, 6],
        "layers_per_block": 1,
        "cross_attention_dim": 128,
        "addition_time_embed_dim": 64,
        "attention": [True, True],
    },
    autoencoder={
        "block_out_channels": [32, 64, 128, 128],
        "down_block_types": ["DownEncoderBlock2D"] * 4,
        "up_block_types": ["UpDecoderBlock2D"] * 4,
        **VAE,
    },
    image_encoder={
        "hidden_size": 128,
        "intermediate_size": 512,
        "num_hidden_layers": 2,
        "num_attention_heads": 4,
        "projection_dim": 128,
        "image_size": 64,
        "patch_size": 8,
        "hidden_act": "gelu",
    },
)

# The paper's model at a fifth of its width and 8 x 8 latents, to try the code without a GPU.
REDUCED = replace(
    PAPER,
    name="a fifth of the paper's width",
    image_size=64,
    unet=PAPER.unet
    | {"block_out_channels": [64, 128, 256, 256], "num_attention_heads": [1, 2, 4, 4]},
    autoencoder=PAPER.autoencoder | {"block_out_channels": [32, 64, 128, 128], "sample_size": 64},
    image_encoder=SMALL.image_encoder | {"projection_dim": 1024},
)


def random_model(spec: ModelSpec, device: torch.device, dtype: torch.dtype) -> MaterialDiffusion:
    """A generator with random weights of one precision."""
    with device:
        model = MaterialDiffusion.untrained(spec)
    for part in model.parts.values():
        part.eval().requires_grad_(False)
        for weight in part.parameters():
            weight.data = weight.data.to(dtype)
    return model


def some_conditioning(model: MaterialDiffusion) -> Conditioning:
    """Of a grey picture, on a static orbit."""
    side = model.spec.image_size
    path = CameraPath.orbit(model.spec.views, 10.0)
    return model.condition(torch.full((side, side, 3), 0.5), *path.tensors())


def plain_denoiser(
    model: MaterialDiffusion, told: Conditioning, sampling: Sampling, *, together: bool
) -> Denoiser:
    """The twin of `MaterialDiffusion.denoiser`: stock blocks, in one call or in two."""
    weights = model.guidance(told, sampling).to(model.device)
    guides = bool((weights != 1.0).any())
    both, nothing = told.beside_unconditional(), told.dropped(torch.ones(1, device=model.device))

    def denoise(noisy: torch.Tensor, sigma: float) -> torch.Tensor:
        if not (guides and sampling.interval.holds(sigma)):
            return model.denoise(noisy, sigma, told)
        if together:
            without, given = model.denoise(torch.cat([noisy, noisy]), sigma, both).chunk(2)
        else:
            without, given = (model.denoise(noisy, sigma, one) for one in (nothing, told))
        return guide(without, given, weights)

    return denoise


def seconds(run: Callable[[], object], device: torch.device) -> float:
    """CPU seconds of a call on the CPU, wall seconds until a CUDA device is done."""
    if device.type == "cpu":
        started = time.process_time()
        run()
        return time.process_time() - started
    torch.cuda.synchronize(device)
    started = time.perf_counter()
    run()
    torch.cuda.synchronize(device)
    return time.perf_counter() - started


def medians(
    runs: dict[str, Callable[[], object]], device: torch.device, repeats: int
) -> dict[str, float]:
    """Median seconds of each call, all called in turn."""
    found: dict[str, list[float]] = {name: [] for name in runs}
    for _ in range(repeats):
        for name, run in runs.items():
            found[name].append(seconds(run, device))
    return {name: statistics.median(times) for name, times in found.items()}
