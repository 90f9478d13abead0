"""Seconds of one orbit of the bundled size of model on the CPU, against the number of steps.

    python benchmarks/bench_generator_speed.py [--steps 1 2 4 8 16 25 50] [--repeats 3]
        [--picture FILE]

The baseline is the plain network, diffusers' blocks called once for both branches of guidance,
as Stable Video Diffusion's pipeline does; beside it the prepared network that `draw` uses. Both
walk the same steps in turn, in CPU seconds, medians; their latents are compared. Weights are
random: times do not depend on them. What it costs to condition and to decode is told apart, with
an autoencoder that stands in for the real one.
"""

import argparse
import json
import sys
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import torch

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from benchmarks.generator_case import (  # noqa: E402
    SMALL,
    medians,
    plain_denoiser,
    random_model,
    seconds,
    some_conditioning,
)
from svim3d.diffusion.conditioning import Conditioning  # noqa: E402
from svim3d.diffusion.model import MaterialDiffusion, Sampling  # noqa: E402
from svim3d.diffusion.sampler import sample, seeded_noise  # noqa: E402

CPU = torch.device("cpu")
GUIDANCE = {"guided": None, "unguided": 1.0}  # the strongest weight; None is the model's own


def plain_draw(model: MaterialDiffusion, told: Conditioning, sampling: Sampling) -> torch.Tensor:
    """`MaterialDiffusion.draw` by the plain network."""
    side, frames = model.spec.latent_side, told.camera.shape[1]
    channels = model.spec.latent_channels * len(model.spec.groups)
    noise = seeded_noise((1, frames, channels, side, side), 0, device=CPU)
    denoise = plain_denoiser(model, told, sampling, together=True)
    with torch.no_grad():
        return sample(denoise, noise, model.noise_levels(sampling))[0]


def measure(
    model: MaterialDiffusion, told: Conditioning, steps: int, repeats: int
) -> dict[str, float]:
    """Seconds of all four kinds of draw, and how far both networks' latents differ."""
    row: dict[str, float] = {"steps": steps}
    for name, strongest in GUIDANCE.items():
        sampling = Sampling(steps=steps, guidance_max=strongest)
        drawn: dict[str, torch.Tensor] = {}
        times = medians(
            {
                "plain": lambda s=sampling, d=drawn: d.update(plain=plain_draw(model, told, s)),
                "prepared": lambda s=sampling, d=drawn: d.update(prepared=model.draw(told, 0, s)),
            },
            CPU,
            repeats,
        )
        row |= {f"{name} {kind}": value for kind, value in times.items()}
        difference = float((drawn["plain"] - drawn["prepared"]).abs().max())
        row[f"{name} difference"] = difference
    return row


def draw_chart(rows: list[dict[str, float]], file: Path) -> None:
    """Seconds against steps, both axes logarithmic."""
    figure, axis = plt.subplots(figsize=(6, 4))
    steps = [row["steps"] for row in rows]
    for name, color in zip(GUIDANCE, ("tab:blue", "tab:orange"), strict=True):
        for kind, line in (("plain", "--"), ("prepared", "-")):
            times = [row[f"{name} {kind}"] for row in rows]
            axis.plot(steps, times, line, color=color, marker="o", label=f"{name}, {kind}")
    axis.set(xscale="log", yscale="log", xlabel="steps", ylabel="CPU seconds of one orbit")
    axis.set_xticks(steps, [str(int(step)) for step in steps], minor=False)
    axis.grid(alpha=0.3)
    axis.legend()
    figure.tight_layout()
    figure.savefig(file, dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", nargs="+", type=int, default=[1, 2, 4, 8, 16, 25, 50])
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument(
        "--picture", type=Path, default=ROOT / "benchmarks/results/generator_speed.png"
    )
    arguments = parser.parse_args()
    torch.manual_seed(0)
    model = random_model(SMALL, CPU, torch.float32)
    told = some_conditioning(model)
    plain_draw(model, told, Sampling(steps=1))  # the first call sets libraries up
    print("CPU seconds     guided                     unguided               largest")
    print("steps      plain  prepared  ratio      plain  prepared  ratio   difference")
    rows = []
    for steps in arguments.steps:
        row = measure(model, told, steps, arguments.repeats)
        rows.append(row)
        cells = "     ".join(
            f"{row[f'{name} plain']:6.2f}{row[f'{name} prepared']:10.2f}"
            f"{row[f'{name} plain'] / row[f'{name} prepared']:7.2f}"
            for name in GUIDANCE
        )
        worst = max(row[f"{name} difference"] for name in GUIDANCE)
        print(f"{steps:5}     {cells}   {worst:10.1e}", flush=True)
    latents = model.draw(told, 0, Sampling(steps=1))
    conditioning = seconds(lambda: some_conditioning(model), CPU)
    decoding = seconds(lambda: model.decode(latents), CPU)
    print(f"conditioning {conditioning:.2f} s, decoding 84 pictures {decoding:.2f} s (stand-in)")
    arguments.picture.parent.mkdir(parents=True, exist_ok=True)
    draw_chart(rows, arguments.picture)
    facts = {"threads": torch.get_num_threads(), "repeats": arguments.repeats, "rows": rows}
    arguments.picture.with_suffix(".json").write_text(json.dumps(facts, indent=2))
    print(f"picture: {arguments.picture}")


if __name__ == "__main__":
    main()
