"""Fits how far split-sum's lookup leans towards the normal, and what that gains.

    python benchmarks/fit_bend.py --data FOLDER [--points 60] [--samples 96] [--table]

`--data` (default: the environment variable SVIM3D_DATA) holds `hdri/*.exr`. Every second map is
fitted to, the others are held out. At each node of a grid of (roughness, n.v), random normals and
azimuths are shaded by sampling (the truth) and by split sum with every bend, for F0 = 1 and 0.04.
The error of a point is the squared error of the specular lobe over the sum of the squares of the
truth there and of its mean under that map. Suns are dimmed to 50 times the map's mean, so that the
few points which see one do not outweigh all others; the noise of the truth is the same for every
bend. The table minimises the mean of that error for F0 = 0.04, plus a small penalty on its second
differences, which decides where the error does not.
Printed: the held-out error of every rule, as the root of the mean over n.v (or roughness).
`--table` prints the table as in `svim3d/shading/dominant_lobe.py`.
"""

import argparse
import os
import sys
from pathlib import Path

import torch
from torch import Tensor

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from svim3d.io.exr import read_rgb  # noqa: E402
from svim3d.numerics import dot, normalize  # noqa: E402
from svim3d.shading.directional_albedo import MIN_N_DOT_V, lobe_albedos  # noqa: E402
from svim3d.shading.dominant_lobe import BEND  # noqa: E402
from svim3d.shading.environment import octahedral_from_latlong, physical_radiance  # noqa: E402
from svim3d.shading.metallic_roughness import specular_f0  # noqa: E402
from svim3d.shading.monte_carlo import shade_by_sampling  # noqa: E402
from svim3d.shading.prefilter import PyramidOperator  # noqa: E402
from svim3d.shading.sampled_light import SampledLight  # noqa: E402

LIGHT_SIZE = 128
NODES = len(BEND)  # per side of the table
BENDS = torch.linspace(0.0, 1.0, 33, dtype=torch.float64)
SMOOTHNESS = 3e-2  # of squared second differences, against relative squared errors
LIMIT = 50.0  # of radiance over its mean: a full sun makes the fit follow a few points
STEPS, RATE = 600, 0.02  # of the fit


def error_curves(environment: Tensor, points: int, samples: int, seed: int) -> Tensor:
    """Relative squared errors [F0, roughness, n.v, bend] under one map."""
    generator = torch.Generator().manual_seed(seed)
    light, pyramid = (
        SampledLight.build(environment),
        PyramidOperator.build(LIGHT_SIZE)(environment),
    )
    axis = torch.linspace(0.0, 1.0, NODES, dtype=torch.float64)
    roughness, n_dot_v = torch.meshgrid(axis, (axis * axis).clamp_min(MIN_N_DOT_V), indexing="ij")
    roughness, n_dot_v = (
        t.reshape(-1, 1).repeat_interleave(points, 0) for t in (roughness, n_dot_v)
    )
    count = len(roughness)
    normal, other = (
        normalize(torch.randn(count, 3, generator=generator, dtype=torch.float64)) for _ in "nt"
    )
    tangent = normalize(other - dot(other, normal) * normal)
    wo = n_dot_v * normal + (1.0 - n_dot_v**2).sqrt() * tangent
    mirror = 2.0 * n_dot_v * normal - wo
    prefiltered = [pyramid.specular(mirror + bend * (normal - mirror), roughness) for bend in BENDS]
    curves = []
    white = torch.ones(count, 3, dtype=torch.float64)
    for metallic in (1.0, 0.0):
        material = (white, roughness, metallic * white[:, :1])
        truth = shade_by_sampling(
            normal, wo, *material, light, samples=samples, generator=generator
        ).specular
        f0 = specular_f0(white, material[2])
        single, _ = lobe_albedos(f0, n_dot_v, roughness, multiple_scattering=False)
        shape = (NODES, NODES, points * 3)
        mean = truth.reshape(shape).mean(-1, keepdim=True)
        scale = (truth.reshape(shape) ** 2 + mean**2)[..., None]
        squares = torch.stack([(single * p - truth) ** 2 for p in prefiltered], -1)
        curves.append((squares.view(*shape, len(BENDS)) / scale).mean(2))
    return torch.stack(curves)


def value_on(curves: Tensor, bend: Tensor) -> Tensor:
    """Errors at bends [roughness, n.v], linear between the sampled ones; differentiable."""
    position = bend.clamp(0.0, 1.0) * (len(BENDS) - 1)
    low = position.detach().long().clamp_max(len(BENDS) - 2).expand(curves.shape[:-1])[..., None]
    below, above = curves.gather(-1, low)[..., 0], curves.gather(-1, low + 1)[..., 0]
    return below + (position - low[..., 0]) * (above - below)


def fit(curves: Tensor) -> Tensor:
    """The smooth table of least error; no bend for a perfect mirror."""
    bend = power_rule(3).requires_grad_()
    optimizer = torch.optim.Adam([bend], lr=RATE)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, STEPS)
    for _ in range(STEPS):
        table = _mirror_unbent(bend)
        rough = table.diff(n=2, dim=0).square().sum() + table.diff(n=2, dim=1).square().sum()
        loss = value_on(curves, table).mean(0).sum() + SMOOTHNESS * rough
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
        with torch.no_grad():
            bend.clamp_(0.0, 1.0)
    return _mirror_unbent(bend).detach()


def _mirror_unbent(bend: Tensor) -> Tensor:
    return torch.cat([torch.zeros_like(bend[:1]), bend[1:]])


def power_rule(exponent: int) -> Tensor:
    """The share roughness^exponent, for every n.v."""
    axis = torch.linspace(0.0, 1.0, NODES, dtype=torch.float64)
    return (axis**exponent)[:, None].expand(NODES, NODES).clone()


def frostbite_rule() -> Tensor:
    """Source: Lagarde and de Rousiers 2014, "Moving Frostbite to PBR", listing 21."""
    alpha = torch.linspace(0.0, 1.0, NODES, dtype=torch.float64) ** 2
    towards_mirror = (1.0 - alpha) * ((1.0 - alpha).sqrt() + alpha)
    return (1.0 - towards_mirror)[:, None].expand(NODES, NODES)


def report(curves: Tensor, rules: dict[str, Tensor]) -> str:
    """Held-out errors: a column per rule, a row per roughness, then per n.v."""
    lines = []
    for kind, name in enumerate(("F0 = 1", "F0 = 0.04")):
        errors = {rule: value_on(curves, bend)[kind] for rule, bend in rules.items()}
        lines.append(f"{name:14}" + "".join(f"{rule:>12}" for rule in errors))
        for label, axis in (("roughness", 1), ("n.v", 0)):
            for node in range(1, NODES):
                value = node / (NODES - 1) if axis else (node / (NODES - 1)) ** 2
                cells = [float(e.select(1 - axis, node).mean().sqrt()) for e in errors.values()]
                lines.append(f"{label:10}{value:4.2f}" + "".join(f"{c:12.4f}" for c in cells))
        cells = [float(e.mean().sqrt()) for e in errors.values()]
        lines.append(f"{'all':14}" + "".join(f"{c:12.4f}" for c in cells))
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, default=os.environ.get("SVIM3D_DATA"))
    parser.add_argument("--points", type=int, default=60)
    parser.add_argument("--samples", type=int, default=96)
    parser.add_argument("--table", action="store_true")
    arguments = parser.parse_args()
    if arguments.data is None:
        parser.error("--data is missing and SVIM3D_DATA is not set")
    files = sorted((Path(arguments.data) / "hdri").glob("*.exr"))
    maps = []
    for seed, file in enumerate(files):
        radiance, _ = physical_radiance(torch.from_numpy(read_rgb(file)))
        environment = octahedral_from_latlong(radiance.double(), LIGHT_SIZE)
        environment = environment.clamp_max(LIMIT * float(environment.mean()))
        maps.append(error_curves(environment, arguments.points, arguments.samples, seed))
    # To the dielectric lobe: fitted to both, the table makes real assets worse than r^3 does.
    fitted = fit(torch.stack(maps[::2]).mean(0)[1:])
    rules = {
        "unbent": torch.zeros_like(fitted),
        "Frostbite": frostbite_rule(),
        "r^3": power_rule(3),
        "shipped": torch.tensor(BEND, dtype=torch.float64),
        "fitted": fitted,
    }
    print(report(torch.stack(maps[1::2]).mean(0), rules))
    if arguments.table:
        print("\n".join(f"    ({', '.join(f'{b:.3f}' for b in row)})," for row in fitted.tolist()))


if __name__ == "__main__":
    main()
