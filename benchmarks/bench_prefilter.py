"""Error of the environment prefilter against brute force, and what it costs: tables and a chart.

    python benchmarks/bench_prefilter.py --data FOLDER [--maps sky studio venice]
        [--picture FILE] [--size 128] [--relight-size 256]

`--data` (default: the environment variable SVIM3D_DATA) holds `hdri/<map>.exr`. Named baseline: the
paper's importance samples as eager torch, "paper eager": gathers in a loop over samples, with the
lookups worked out at every step. Everything else is a stored operator, or says what it is.

Per roughness, each method filters one level; the paper's has the side and count of its level at or
next above that roughness. Milliseconds are CPU time of forward and backward of that level on one
thread, without the mips, which all share. Errors are root mean squares over that of the truth, at
the level's texels and between them (bilinear lookup at random directions, as shading sees it, more
of them about the sun), mean over maps.
The truth takes a texel's radiance as constant and the lobe at 2^2 or 4^2 points of every texel.
"""

import argparse
import os
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numba
import numpy as np
import torch
from matplotlib.ticker import NullFormatter

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(Path(__file__).parent)]

from prefilter_baselines import (  # noqa: E402
    SG_LOBES,
    SgLight,
    ShLight,
    brute_force,
    eager_level,
    eager_mips,
    sh_basis,
)

from svim3d.io.exr import read_rgb  # noqa: E402
from svim3d.numerics import normalize  # noqa: E402
from svim3d.shading.environment import (  # noqa: E402
    octahedral_from_latlong,
    physical_radiance,
    rotate_about_y,
)
from svim3d.shading.linear_operator import SparseOperator  # noqa: E402
from svim3d.shading.lobe_quadrature import exact_rows  # noqa: E402
from svim3d.shading.lobe_sampling import ggx_lobe_samples, sampled_rows, tangent_frame  # noqa: E402
from svim3d.shading.octahedral import sample_octahedral, texel_directions  # noqa: E402
from svim3d.shading.prefilter import PyramidOperator, mip_sizes  # noqa: E402
from svim3d.shading.prefilter_spec import (  # noqa: E402
    LOD_BIAS,
    Integral,
    Level,
    PrefilterSpec,
    Samples,
)

MAPS = ("sky", "studio", "venice")  # a hard sun; lamps; an overcast sky
MORE_SAMPLES = (64, 256, 1024)
DIRECTIONS = 384  # random ones at which a level is looked up
REPEATS = 7  # the fastest counts
STYLE = {
    "paper eager": ("#7f7f7f", "X"),
    "paper stored": ("#7f7f7f", "o"),
    "64 samples": ("#6baed6", "o"),
    "256 samples": ("#3182bd", "o"),
    "1024 samples": ("#08519c", "o"),
    f"SG, {SG_LOBES} lobes": ("#2ca02c", "^"),
    "SH, order 2": ("#9467bd", "v"),
    "exact": ("#e6a400", "s"),
    "hybrid": ("#d62728", "*"),
}


@dataclass(frozen=True)
class Point:
    """One method at one roughness: milliseconds, errors per map at texels and between."""

    method: str
    milliseconds: float
    at_texels: list[float]
    between: list[float]
    l1: list[float]
    lowest: float

    @property
    def error(self) -> float:
        """Mean over maps, between texels."""
        return float(np.mean(self.between))


def cpu_ms(function: Callable[[], object], repeats: int = REPEATS) -> float:
    """CPU milliseconds of the fastest call."""
    function()
    times = []
    for _ in range(repeats):
        started = time.process_time()
        function()
        times.append(time.process_time() - started)
    return 1e3 * min(times)


def gradient_ms(function: Callable[[], torch.Tensor], repeats: int = REPEATS) -> float:
    """CPU milliseconds of forward and backward."""
    return cpu_ms(lambda: function().sum().backward(), repeats)


def relative_rms(found: torch.Tensor, truth: torch.Tensor) -> list[float]:
    """Per map; the channels of all maps lie side by side."""
    pairs = zip(found.split(3, 1), truth.split(3, 1), strict=True)
    return [float((a - b).norm() / b.norm()) for a, b in pairs]


def relative_l1(found: torch.Tensor, truth: torch.Tensor) -> list[float]:
    pairs = zip(found.split(3, 1), truth.split(3, 1), strict=True)
    return [float((a - b).abs().sum() / b.sum()) for a, b in pairs]


def level_rows(level: Level, mips: tuple[int, ...]) -> SparseOperator:
    """One level's operator."""
    if isinstance(level.filter, Integral):
        return SparseOperator(exact_rows(level.size, mips, level.roughness, level.filter.accuracy))
    count, bias = level.filter.count, level.filter.lod_bias
    return SparseOperator(sampled_rows(level.size, mips, level.roughness, count, bias))


def paper_level(spec: PrefilterSpec, roughness: float | None) -> Level:
    """The paper's level at or next above a roughness, with the lobe of that roughness."""
    *levels, irradiance = spec.levels()
    if roughness is None:
        return irradiance
    nearest = next(level for level in levels if level.roughness >= roughness)
    return Level(roughness, nearest.size, nearest.filter)


class Case:
    """The maps, their mips and the lights fitted to them."""

    def __init__(self, maps: dict[str, torch.Tensor], size: int) -> None:
        self.size, self.mips, self.maps = size, mip_sizes(size), maps
        self.all = torch.cat([*maps.values()], -1)
        pool = PyramidOperator.build(size, "exact").pool
        self.stack = pool(self.all.view(size * size, -1))
        self.directions, self.weights = torch.empty(0), torch.empty(0)
        self.gaussians = [SgLight(radiance) for radiance in maps.values()]
        self.truths: dict[tuple[float | None, int], torch.Tensor] = {}

    def look_around(self, roughness: float | None) -> None:
        """Draw the random directions of a roughness: half uniform, half about each map's sun.

        A small sun's lobe would be missed, or met by one direction, which then is the whole error.
        The weights make sums those over uniform directions.
        """
        generator = torch.Generator().manual_seed(0)
        uniform = normalize(torch.randn(DIRECTIONS // 2, 3, generator=generator))
        local, _, _ = ggx_lobe_samples(DIRECTIONS // (2 * len(self.maps)), roughness or 1.0)
        d = texel_directions(self.size).view(-1, 3)
        suns = torch.stack([d[int(m.sum(-1).argmax())] for m in self.maps.values()])
        frames = torch.stack([*tangent_frame(suns), suns], 1)
        near = torch.cat([local.float() @ frame for frame in frames])
        self.directions = torch.cat([uniform, near])
        alpha = (roughness or 1.0) ** 2
        half_squared = 0.5 * (1.0 + self.directions @ suns.T)
        spread = 1.0 - (1.0 - alpha * alpha) * half_squared
        density = alpha * alpha / (4.0 * torch.pi * spread**2)
        density[self.directions @ suns.T <= 0.0] = 0.0
        self.weights = 1.0 / (0.5 / (4.0 * torch.pi) + 0.5 * density.mean(1, keepdim=True))

    def truth(self, roughness: float | None, side: int) -> torch.Tensor:
        """At the random directions (side 0), or at the texels of a level."""
        if (roughness, side) not in self.truths:
            axes = texel_directions(side).view(-1, 3) if side else self.directions
            axes = axes[:: max(1, len(axes) // DIRECTIONS)]
            rough = 1.0 if roughness is None else roughness
            subdivision = 4 if rough < 0.2 else 2
            alpha = torch.full((len(axes), 1), rough * rough)
            self.truths[roughness, side] = brute_force(self.all, axes, alpha, subdivision)
        return self.truths[roughness, side]

    def stored(self, method: str, level: Level) -> Point:
        """A level as a stored operator."""
        operator = level_rows(level, self.mips)
        stack = self.stack[:, :3].clone().requires_grad_()
        texels = operator(self.stack)
        return self._point(method, level, texels, gradient_ms(lambda: operator(stack)))

    def eager(self, level: Level, texels_as: Point) -> Point:
        """The same samples without an operator: same errors, other time."""
        radiance = self.all[..., :3].clone().requires_grad_()
        mips = [mip.detach().requires_grad_() for mip in eager_mips(radiance, self.mips)]
        count = level.filter.count
        step = lambda: eager_level(mips, level.size, level.roughness, count)  # noqa: E731
        milliseconds = gradient_ms(step, 3)
        found = [
            eager_level(eager_mips(m, self.mips), level.size, level.roughness, count)
            for m in self.maps.values()
        ]
        point = self._point("paper eager", level, torch.cat(found, -1).detach(), milliseconds)
        # The baseline must be what the operator stores.
        assert np.allclose(point.between, texels_as.between, rtol=0.02), (point, texels_as)
        return point

    def spherical_harmonics(self, side: int) -> Point:
        """Irradiance of nine coefficients, as many directions as the level has texels."""
        light = ShLight(self.size)
        basis = sh_basis(texel_directions(side).view(-1, 3))
        radiance = self.all[..., :3].clone().requires_grad_()
        milliseconds = gradient_ms(lambda: basis @ light.coefficients(radiance))
        coefficients = light.coefficients(self.all)
        between = sh_basis(self.directions) @ coefficients
        return self._direct("SH, order 2", None, side, basis @ coefficients, between, milliseconds)

    def spherical_gaussians(self, roughness: float | None, side: int) -> Point:
        """A level of the fitted light; the fit itself is not in its time."""
        axes = texel_directions(side).view(-1, 3)
        light = self.gaussians[0]
        milliseconds = gradient_ms(lambda: light.filtered(axes, roughness))
        with torch.no_grad():
            texels = torch.cat([g.filtered(axes, roughness) for g in self.gaussians], -1)
            between = [g.filtered(self.directions, roughness) for g in self.gaussians]
        name = f"SG, {SG_LOBES} lobes"
        return self._direct(name, roughness, side, texels, torch.cat(between, -1), milliseconds)

    def _point(self, method: str, level: Level, texels: torch.Tensor, ms: float) -> Point:
        picture = texels.view(level.size, level.size, -1)
        between = sample_octahedral(picture, self.directions)
        return self._direct(method, level.roughness, level.size, texels, between, ms)

    def _direct(self, method, roughness, side, texels, between, ms) -> Point:  # noqa: ANN001
        chosen = texels[:: max(1, len(texels) // DIRECTIONS)]
        truth = self.truth(roughness, 0)
        return Point(
            method,
            ms,
            relative_rms(chosen, self.truth(roughness, side)),
            relative_rms(between * self.weights.sqrt(), truth * self.weights.sqrt()),
            relative_l1(between * self.weights, truth * self.weights),
            float(between.min()),
        )


def measure(case: Case, hybrid: Level, exact: Level, paper: Level) -> list[Point]:
    """All methods at one roughness."""
    case.look_around(paper.roughness)
    stored = case.stored("paper stored", paper)
    points = [case.eager(paper, stored), stored]
    for count in MORE_SAMPLES:
        level = Level(paper.roughness, paper.size, Samples(count, LOD_BIAS))
        points.append(case.stored(f"{count} samples", level))
    points.append(case.spherical_gaussians(hybrid.roughness, hybrid.size))
    if hybrid.roughness is None:
        points.append(case.spherical_harmonics(hybrid.size))
    return [*points, case.stored("exact", exact), case.stored("hybrid", hybrid)]


def name_of(roughness: float | None) -> str:
    return "diffuse" if roughness is None else f"roughness {roughness:g}"


def print_points(roughness: float | None, points: list[Point]) -> None:
    for p in points:
        columns = "".join(f"{100 * e:8.2f}" for e in p.between)
        print(
            f"{name_of(roughness):15} {p.method:14}{p.milliseconds:9.2f} {columns}"
            f"{100 * p.error:9.2f}{100 * np.mean(p.at_texels):9.2f}{100 * np.mean(p.l1):8.2f}"
            f"{p.lowest:10.3g}",
            flush=True,
        )


def is_beaten(hybrid: Point, others: list[Point]) -> list[str]:
    """Methods that are both faster and more accurate."""
    return [
        p.method for p in others if p.error < hybrid.error and p.milliseconds < hybrid.milliseconds
    ]


def print_verdicts(results: dict[float | None, list[Point]]) -> None:
    for roughness, points in results.items():
        by_name = {p.method: p for p in points}
        hybrid, eager = by_name["hybrid"], by_name["paper eager"]
        beaten = is_beaten(hybrid, [p for p in points if p is not hybrid])
        on_front = f"no, beaten by {', '.join(beaten)}" if beaten else "yes"
        worst = min(a / b for a, b in zip(eager.between, hybrid.between, strict=True))
        print(
            f"{name_of(roughness):15} hybrid on the Pareto front: {on_front:4} "
            f"{eager.error / hybrid.error:6.1f} x more accurate than the paper's sampling "
            f"(worst map {worst:.1f} x) "
            f"at {hybrid.milliseconds / eager.milliseconds:.3f} of its eager time"
        )


def draw(results: dict[float | None, list[Point]], file: Path) -> None:
    """One panel per roughness: error against milliseconds, both on log axes."""
    plt.rcParams.update({"font.size": 10, "font.family": "DejaVu Sans"})
    figure, axes = plt.subplots(2, 4, figsize=(13.5, 6.9), sharex=True, sharey=True)
    for axis, (roughness, points) in zip(axes.flat, results.items(), strict=True):
        front = sorted(points, key=lambda p: p.milliseconds)
        front = [p for p in front if not is_beaten(p, points)]
        steps = [(p.milliseconds, 100 * p.error) for p in front]
        axis.plot(*zip(*steps, strict=True), color="#d62728", alpha=0.25, lw=5, zorder=1)
        for p in points:
            colour, marker = STYLE[p.method]
            big = p.method == "hybrid"
            axis.scatter(
                p.milliseconds,
                100 * p.error,
                s=210 if big else 110 if p.method == "exact" else 58,
                color=colour,
                marker=marker,
                edgecolor="white",
                linewidth=0.8,
                zorder=4 if big else 2 if p.method == "exact" else 3,
                label=p.method,
            )
        axis.set(xscale="log", yscale="log")
        axis.set_title(name_of(roughness), fontsize=11, fontweight="bold", loc="left")
        axis.grid(which="major", color="#dddddd", lw=0.8)
        axis.set_axisbelow(True)
        axis.spines[["top", "right"]].set_visible(False)
        axis.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
        axis.set_yticks([3, 5, 10, 20, 50], ["3 %", "5 %", "10 %", "20 %", "50 %"])
        axis.yaxis.set_minor_formatter(NullFormatter())
    for axis in axes[1]:
        axis.set_xlabel("milliseconds, forward + backward, one core")
    for axis in axes[:, 0]:
        axis.set_ylabel("error (relative RMS)")
    handles = {}
    for axis in axes.flat:
        found, names = axis.get_legend_handles_labels()
        handles |= dict(zip(names, found, strict=True))
    order = [handles[name] for name in STYLE]
    figure.legend(order, STYLE, ncol=len(STYLE), loc="lower center", frameon=False, fontsize=10)
    figure.suptitle(
        "Prefiltering an environment: lower and further left is better; the line is the front",
        x=0.01, ha="left",
        fontsize=14, fontweight="bold",
    )  # fmt: skip
    figure.tight_layout(rect=(0, 0.05, 1, 0.99))
    file.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(file, dpi=110)


def print_pyramids(maps: dict[str, torch.Tensor], size: int, profile: str) -> None:
    """Whole pyramids: time of all levels with the mips, error at random roughness."""
    everything = torch.cat([*maps.values()], -1)
    generator = torch.Generator().manual_seed(1)
    d = normalize(torch.randn(DIRECTIONS // 2, 3, generator=generator))
    rough = 0.1 + 0.9 * torch.rand(len(d), 1, generator=generator)
    truth = brute_force(everything, d, rough * rough, 2)
    radiance = next(iter(maps.values())).clone().requires_grad_()
    print(
        f"\nwhole pyramid, {profile}, {size}^2    ms  "
        + "".join(f"{n:>8}" for n in maps)
        + "  M entries"
    )
    for mode in ("sampled", "exact", "hybrid"):
        operator = PyramidOperator.build(size, mode, profile)
        milliseconds = gradient_ms(lambda op=operator: op(radiance).texels, 3)
        found = torch.cat([operator(m).specular(d, rough) for m in maps.values()], -1)
        columns = "".join(f"{100 * e:8.2f}" for e in relative_rms(found, truth))
        print(f"{mode:28}{milliseconds:9.1f}  {columns}{operator.prefilter.stored / 1e6:11.2f}")
    if profile == "optimisation":
        levels = PrefilterSpec(size, "sampled").levels()

        def eager() -> torch.Tensor:
            mips = eager_mips(radiance, mip_sizes(size))
            found = [eager_level(mips, v.size, v.roughness, v.filter.count) for v in levels]
            return torch.cat(found)

        print(f"{'paper eager':28}{gradient_ms(eager, 3):9.1f}  (as sampled)")


def print_rotation(size: int) -> None:
    radiance = torch.rand(size, size, 3)
    turned = cpu_ms(lambda: rotate_about_y(radiance, 37.0), 3)
    print(f"rotating a {size}^2 map about y: {turned:.1f} ms (turning the lookups instead: none)")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=os.environ.get("SVIM3D_DATA"))
    parser.add_argument("--maps", nargs="+", default=MAPS)
    parser.add_argument("--size", type=int, default=128)
    parser.add_argument("--relight-size", type=int, default=256)
    parser.add_argument("--picture", type=Path, default=ROOT / "benchmarks/results/prefilter.png")
    arguments = parser.parse_args()
    if arguments.data is None:
        parser.error("--data is needed: no SVIM3D_DATA is set")
    torch.set_num_threads(1)
    numba.set_num_threads(1)
    pictures = {}
    for name in arguments.maps:
        latlong = torch.from_numpy(read_rgb(Path(arguments.data) / "hdri" / f"{name}.exr"))
        pictures[name], mended = physical_radiance(latlong)
        print(f"{name}: {mended} texels mended, brightest {float(pictures[name].max()):.0f}")
    size = arguments.size
    case = Case({n: octahedral_from_latlong(p, size) for n, p in pictures.items()}, size)
    print("                               ms   error % " + " ".join(arguments.maps))
    print("                                    then mean, mean at texels, mean L1; lowest radiance")
    results: dict[float | None, list[Point]] = {}
    paper = PrefilterSpec(size, "sampled")
    pairs = zip(
        PrefilterSpec(size, "hybrid").levels(), PrefilterSpec(size, "exact").levels(), strict=True
    )
    for hybrid, exact in pairs:
        roughness = hybrid.roughness
        results[roughness] = measure(case, hybrid, exact, paper_level(paper, roughness))
        print_points(roughness, results[roughness])
    print()
    print_verdicts(results)
    draw(results, arguments.picture)
    print(f"picture: {arguments.picture}")
    print_pyramids(case.maps, size, "optimisation")
    large = arguments.relight_size
    maps = {n: octahedral_from_latlong(p, large) for n, p in pictures.items()}
    print_pyramids(maps, large, "relighting")
    print()
    for side in (size, large, 512):
        print_rotation(side)


if __name__ == "__main__":
    main()
