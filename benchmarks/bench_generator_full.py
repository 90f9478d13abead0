"""The full-size generator: 21 views at 576 x 576, seconds and memory beside the arithmetic limit.

    python benchmarks/bench_generator_full.py [--peak-tflops 989] [--steps 10 20 25 50]
        [--repeats 3] [--without-compile] [--picture FILE]

Counts products of the full-size networks on the meta device, then, on a CUDA device, times them
with random bfloat16 weights: first one guided step by the plain network (diffusers' blocks, one
call for each branch of guidance: the baseline) and with one speed-up more on each row, then whole
orbits, decoding included, for several numbers of steps and intervals of guidance. The limit is
the count over the card's dense bfloat16 peak; the paper states about 20 s for 50 steps.

Without a CUDA device it says so and tries the same code on the CPU, at a fifth of the width and
8 x 8 latents; those seconds say nothing about the full size.
"""

import argparse
import json
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import torch
from torch.utils.flop_counter import FlopCounterMode

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from benchmarks.generator_case import (  # noqa: E402
    REDUCED,
    medians,
    plain_denoiser,
    random_model,
    seconds,
    some_conditioning,
)
from svim3d.diffusion.conditioning import Conditioning  # noqa: E402
from svim3d.diffusion.guidance import GuidanceInterval  # noqa: E402
from svim3d.diffusion.model import PAPER, MaterialDiffusion, ModelSpec, Sampling  # noqa: E402
from svim3d.diffusion.prepared import PreparedUNet  # noqa: E402

PAPER_SECONDS = 20.0  # of 50 steps with guidance, on hardware it does not name exactly
PAPER_STEPS = 50
SPECIFIED = {"plain step": 34.59, "decode": 3.19}  # TFLOP of a clip, and of one picture
LEVEL = 1.0  # noise level of a single step: guidance acts there in every interval
# Kynkaanniemi et al. 2024, for EDM2 at 512 pixels, and one that only leaves the ends out.
INTERVALS = {
    "always": GuidanceInterval(),
    "0.28 < sigma <= 80": GuidanceInterval(0.28, 80.0),
    "0.28 < sigma <= 5.42": GuidanceInterval(0.28, 5.42),
}


def count(run: Callable[[], object]) -> float:
    """TFLOP of matrix products, convolutions and attention; two for each multiply-add."""
    with FlopCounterMode(display=False) as counter:
        run()
    return counter.get_total_flops() / 1e12


@torch.no_grad()
def full_size_tflop() -> dict[str, float]:
    """Of one clip through the UNet, and one picture through the decoder, at full size."""
    meta = torch.device("meta")
    model = random_model(PAPER, meta, torch.bfloat16)
    side, channels = PAPER.latent_side, PAPER.latent_channels
    half = {"dtype": torch.bfloat16, "device": meta}
    told = Conditioning(
        token=torch.zeros(1, 1, 1024, **half),
        latent=torch.zeros(1, channels, side, side, **half),
        camera=torch.zeros(1, PAPER.views, 3, device=meta),
    )
    noisy = torch.zeros(1, PAPER.views, 4 * channels, side, side, **half)
    level = torch.zeros(1, device=meta)
    prepared = PreparedUNet(model.unet)
    bound, both = prepared.bind(told), prepared.bind(told.beside_unconditional())
    latent = torch.zeros(1, channels, side, side, **half)
    return {
        "plain step": count(lambda: model.unet(told.beside(noisy), level, told.token, told.camera)),
        "prepared step": count(lambda: prepared(noisy, level, bound)),
        "prepared guided step": count(lambda: prepared(noisy, level, both)),
        "decode": count(lambda: model.autoencoder.decode(latent)),
    }


def tell_counts(tflop: dict[str, float], peak: float) -> dict[str, float]:
    """Print the counts; the limit in seconds of 50 guided steps with decoding, both networks."""
    pictures = PAPER.views * len(PAPER.groups)
    decode = pictures * tflop["decode"]
    totals = {
        "plain": PAPER_STEPS * 2 * tflop["plain step"] + decode,
        "prepared": PAPER_STEPS * tflop["prepared guided step"] + decode,
    }
    for name, value in tflop.items():
        known = f"   (specification: {SPECIFIED[name]})" if name in SPECIFIED else ""
        print(f"{name:22}{value:9.3f} TFLOP{known}")
    for name, value in totals.items():
        print(
            f"{name:10} 50 guided steps, {pictures} pictures decoded ({decode:.0f}): {value:.0f}",
            end="",
        )
        print(f" TFLOP, at {peak:.0f} TFLOP/s {value / peak:.2f} s")
    return {name: value / peak for name, value in totals.items()}


def channels_last(model: MaterialDiffusion) -> None:
    """Convolution weights as fast kernels want them, names and values unchanged."""
    for part in (model.unet, model.autoencoder):
        for layer in part.modules():
            if isinstance(layer, torch.nn.Conv2d):
                layer.weight.data = layer.weight.data.contiguous(memory_format=torch.channels_last)


def ladder(
    model: MaterialDiffusion, told: Conditioning, repeats: int, compiled: bool
) -> dict[str, dict[str, float]]:
    """One guided step, each row with one speed-up more."""
    sampling = Sampling()
    spec = model.spec
    shape = (1, spec.views, 4 * spec.latent_channels, spec.latent_side, spec.latent_side)
    noisy = torch.randn(shape, device=model.device)
    rows: dict[str, dict[str, float]] = {}
    reference: torch.Tensor | None = None
    kinds: dict[str, Callable[[], Any]] = {
        "plain, two calls": lambda: plain_denoiser(model, told, sampling, together=False),
        "plain, one call": lambda: plain_denoiser(model, told, sampling, together=True),
        "prepared": lambda: model.denoiser(told, sampling),
        "prepared, weights channels last": lambda: model.denoiser(told, sampling),
    }
    if compiled:
        kinds["prepared, compiled"] = lambda: model.denoiser(told, replace(sampling, compiled=True))
    for name, make in kinds.items():
        if "channels last" in name:
            channels_last(model)
        denoise = make()
        with torch.no_grad():
            answer = denoise(noisy, LEVEL)  # also sets kernels up, or compiles
            forget_peak(model.device)
            found = medians({name: lambda d=denoise: d(noisy, LEVEL)}, model.device, repeats)[name]
        reference = answer if reference is None else reference
        difference = float((answer - reference).square().mean().sqrt() / reference.std())
        rows[name] = {"seconds": found, "gib": peak_gib(model.device), "difference": difference}
        print(f"{name:34}{found:9.4f} s{rows[name]['gib']:8.2f} GiB{difference:11.1e}", flush=True)
    return rows


def forget_peak(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)


def peak_gib(device: torch.device) -> float:
    """Most memory that tensors took since `forget_peak`; not known on the CPU."""
    return torch.cuda.max_memory_allocated(device) / 2**30 if device.type == "cuda" else 0.0


def orbits(
    model: MaterialDiffusion, told: Conditioning, steps: list[int], compiled: bool
) -> list[dict[str, Any]]:
    """Whole orbits, drawn and decoded."""
    rows = []
    for name, interval in INTERVALS.items():
        for number in steps:
            sampling = Sampling(steps=number, interval=interval, compiled=compiled)
            levels = model.noise_levels(sampling)[:-1].tolist()
            calls = number + sum(interval.holds(sigma) for sigma in levels)
            forget_peak(model.device)
            kept: list[torch.Tensor] = []
            drawn = seconds(
                lambda s=sampling, k=kept: k.append(model.draw(told, 0, s)), model.device
            )
            decoded = seconds(lambda s=sampling, k=kept: model.decode(k[0], s), model.device)
            row = {
                "guidance": name,
                "steps": number,
                "network_clips": calls,
                "draw_s": drawn,
                "decode_s": decoded,
                "gib": peak_gib(model.device),
            }
            rows.append(row)
            print(
                f"{name:22}{number:6}{calls:7}{drawn:10.2f}{decoded:10.2f}{drawn + decoded:10.2f}"
                f"{row['gib']:9.2f}",
                flush=True,
            )
    return rows


def draw_chart(result: dict[str, Any], file: Path) -> None:
    """Left a guided step by speed-up, right whole orbits by steps, beside limit and paper."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(12, 4.2))
    names = list(result["ladder"])
    left.barh(names[::-1], [result["ladder"][name]["seconds"] for name in names[::-1]])
    left.set(xlabel="seconds of a guided step", title=result["device"])
    for guidance in INTERVALS:
        rows = [row for row in result["orbits"] if row["guidance"] == guidance]
        times = [row["draw_s"] + row["decode_s"] for row in rows]
        right.plot([row["steps"] for row in rows], times, marker="o", label=f"guided {guidance}")
    if result["full_size"]:
        right.plot(PAPER_STEPS, PAPER_SECONDS, "k*", markersize=12, label="paper, about 20 s")
        right.plot(
            PAPER_STEPS, result["limit_s"]["prepared"], "kv", label="limit at the card's peak"
        )
    right.set(xlabel="steps", ylabel="seconds of an orbit, decoded")
    right.set_ylim(bottom=0.0)
    right.grid(alpha=0.3)
    right.legend(fontsize=8)
    figure.tight_layout()
    figure.savefig(file, dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--peak-tflops", type=float, default=989.0, help="dense bfloat16; H100 SXM")
    parser.add_argument("--steps", nargs="+", type=int, default=None)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--without-compile", action="store_true")
    default = ROOT / "benchmarks/results/generator_full.png"
    parser.add_argument("--picture", type=Path, default=default)
    arguments = parser.parse_args()
    tflop = full_size_tflop()
    limit = tell_counts(tflop, arguments.peak_tflops)
    on_gpu = torch.cuda.is_available()
    device = torch.device("cuda" if on_gpu else "cpu")
    spec: ModelSpec = PAPER if on_gpu else REDUCED
    name = torch.cuda.get_device_name() if on_gpu else f"CPU, dry run at {spec.name}"
    if not on_gpu:
        print("no CUDA device: a dry run at a fifth of the width; not the full model's times")
    steps = arguments.steps or ([10, 20, 25, 50] if on_gpu else [1, 2])
    # Compiling takes minutes on a CPU and gains little there.
    compiled = on_gpu and not arguments.without_compile
    torch.manual_seed(0)
    model = random_model(spec, device, torch.bfloat16 if on_gpu else torch.float32)
    told = some_conditioning(model)
    print(f"\n{name}: one guided step           seconds  peak memory  difference")
    rungs = ladder(model, told, arguments.repeats, compiled)
    print("\nguidance               steps  clips    draw s  decode s     all s      GiB")
    rows = orbits(model, told, steps, compiled)
    result = {
        "device": name,
        "full_size": on_gpu,
        "tflop": tflop,
        "limit_s": limit,
        "ladder": rungs,
        "orbits": rows,
    }
    arguments.picture.parent.mkdir(parents=True, exist_ok=True)
    draw_chart(result, arguments.picture)
    arguments.picture.with_suffix(".json").write_text(json.dumps(result, indent=2))
    print(f"picture: {arguments.picture}")


if __name__ == "__main__":
    main()
