"""What the generator's benchmarks share: networks with random weights, plain twins, timing.

Random weights give the same times as trained ones: nothing in the network depends on values.
"""

import statistics
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import torch

from svim3d.cameras import CameraPath
from svim3d.diffusion.conditioning import Conditioning
from svim3d.diffusion.guidance import guide
from svim3d.diffusion.model import PAPER, MaterialDiffusion, ModelSpec, Sampling
from svim3d.diffusion.sampler import Denoiser
from svim3d.io.model_folder import read_spec

SMALL = read_spec(Path(__file__).resolve().parents[1] / "configs", "svim3d-small.json")

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
