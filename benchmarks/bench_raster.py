"""The rasteriser: are silhouette gradients right, and what does a view cost?

    python benchmarks/bench_raster.py [--size 256]

First table: gradient of a picture loss along deformations of the mesh, against central differences
of a supersampled picture; cosine and relative error for no antialiasing, for edges of the visible
triangle alone (what a test of each pixel's own triangle can find), and for the edge walk. Second
table: CPU milliseconds per view of the compiled kernels and their plain torch twins. The chart lies
in `benchmarks/results`.
"""

import argparse
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from svim3d.cameras import orbit_cameras  # noqa: E402
from svim3d.mesh.marching import extract_surface  # noqa: E402
from svim3d.mesh.mesh import face_adjacency  # noqa: E402
from svim3d.raster.interpolation import barycentrics, blend_corners, interpolate  # noqa: E402
from svim3d.raster.silhouettes import (  # noqa: E402
    EdgePairs,
    blend_pairs,
    find_edge_pairs,
    walk_edges,
)
from svim3d.raster.zbuffer import Fragments, rasterize, rasterize_scatter  # noqa: E402

REFERENCE_PX = 2048  # side of the supersampled picture
STEP = 3e-3  # of the central differences, world units
RULES = ("none", "own triangle", "edge walk")
REPEATS = 5


@dataclass(frozen=True)
class Subject:
    """A mesh with fixed vertex colours."""

    name: str
    vertices: Tensor
    faces: Tensor

    @property
    def color(self) -> Tensor:
        """Smooth colours that stay with the vertices."""
        return 0.6 + 0.3 * torch.sin(4.0 * self.vertices + torch.tensor([0.0, 1.0, 2.0]))


def extracted(name: str, sdf: Callable[[Tensor], Tensor], nodes: int) -> Subject:
    axis = torch.linspace(-0.5, 0.5, nodes)
    grid = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1)
    vertices, faces = extract_surface(sdf(grid), 0.5)
    return Subject(f"{name} ({len(faces)})", vertices, faces)


def subjects() -> list[Subject]:
    def sphere(p: Tensor) -> Tensor:
        return 0.3 - p.norm(dim=-1)

    def box(p: Tensor) -> Tensor:
        return 0.2 - p.abs().amax(-1)

    def torus_and_ball(p: Tensor) -> Tensor:
        ring = 0.08 - torch.hypot(torch.hypot(p[..., 0], p[..., 1]) - 0.25, p[..., 2])
        ball = 0.15 - (p - torch.tensor([0.1, 0.2, 0.1])).norm(dim=-1)
        return torch.maximum(ring, ball)

    return [
        extracted("sphere", sphere, 9),
        extracted("sphere", sphere, 65),
        extracted("box", box, 16),
        extracted("torus and ball", torus_and_ball, 49),
        extracted("torus and ball", torus_and_ball, 129),
    ]


def clip_positions(vertices: Tensor, size: int) -> Tensor:
    cameras = orbit_cameras([(20.0, 30.0)], radius=2.0, fov_y_deg=33.8, size=size)
    return cameras.project(vertices)[0]


def own_triangle(pairs: EdgePairs, faces: Tensor, fragments: Fragments) -> EdgePairs:
    """Pairs whose edge belongs to the triangle that the near pixel sees."""
    corners = faces[fragments.triangle.reshape(-1)[pairs.near].long()].long()
    kept = (corners[:, :, None] == pairs.edge[:, None]).any(1).all(1)
    return EdgePairs(pairs.near[kept], pairs.far[kept], pairs.edge[kept], pairs.axis[kept])


def picture(subject: Subject, vertices: Tensor, size: int, rule: str) -> Tensor:
    clip = clip_positions(vertices, size)
    fragments = rasterize(clip, subject.faces, size, size)
    pixels, values = interpolate(clip, subject.faces, fragments, subject.color)
    image = torch.zeros(size * size, 3).index_copy(0, pixels, values).view(size, size, 3)
    if rule == "none":
        return image
    pairs = find_edge_pairs(clip, subject.faces, fragments, face_adjacency(subject.faces))
    if rule == "own triangle":
        pairs = own_triangle(pairs, subject.faces, fragments)
    return blend_pairs(image, clip, pairs)


def loss(image: Tensor) -> Tensor:
    size = len(image)
    y, x = torch.meshgrid(*[(torch.arange(size) + 0.5) / size] * 2, indexing="ij")
    waves = [0.5 + 0.5 * torch.sin(6 * x), 0.5 + 0.5 * torch.cos(5 * y), 0.3 + 0 * x]
    return (image - torch.stack(waves, -1)).square().sum()


def supersampled_loss(subject: Subject, vertices: Tensor, size: int) -> float:
    factor = REFERENCE_PX // size
    fine = picture(subject, vertices, size * factor, "none").permute(2, 0, 1)[None]
    return float(loss(avg_pool2d(fine, factor)[0].permute(1, 2, 0)))


def deformations(vertices: Tensor) -> list[Tensor]:
    """Three translations, a scaling, and eight smooth random fields."""
    generator = torch.Generator().manual_seed(0)
    waves = [
        torch.sin(vertices @ (6 * torch.randn(3, 3, generator=generator)) + phase)
        for phase in torch.linspace(0.0, 6.0, 8)
    ]
    return [*torch.eye(3)[:, None].expand(3, len(vertices), 3), vertices, *waves]


def gradient_row(subject: Subject, size: int) -> dict[str, tuple[float, float]]:
    """Cosine and relative error of each rule."""
    directions = deformations(subject.vertices)
    truth = []
    for d in directions:
        ahead = supersampled_loss(subject, subject.vertices + STEP * d, size)
        behind = supersampled_loss(subject, subject.vertices - STEP * d, size)
        truth.append((ahead - behind) / (2 * STEP))
    expected = torch.tensor(truth)
    row = {}
    for rule in RULES:
        vertices = subject.vertices.clone().requires_grad_()
        loss(picture(subject, vertices, size, rule)).backward()
        assert vertices.grad is not None
        ours = torch.tensor([float((vertices.grad * d).sum()) for d in directions])
        cosine = float(ours @ expected / (ours.norm() * expected.norm()))
        row[rule] = (cosine, float((ours - expected).norm() / expected.norm()))
    return row


def cpu_ms(run: Callable[[], object]) -> float:
    """Least CPU milliseconds of a few runs: independent of what else the machine does."""
    run()
    times = []
    for _ in range(REPEATS):
        start = time.process_time()
        run()
        times.append(1e3 * (time.process_time() - start))
    return min(times)


def timing_row(subject: Subject, size: int) -> dict[str, tuple[float, float]]:
    """Milliseconds of (kernel, torch twin) per step."""
    faces, color = subject.faces, subject.color
    clip = clip_positions(subject.vertices, size)
    fragments, adjacency = rasterize(clip, faces, size, size), face_adjacency(faces)

    def plainly(leaf: Tensor) -> Tensor:
        pixels, weights = barycentrics(leaf, faces, fragments)
        corners = faces[fragments.triangle.reshape(-1)[pixels].long()]
        return blend_corners(weights, corners, color)

    def backward(values: Callable[[Tensor], Tensor]) -> None:
        leaf = clip.clone().requires_grad_()
        values(leaf).sum().backward()

    return {
        "rasterise": (
            cpu_ms(lambda: rasterize(clip, faces, size, size)),
            cpu_ms(lambda: rasterize_scatter(clip, faces, size, size)),
        ),
        "interpolate, both ways": (
            cpu_ms(lambda: backward(lambda c: interpolate(c, faces, fragments, color)[1])),
            cpu_ms(lambda: backward(plainly)),
        ),
        "find silhouettes": (
            cpu_ms(lambda: find_edge_pairs(clip, faces, fragments, adjacency)),
            cpu_ms(lambda: walk_edges(clip, faces, fragments, adjacency)),
        ),
    }


def chart(gradients: dict[str, dict[str, tuple[float, float]]], file: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(8, 4), layout="constrained")
    for i, rule in enumerate(RULES):
        places = [k + 0.27 * (i - 1) for k in range(len(gradients))]
        axes.bar(places, [row[rule][0] for row in gradients.values()], 0.25, label=rule)
    axes.set_xticks(range(len(gradients)), list(gradients), fontsize=8)
    axes.set_ylabel("cosine to finite differences")
    axes.axhline(1.0, color="grey", linewidth=0.8)
    axes.set_title("Silhouette gradients by rule (triangles in brackets)")
    figure.legend(loc="outside lower center", ncols=len(RULES))
    file.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(file, dpi=120)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--size", type=int, default=256, help="image side, a divisor of 2048")
    size = parser.parse_args().size
    gradients = {}
    print(f"{'gradient, cosine / rel. error':28s}" + "".join(f"{rule:>18s}" for rule in RULES))
    for subject in subjects():
        gradients[subject.name] = row = gradient_row(subject, size)
        cells = "".join(f"{c:10.3f} / {e:5.2f}" for c, e in row.values())
        print(f"{subject.name:28s}{cells}", flush=True)
    print(f"\nCPU ms per view at {size}^2: kernel / torch twin")
    for subject in subjects()[-2:]:
        row = timing_row(subject, size)
        print(
            f"{subject.name:28s}" + "  ".join(f"{k} {a:.1f} / {b:.1f}" for k, (a, b) in row.items())
        )
    file = ROOT / "benchmarks" / "results" / "raster.png"
    chart(gradients, file)
    print(f"\n{file}")


if __name__ == "__main__":
    main()
