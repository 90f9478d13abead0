"""Where the surface is: two density models behind one interface.

`SdfVolume`: a signed-distance grid whose rays become opaque at its zero (NeuS).
`DensityVolume`: a hash-grid density with an occupancy grid (Instant-NGP).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor, nn

from svim3d.fields.density_field import START_DENSITY, DensityField
from svim3d.fields.distance import redistance
from svim3d.fields.hash_grid import HashGridSpec
from svim3d.fields.sdf_grid import node_positions, resample_grid, sample_sdf
from svim3d.numerics import dot
from svim3d.render.compositing import (
    accumulate,
    composite_weights,
    density_opacity,
    surface_opacity,
)
from svim3d.render.march import EMPTY, SURFACE, Rays, Samples, classify_cells, march

TRANSITION_WIDTHS = 5.0  # beyond 5 widths a logistic transition has less than 1 % left
START_SHARPNESS = 80.0  # per world unit: a transition of a dozen pixels of the object
BAND_CELLS = 2.0  # the sampled band reaches at least this far, so that the surface can move
MIN_STEPS_ACROSS, MAX_STEPS_ACROSS = 96, 256  # samples across the cube, coarse and fine
OCCUPANCY_CELLS = 64
OCCUPANCY_DECAY = 0.95  # per refresh; Source: Mueller et al. 2022, appendix C
MIN_OCCUPIED_OPACITY = 0.005  # a cell whose samples stop less light than this is empty
DENSITY_HIDDEN = 32
NODES_PER_BLOCK = 262144  # bounds the memory of evaluating a whole grid


@dataclass(frozen=True)
class SurfaceSamples:
    """What R rays see of a volume.

    Attributes:
        samples: those whose weight is above a threshold.
        weights: their share of the picture.
        gradient: of the signed distance (or log density) there; world space, points inward.
        coverage: share of each ray that was stopped, all samples counted.
    """

    samples: Samples
    weights: Float[Tensor, "M 1"]
    gradient: Float[Tensor, "M 3"]
    coverage: Float[Tensor, "R 1"]


@runtime_checkable
class Volume(Protocol):
    """A trainable distribution of opacity in the cube [-half_extent, half_extent]^3."""

    half_extent: float

    def trace(self, rays: Rays, jitter: Float[Tensor, "R"], min_weight: float) -> SurfaceSamples:
        """Composite along `rays`; `jitter` in [0, 1) shifts each ray's samples."""

    def refresh(self, generator: torch.Generator) -> None:
        """Bring the empty-space grid up to date with the parameters."""

    def signed_distance(self, nodes: int) -> Float[Tensor, "n n n"]:
        """The surface as a grid of about unit gradient, positive inside."""


def _keep_heavy(samples: Samples, weights: Float[Tensor, "N 1"], min_weight: float) -> Tensor:
    """Indices of samples worth a material."""
    heavy: Tensor = torch.nonzero(weights.detach()[:, 0] > min_weight)[:, 0]
    return heavy


class SdfVolume(nn.Module):
    """Signed distance on a grid, positive inside, with one global transition sharpness.

    The distance is the sum of the grid and of coarser grids that start at zero. They let a gradient
    step move whole regions of the surface at once; without them the fine grid fits the normals by
    rippling a surface in the wrong place. Empty space and solid interior are never sampled: only a
    band around the zero, which must hold the true surface from the start. The visual hull does.
    """

    def __init__(
        self, sdf: Float[Tensor, "n n n"], half_extent: float, coarse_nodes: Sequence[int] = ()
    ) -> None:
        super().__init__()
        self.half_extent = half_extent
        self.grid = nn.Parameter(sdf.clone())
        self.coarse = nn.ParameterList(
            [nn.Parameter(sdf.new_zeros(nodes, nodes, nodes)) for nodes in coarse_nodes]
        )
        self.sharpness = START_SHARPNESS

    @property
    def cell(self) -> float:
        """Side of a grid cell, world units."""
        return 2.0 * self.half_extent / (len(self.grid) - 1)

    def distance(self) -> Float[Tensor, "n n n"]:
        """The signed distance at the nodes of the finest grid."""
        levels: list[Tensor] = [*self.coarse, self.grid]
        total = levels[0]
        for finer in levels[1:]:
            total = finer + resample_grid(total, len(finer))
        return total

    def refresh(self, generator: torch.Generator | None = None) -> None:
        """Find the band anew; deterministic, so `generator` is not used."""
        band = max(TRANSITION_WIDTHS / self.sharpness, BAND_CELLS * self.cell)
        self.cells = classify_cells(self.distance().detach(), band)
        across = 2.0 * self.half_extent * self.sharpness
        self.step = 2.0 * self.half_extent / min(max(across, MIN_STEPS_ACROSS), MAX_STEPS_ACROSS)

    def resample(self, nodes: int, coarse_nodes: Sequence[int] = ()) -> None:
        """Go to another grid size with fresh coarse grids; the parameters are new ones."""
        sdf = resample_grid(self.distance().detach(), nodes)
        self.grid = nn.Parameter(sdf)
        self.coarse = nn.ParameterList(
            [nn.Parameter(sdf.new_zeros(coarse, coarse, coarse)) for coarse in coarse_nodes]
        )

    def trace(self, rays: Rays, jitter: Float[Tensor, "R"], min_weight: float) -> SurfaceSamples:
        """See `Volume`."""
        samples = march(
            rays, self.cells, half_extent=self.half_extent, step=self.step, jitter=jitter
        )
        sdf, gradient = sample_sdf(self.distance(), samples.points, self.half_extent)
        slope = dot(gradient, rays.directions.index_select(0, samples.ray))
        opacity = surface_opacity(sdf, slope, self.step, self.sharpness)
        weights = composite_weights(opacity, samples)
        heavy = _keep_heavy(samples, weights, min_weight)
        return SurfaceSamples(
            samples=samples.select(heavy),
            weights=weights.index_select(0, heavy),
            gradient=gradient.index_select(0, heavy),
            coverage=accumulate(weights, torch.ones_like(weights), samples),
        )

    def signed_distance(self, nodes: int) -> Float[Tensor, "n n n"]:
        """See `Volume`."""
        return resample_grid(self.distance().detach(), nodes)


class DensityVolume(nn.Module):
    """Hash-grid density with an occupancy grid: opaque where the density is high.

    Source: Mueller et al. 2022, appendix C, on the visual hull instead of the whole cube.
    """

    hull: Tensor
    occupancy: Tensor

    def __init__(
        self,
        spec: HashGridSpec,
        hull: Float[Tensor, "n n n"],
        half_extent: float,
        threshold: float,
    ) -> None:
        super().__init__()
        self.half_extent = half_extent
        self.threshold = threshold
        self.step = 2.0 * half_extent / MAX_STEPS_ACROSS
        self.field = DensityField(spec, DENSITY_HIDDEN, half_extent)
        sdf = resample_grid(hull, OCCUPANCY_CELLS + 1)
        near_hull = classify_cells(sdf, 2.0 * half_extent / OCCUPANCY_CELLS) != EMPTY
        self.register_buffer("hull", near_hull, persistent=False)
        start = torch.full_like(sdf[1:, 1:, 1:], START_DENSITY)
        self.register_buffer("occupancy", start)

    def reset(self, generator: torch.Generator) -> None:
        """Draw the start of the network."""
        self.field.reset(generator)
        self.cells = torch.where(self.hull, SURFACE, EMPTY).byte()

    def refresh(self, generator: torch.Generator) -> None:
        """Decayed running maximum of the density at one random point of each hull cell."""
        cells = torch.nonzero(self.hull)
        offset = torch.rand(cells.shape, generator=generator).to(cells.device)
        points = (cells + offset) * (2.0 * self.half_extent / OCCUPANCY_CELLS) - self.half_extent
        with torch.no_grad():
            density = self.field(points).exp()[:, 0]
        index = tuple(cells.unbind(-1))
        self.occupancy[index] = torch.maximum(self.occupancy[index] * OCCUPANCY_DECAY, density)
        opaque = density_opacity(self.occupancy, self.step) > MIN_OCCUPIED_OPACITY
        self.cells = torch.where(self.hull & opaque, SURFACE, EMPTY).byte()

    def trace(self, rays: Rays, jitter: Float[Tensor, "R"], min_weight: float) -> SurfaceSamples:
        """See `Volume`."""
        samples = march(
            rays, self.cells, half_extent=self.half_extent, step=self.step, jitter=jitter
        )
        opacity = density_opacity(self.field(samples.points).exp(), self.step)
        weights = composite_weights(opacity, samples)
        heavy = _keep_heavy(samples, weights, min_weight)
        chosen = samples.select(heavy)
        return SurfaceSamples(
            samples=chosen,
            weights=weights.index_select(0, heavy),
            gradient=self._log_gradient(chosen.points),
            coverage=accumulate(weights, torch.ones_like(weights), samples),
        )

    def _log_gradient(self, points: Float[Tensor, "M 3"]) -> Float[Tensor, "M 3"]:
        """Gradient of the log density by four taps at the corners of a tetrahedron.

        Finite differences need first derivatives of the encoding alone when a loss acts on them.
        """
        corners = points.new_tensor([[1, -1, -1], [-1, -1, 1], [-1, 1, -1], [1, 1, 1]])
        taps = points[:, None] + corners * self.step
        values = self.field(taps.view(-1, 3)).view(-1, 4, 1)
        return (values * corners).sum(1) / (4.0 * self.step)

    def signed_distance(self, nodes: int) -> Float[Tensor, "n n n"]:
        """See `Volume`: (log density - log threshold) / |gradient| near the surface."""
        positions = node_positions(nodes, self.half_extent, like=self.occupancy).view(-1, 3)
        with torch.no_grad():
            blocks = [self.field(part) for part in positions.split(NODES_PER_BLOCK)]
        level = torch.cat(blocks).view(nodes, nodes, nodes) - math.log(self.threshold)
        cell = (positions + self.half_extent) * (OCCUPANCY_CELLS / (2.0 * self.half_extent))
        x, y, z = cell.long().clamp(0, OCCUPANCY_CELLS - 1).unbind(-1)
        return redistance(
            level.masked_fill(~self.hull[x, y, z].view_as(level), -1.0), self.half_extent
        )
