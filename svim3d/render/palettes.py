"""Few values instead of a texture: clusters of texels, each of one value fitted to the views."""

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from svim3d.render.view_pixels import ViewPixels

ROUNDS = 8  # of Lloyd's algorithm after each split; from a good start few texels move later
LEAST_INSIDE = 0.4  # of a cluster's texels: stripes of three texels have a third, of four the half
MIN_SHARE = 1e-9  # keeps a cluster that no pixel sees at its place in the normal equations


@dataclass(frozen=True)
class Palette:
    """K values of C channels, one per cluster, in the space in which texels were compared."""

    values: Float[Tensor, "K C"]

    def labels(self, texels: Float[Tensor, "T C"]) -> Int[Tensor, "T"]:
        """Nearest value of each texel."""
        # Squared distances but for a constant: the product needs no [T, K, C].
        return (self.values.square().sum(1) - 2.0 * texels @ self.values.T).argmin(1)


def growing_palettes(
    texels: Float[Tensor, "T C"], mass: Float[Tensor, "T"], largest: int
) -> Iterator[Palette]:
    """Palettes of 2, 3, ... `largest` clusters; ends early where there is nothing to split.

    The cluster that holds most of the squared error is split across its longest axis, then all are
    settled by Lloyd's algorithm. So nothing is random.

    Args:
        texels: values to be told apart.
        mass: what each counts; those of none are left out.
        largest: number of clusters of the last one.
    """
    texels, mass = texels[mass > 0], mass[mass > 0]
    palette = Palette(((mass[:, None] * texels).sum(0) / mass.sum().clamp_min(MIN_SHARE))[None])
    while len(palette.values) < largest:
        labels = palette.labels(texels)
        offsets = texels - palette.values[labels]
        error = torch.bincount(
            labels, (mass * offsets.square().sum(1)).double(), len(palette.values)
        )
        worst = int(error.argmax())
        if float(error[worst]) <= 0.0:
            return
        inside = labels == worst
        weighted = mass[inside, None] * offsets[inside]
        axis = torch.linalg.eigh((weighted.T @ offsets[inside]).double())[1][:, -1].to(texels)
        half = (weighted @ axis).abs().sum() / mass[inside].sum() * axis
        centre = palette.values[worst]
        others = torch.arange(len(palette.values)) != worst
        split = torch.stack([centre - half, centre + half])
        palette = _settled(Palette(torch.cat([palette.values[others], split])), texels, mass)
        yield palette


def _settled(palette: Palette, texels: Float[Tensor, "T C"], mass: Float[Tensor, "T"]) -> Palette:
    """Lloyd's algorithm."""
    for _ in range(ROUNDS):
        labels = palette.labels(texels)
        count = torch.zeros(len(palette.values)).index_add(0, labels, mass)[:, None]
        total = torch.zeros_like(palette.values).index_add(0, labels, mass[:, None] * texels)
        mean = total / count.clamp_min(MIN_SHARE)
        palette = Palette(torch.where(count > MIN_SHARE, mean, palette.values))
    return palette


def palette_values(
    labels: Int[Tensor, "T"],
    clusters: int,
    texels: Float[Tensor, "T C"],
    mass: Float[Tensor, "T"],
    pixels: ViewPixels,
) -> Float[Tensor, "K C"]:
    """The value of each cluster that fits the pixels best, by least squares.

    A pixel on a border mixes clusters; so their values are solved for together. A cluster that no
    pixel sees takes the mean of its texels.

    Args:
        labels: cluster of each texel.
        clusters: how many there are.
        texels: what they were drawn together from.
        mass: what each texel counts; all alike where none does.
        pixels: of as many channels.
    """
    member = torch.nn.functional.one_hot(labels, clusters).to(texels)
    counted = member * (mass[:, None] + MIN_SHARE)
    start = (counted.T @ texels) / counted.sum(0)[:, None].clamp_min(MIN_SHARE)
    share = pixels.operator(member)
    weighted = (pixels.weight * share).double()
    tiny = MIN_SHARE * weighted.sum().clamp_min(1.0)
    left = weighted.T @ share.double() + tiny * torch.eye(clusters, dtype=torch.float64)
    residual = (pixels.target - share @ start).double()
    return start + torch.linalg.solve(left, weighted.T @ residual).to(start)


def border_length(labels: Int[Tensor, "S S"], seen: Bool[Tensor, "S S"]) -> int:
    """Pairs of neighbouring texels, both seen, that belong to different clusters."""
    return sum(int(differ.sum()) for differ in _borders(labels, seen))


def have_insides(labels: Int[Tensor, "S S"], seen: Bool[Tensor, "S S"], clusters: int) -> bool:
    """Whether each cluster is made of patches, not of lines and single texels.

    Pixels on the border of two materials show a third that is none; its cluster is a thin line.
    """
    at_border = torch.zeros_like(seen)
    for axis, differ in enumerate(_borders(labels, seen)):
        at_border.narrow(axis, 0, len(labels) - 1).logical_or_(differ)
        at_border.narrow(axis, 1, len(labels) - 1).logical_or_(differ)
    total, inside = (
        torch.bincount(labels[chosen], minlength=clusters) for chosen in (seen, seen & ~at_border)
    )
    return bool((inside >= LEAST_INSIDE * total.clamp_min(1)).all())


def _borders(
    labels: Int[Tensor, "S S"], seen: Bool[Tensor, "S S"]
) -> Iterator[Bool[Tensor, "_ _"]]:
    """Along each axis, whether a texel and the next are seen and of different clusters."""
    for axis in (0, 1):
        extent = labels.shape[axis] - 1
        first, second = (labels.narrow(axis, start, extent) for start in (0, 1))
        both = seen.narrow(axis, 0, extent) & seen.narrow(axis, 1, extent)
        yield (first != second) & both
