"""Fit the direction and the width of the lobe that stands for a specular lobe in the split sum.

    python benchmarks/fit_bend.py [--data FOLDER] [--chart FILE]

`--data` (default: the environment variable SVIM3D_DATA) holds `hdri/*.exr`. Prints the held-out
errors, then the table `BEND` of svim3d/shading/dominant_lobe.py.

The mean over all rotations of an environment of the squared difference between two lobes' answers
depends on the environment's angular power spectrum C_l alone:

    E = sum_l C_l (|t_l|^2 - 2 z_l t_l(d) + (2 l + 1)/(4 pi) z_l^2),

where t_l is band l of the true lobe, z_l the Legendre moment of the round lobe about d. So a cell
of the table is the minimum of an exact error, with neither noise nor lookups. Every second
environment in the order of the alphabet is held out, and two of the synthetic ones.
"""

import argparse
import functools
import math
import os
import sys
from collections.abc import Callable
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import torch
from torch import Tensor

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from svim3d.io.exr import read_rgb  # noqa: E402
from svim3d.numerics import dot, normalize, reflect  # noqa: E402
from svim3d.shading.environment import octahedral_from_latlong, physical_radiance  # noqa: E402
from svim3d.shading.microfacet import (  # noqa: E402
    sample_visible_normal,
    schlick_weight,
    smith_lambda,
)
from svim3d.shading.octahedral import DOUBLE, texel_directions, texel_solid_angles  # noqa: E402

SIZE = 32  # of the environments: 3.6 degrees per texel
BANDS = 48
BINS = 1 << 12  # of the angle between two texels
AZIMUTHS, ELEVATIONS = 24, 24  # samples of a lobe
CELLS = 9  # per side of the table
SHARES = torch.linspace(0.0, 1.0, 101, dtype=torch.float64)
WIDTHS = (0.6, 0.7, 0.8, 0.85, 0.9, 0.95, 1.0)  # of the stand-in, over the material's roughness
MIN_N_DOT_V = 0.02
F0S = (1.0, 0.04)
SMOOTHING = 1e-3  # pull towards r^3 where the error hardly depends on the share


def legendre(cosine: Tensor) -> Tensor:
    """P_0 .. P_(BANDS - 1), along a new first axis."""
    values = [torch.ones_like(cosine), cosine]
    for n in range(1, BANDS - 1):
        values.append(((2 * n + 1) * cosine * values[n] - n * values[n - 1]) / (n + 1))
    return torch.stack(values)


BIN_LEGENDRE = legendre(((torch.arange(BINS, dtype=torch.float64) + 0.5) * (math.pi / BINS)).cos())


def bins_of(cosines: Tensor) -> Tensor:
    """Bin of each angle."""
    angle = torch.acos(cosines.clamp(-1.0, 1.0))
    return (angle * (BINS / math.pi)).long().clamp_max(BINS - 1)


def power_spectrum(radiance: Tensor, bins: Tensor) -> Tensor:
    """C_l of an octahedral map, its mean over channels, scaled to variance one."""
    energy = (radiance.double() * texel_solid_angles(SIZE, DOUBLE)[..., None]).view(-1, 3)
    histogram = torch.bincount(bins.view(-1), (energy @ energy.T).view(-1), BINS)
    spectrum = BIN_LEGENDRE @ histogram / (4.0 * math.pi)
    degree = 2.0 * torch.arange(BANDS, dtype=torch.float64) + 1.0
    variance = (spectrum * degree)[1:].sum()
    spectrum[0] = 0.0  # both lobes are normalised
    return spectrum / variance


def environments(folder: Path) -> dict[str, Tensor]:
    """All HDRIs, and four synthetic lights: a soft lamp, a sun, a checkerboard, pink noise."""
    maps = {}
    for file in sorted((folder / "hdri").glob("*.exr")):
        latlong = physical_radiance(torch.from_numpy(read_rgb(file)).float())[0]
        maps[file.stem] = octahedral_from_latlong(latlong, SIZE)
    d = texel_directions(SIZE, DOUBLE)
    lamp = d @ normalize(torch.tensor([0.5, 0.6, 0.6], dtype=torch.float64)) - 1.0
    checks = ((d * 3.0).floor().sum(-1) % 2.0)[..., None].expand(-1, -1, 3)
    maps["~soft lamp"] = (0.3 + 4.0 * torch.exp(6.0 * lamp))[..., None].expand(-1, -1, 3)
    maps["~checks"] = checks
    maps["~sun"] = (0.3 + 400.0 * torch.exp(800.0 * lamp))[..., None].expand(-1, -1, 3)
    maps["~window"] = (0.2 + 5.0 * (d[..., :1] > 0.8)).expand(-1, -1, 3)
    return maps


class Cell:
    """The true lobes of one roughness and n.v, and the error of any stand-in."""

    def __init__(self, roughness: float, n_dot_v: float) -> None:
        azimuth = (torch.arange(AZIMUTHS, dtype=torch.float64) + 0.5) / AZIMUTHS
        fraction = (torch.arange(ELEVATIONS, dtype=torch.float64) + 0.5) / ELEVATIONS
        jacobian = (2.0 * (1.0 - fraction)).repeat(AZIMUTHS)[:, None]
        u = torch.stack(
            torch.meshgrid(azimuth, 1.0 - (1.0 - fraction) ** 2, indexing="ij"), -1
        ).view(-1, 2)
        self.roughness, self.n_dot_v = roughness, n_dot_v
        self.wo = torch.tensor([math.sqrt(1.0 - n_dot_v**2), 0.0, n_dot_v], dtype=torch.float64)
        wo = self.wo.expand(len(u), 3)
        alpha = torch.full((len(u), 1), roughness**2, dtype=torch.float64)
        wh = sample_visible_normal(wo, alpha, u)
        wi = reflect(wo, wh)
        visible, lit = smith_lambda(wo[:, 2:], alpha), smith_lambda(wi[:, 2:], alpha)
        weight = jacobian * (1.0 + visible) / (1.0 + visible + lit) * (wi[:, 2:] > 0)
        fresnel = schlick_weight(dot(wo, wh))
        self.wi = wi
        weights = [weight * (f0 + (1.0 - f0) * fresnel) for f0 in F0S]
        self.weights = torch.cat([w / w.sum() for w in weights], 1)
        degree = (2.0 * torch.arange(BANDS, dtype=torch.float64) + 1.0) / (4.0 * math.pi)
        self.degree = degree
        # |t_l|^2 from pairs of samples, and t_l(d) for every share.
        bins = bins_of(wi @ wi.T).view(-1)
        pairs = torch.stack(
            [torch.bincount(bins, (w[:, None] * w).view(-1), BINS) for w in self.weights.T]
        )
        pairs = pairs @ BIN_LEGENDRE.T
        self.norm = pairs * degree
        normal = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
        mirror = 2.0 * n_dot_v * normal - self.wo
        axes = normalize(mirror + SHARES[:, None] * (normal - mirror))
        self.along = torch.einsum("lsi,if->fsl", legendre(axes @ wi.T), self.weights) * degree

    def error(self, spectrum: Tensor, width: float = 1.0) -> Tensor:
        """Squared error per share, mean over F0, over that of no light direction at all."""
        moments = round_moments(self.roughness * width)
        error = self.norm[:, None] - 2.0 * moments * self.along + self.degree * moments**2
        relative = (error @ spectrum) / (self.norm @ spectrum)[:, None]
        return relative.mean(0)


@functools.lru_cache(maxsize=256)
def round_moments(roughness: float) -> Tensor:
    """Legendre moments of the lobe of view = normal, light weighted by its cosine."""
    angle = (torch.arange(8192, dtype=torch.float64) + 0.5) * (0.5 * math.pi / 8192)
    # Fine steps near the axis, where a narrow lobe lies.
    angle = angle * angle / (0.5 * math.pi)
    cosine, half_squared = angle.cos(), 0.5 * (1.0 + angle.cos())
    spread = roughness**4 * half_squared + 1.0 - half_squared
    weight = cosine * angle.sin() / spread**2 * angle.sqrt()
    return legendre(cosine) @ (weight / weight.sum())


def frostbite_share(roughness: float) -> float:
    """Source: Lagarde and de Rousiers 2014, "Moving Frostbite to PBR", listing 22."""
    alpha = roughness * roughness
    return 1.0 - (1.0 - alpha) * (math.sqrt(1.0 - alpha) + alpha)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=os.environ.get("SVIM3D_DATA"))
    parser.add_argument("--chart", type=Path, default=ROOT / "benchmarks/results/bend.png")
    arguments = parser.parse_args()
    if arguments.data is None:
        parser.error("--data is needed: no SVIM3D_DATA is set")
    directions = texel_directions(SIZE, DOUBLE).view(-1, 3)
    lights, bins = environments(Path(arguments.data)), bins_of(directions @ directions.T)
    spectra = {name: power_spectrum(light, bins) for name, light in lights.items()}
    names = list(spectra)
    fitted = torch.stack([spectra[n] for n in names[::2]]).mean(0)
    held_out = torch.stack([spectra[n] for n in names[1::2]]).mean(0)
    axis = [i / (CELLS - 1) for i in range(CELLS)]
    columns = [max(root * root, MIN_N_DOT_V) for root in axis]
    cells = [[Cell(r, v) for v in columns] for r in axis[1:]]
    bend = [[0.0] * CELLS] + [[fit_share(c, fitted) for c in row] for row in cells]
    for shares in bend:
        shares[-1] = shares[-2]  # seen from above, mirror and normal coincide and nothing is fitted
    report(cells, bend, fitted, held_out)
    for row in bend:
        print("    (" + ", ".join(f"{b:.2f}" for b in row) + "),")
    draw(bend, axis, arguments.chart)


def fit_share(cell: Cell, spectrum: Tensor) -> float:
    """The best share; r^3 where it does not matter, as at normal incidence."""
    penalty = SMOOTHING * (SHARES - cell.roughness**3) ** 2
    return float(SHARES[(cell.error(spectrum) + penalty).argmin()])


def report(cells: list[list[Cell]], bend: list[list[float]], fitted: Tensor, held: Tensor) -> None:
    """Root mean squared relative error on held-out lights, all cells alike."""

    def at(share: float) -> int:
        return round(share * (len(SHARES) - 1))

    rules: dict[str, Callable[[Cell, float], float]] = {
        "unbent": lambda cell, _: 0.0,
        "Frostbite": lambda cell, _: frostbite_share(cell.roughness),
        "r^3": lambda cell, _: cell.roughness**3,
        "table": lambda _, share: share,
    }
    print("held-out relative RMS error by roughness, mean over n.v")
    print("rule            " + "".join(f"{row[0].roughness:8.3f}" for row in cells) + "    mean")
    for name, rule in rules.items():
        means = [
            sum(float(c.error(held)[at(rule(c, s))]) for c, s in zip(row, shares, strict=True))
            / CELLS
            for row, shares in zip(cells, bend[1:], strict=True)
        ]
        line(name, means)
    best = []
    widths = []
    for row in cells:
        total, chosen = 0.0, []
        for c in row:
            fits = torch.stack([c.error(fitted, w) for w in WIDTHS])
            index = int(fits.argmin())
            w, s = divmod(index, len(SHARES))
            total += float(c.error(held, WIDTHS[w])[s])
            chosen.append(WIDTHS[w])
        best.append(total / CELLS)
        widths.append(chosen)
    line("table + width", best)
    print("widths", *widths, sep="\n")


def line(name: str, means: list[float]) -> None:
    """One row of the report."""
    roots = [math.sqrt(max(m, 0.0)) for m in means]
    print(f"{name:16}" + "".join(f"{r:8.3f}" for r in roots) + f"{sum(roots) / len(roots):8.3f}")


def draw(bend: list[list[float]], axis: list[float], file: Path) -> None:
    """The table, one curve per roughness, with r^3 beside it."""
    figure, panel = plt.subplots(figsize=(6, 4))
    for r, row in zip(axis, bend, strict=True):
        (curve,) = panel.plot([x * x for x in axis], row, marker=".", label=f"r = {r:.3f}")
        panel.axhline(r**3, color=curve.get_color(), linewidth=0.5, linestyle=":")
    panel.set(xlabel="n.v", ylabel="bend share (dotted: r^3)")
    panel.legend(fontsize=7)
    figure.tight_layout()
    file.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(file, dpi=90)


if __name__ == "__main__":
    main()
