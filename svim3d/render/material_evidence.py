"""Which form a material needs: one constant, a few clusters, or a texture; by what views say of it.

Nested hypotheses. Each is fitted to half of the views and held against the other half, and the one
of the lowest cost is taken:

    cost = n / 2 ln(max(MSE, floor)) + sum over the free values j of 1 / 2 ln(1 + n_j)

with n the number of independent pixels and n_j the number that speak for value j: all for a
constant, a K-th for one of K clusters, the pixels of its own spot for a texel. Where texels of two
clusters meet a palette pays as for a texel, for its border is drawn by texels. Noise in the views
promotes nothing: a texture that has learnt one half's is farther from the other than the mean is.

Source: Schwarz 1978 ("Estimating the dimension of a model"), whose n is each value's own here: with
one n for all, a texel that eight pixels speak for would pay like one that all of them do.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from svim3d.color import srgb_from_linear
from svim3d.render.palettes import border_length, growing_palettes, have_insides, palette_values
from svim3d.render.texture_fit import fit_texels
from svim3d.render.view_pixels import FLOOR_DB, ViewPixels

Form = Literal["constant", "palette", "texture"]
Curve = Callable[[Tensor], Tensor]

LARGEST_PALETTE = 4  # clusters; more seldom pay, and a file of so many is a texture's size
MIN_PIXELS = 64  # held-out pixels below which nothing can be said


@dataclass(frozen=True)
class Channels:
    """Channels of the target that take one form together.

    Attributes:
        name: for messages.
        places: which channels.
        curve: to the space in which errors are seen, from linear; the identity but for colour.
        inverse: back.
    """

    name: str
    places: slice
    curve: Curve = torch.Tensor.clone

    def encoded(self, values: Float[Tensor, "P C"]) -> Float[Tensor, "P c"]:
        """These channels as errors of them are seen."""
        return self.curve(values[:, self.places].clamp(0.0, 1.0))


BASECOLOR = Channels("basecolor", slice(0, 3), srgb_from_linear)
ROUGHNESS = Channels("roughness", slice(3, 4))
METALLIC = Channels("metallic", slice(4, 5))
GROUPS = (BASECOLOR, ROUGHNESS, METALLIC)


@dataclass(frozen=True)
class Hypothesis:
    """One form and what speaks against it.

    Attributes:
        form: what it is.
        clusters: values that it has, 0 for a texture.
        error_db: of held-out pixels against a peak of 1 (PSNR); infinite where there is none.
        cost: see the module.
    """

    form: Form
    clusters: int
    error_db: float
    cost: float


@dataclass(frozen=True)
class Verdict:
    """The form chosen for some channels.

    Attributes:
        chosen: the hypothesis of the lowest cost.
        rejected: the others.
        independent: pixels that counted.
    """

    chosen: Hypothesis
    rejected: tuple[Hypothesis, ...]
    independent: float

    @property
    def lost_db(self) -> float:
        """By how much the full texture is closer to held-out pixels; negative where it is not.

        What is beyond `FLOOR_DB` does not count.
        """
        texture = next(h for h in (self.chosen, *self.rejected) if h.form == "texture")
        return min(texture.error_db, FLOOR_DB) - min(self.chosen.error_db, FLOOR_DB)

    def __str__(self) -> str:
        told = ", ".join(
            f"{_named(h)} {h.error_db:.1f} dB, cost {h.cost:.0f}"
            for h in sorted((self.chosen, *self.rejected), key=lambda h: h.clusters or 99)
        )
        return (
            f"{_named(self.chosen)} by {self.independent:.0f} independent pixels, "
            f"{max(self.lost_db, 0.0):.1f} dB lost against the texture ({told})"
        )


def _named(hypothesis: Hypothesis) -> str:
    count = f" of {hypothesis.clusters}" if hypothesis.form == "palette" else ""
    return f"{hypothesis.form}{count}"


def judge(
    pixels: ViewPixels,
    *,
    texel_count: dict[str, int],
    prior: float,
    iterations: int,
    most_lost_db: float = math.inf,
) -> dict[str, Verdict]:
    """The form of each group of channels.

    Args:
        pixels: of all views; targets are basecolor, roughness and metallic, linear.
        texel_count: by group, how many texels a sufficient texture of it has.
        prior: of the texture's fit, see `fit_texels`.
        iterations: of that fit.
        most_lost_db: see `verdict`.

    Returns:
        By group; none where the views are too few to be held against each other.
    """
    halves = [pixels.view % 2 == half for half in (0, 1)]
    squared: dict[tuple[str, int], Tensor] = {}
    borders: dict[tuple[str, int], int] = {}
    residual, known = torch.zeros_like(pixels.target), torch.zeros(len(pixels.pixel)) > 1
    for own, other in (halves, halves[::-1]):
        if not bool(own.any()) or not bool(other.any()):
            return {}
        found = _held_out(pixels.take(own), pixels.take(other), prior, iterations)
        rows = torch.nonzero(other)[:, 0]
        known[rows] = found.known
        residual[rows] = found.residual
        for key, values in found.squared.items():
            squared.setdefault(key, torch.full((len(known),), torch.nan))[rows] = values
        for key, length in found.borders.items():
            borders[key] = max(borders.get(key, 0), length)
    known &= pixels.weight[:, 0] > 0
    if int(known.sum()) < MIN_PIXELS:
        return {}
    counted = pixels.take(known)
    verdicts = {}
    for group in GROUPS:
        independent = counted.independent(residual[known][:, group.places])
        hypotheses = []
        for (name, clusters), values in squared.items():
            if name != group.name or bool(values[known].isnan().any()):
                continue
            weight = counted.weight[:, 0].double()
            mean = float((weight * values[known]).sum() / weight.sum())
            border = borders.get((name, clusters), 0)
            hypotheses.append(_weighed(clusters, mean, independent, texel_count[name], border))
        verdicts[group.name] = verdict(hypotheses, independent, most_lost_db)
    return verdicts


def verdict(
    hypotheses: list[Hypothesis], independent: float, most_lost_db: float = math.inf
) -> Verdict:
    """The cheapest hypothesis; of equal ones the simplest.

    Args:
        hypotheses: among them a texture.
        independent: pixels that counted.
        most_lost_db: those that are farther from held-out pixels than the texture by more are left
            out, whatever they cost; what is beyond `FLOOR_DB` does not count.
    """
    texture = next(h for h in hypotheses if h.form == "texture")
    least_db = min(texture.error_db, FLOOR_DB) - most_lost_db
    close = [h for h in hypotheses if min(h.error_db, FLOOR_DB) >= least_db]
    chosen = min(close, key=lambda h: (h.cost, h.clusters or LARGEST_PALETTE + 1))
    return Verdict(chosen, tuple(h for h in hypotheses if h is not chosen), independent)


def _weighed(
    clusters: int, mean_squared: float, independent: float, texels: int, border: int
) -> Hypothesis:
    """A hypothesis with its cost; `clusters` 0 is the texture."""
    form: Form = "texture" if clusters == 0 else "constant" if clusters == 1 else "palette"
    drawn = 0.5 * border * math.log1p(independent / texels)
    return Hypothesis(
        form,
        clusters,
        -10.0 * math.log10(mean_squared) if mean_squared > 0.0 else math.inf,
        cost(mean_squared, independent, clusters or texels) + drawn,
    )


def cost(
    mean_squared: float, independent: float, free: int, floor: float = 10 ** (-FLOOR_DB / 10)
) -> float:
    """Misfit and size of a model in nats: n / 2 ln(max(MSE, floor)) + k / 2 ln(1 + n / k)."""
    misfit = 0.5 * independent * math.log(max(mean_squared, floor))
    return misfit + 0.5 * free * math.log1p(independent / free)


@dataclass(frozen=True)
class _HeldOut:
    """What forms fitted to some pixels make of others.

    Attributes:
        known: pixels that only show texels which the fitted ones saw.
        residual: target minus texture, as seen.
        squared: by group and clusters (0: texture), mean squared error over the channels.
        borders: by group and clusters, see `border_length`.
    """

    known: Bool[Tensor, "P"]
    residual: Float[Tensor, "P C"]
    squared: dict[tuple[str, int], Tensor]
    borders: dict[tuple[str, int], int]


def _held_out(train: ViewPixels, test: ViewPixels, prior: float, iterations: int) -> _HeldOut:
    """Fit every form to one set of pixels and measure it on the other."""
    mass = train.mass()
    known = test.known_to(train)
    mean = train.mean()
    # From the mean, not from what was baked: the field has seen all views, these ones too.
    start = mean.expand(len(mass), -1).contiguous()
    texels = fit_texels(
        train.operator, train.target, train.weight, start, prior=prior, iterations=iterations
    )
    size = train.texture_size
    residual = torch.zeros_like(test.target)
    squared: dict[tuple[str, int], Tensor] = {}
    borders: dict[tuple[str, int], int] = {}

    seen = (mass > 0).view(size, size)
    for group in GROUPS:
        truth = group.encoded(test.target)
        looks = group.encoded(texels)
        fitted = group.encoded(test.operator(texels))
        residual[:, group.places] = truth - fitted
        squared[group.name, 0] = (fitted - truth).square().mean(1)
        constant = group.encoded(mean[None])
        squared[group.name, 1] = (constant - truth).square().mean(1)
        for palette in growing_palettes(looks, mass, LARGEST_PALETTE):
            labels, clusters = palette.labels(looks), len(palette.values)
            if not have_insides(labels.view(size, size), seen, clusters):
                continue
            values = palette_values(labels, clusters, texels, mass, train)
            predicted = test.operator(values[labels])
            squared[group.name, clusters] = (group.encoded(predicted) - truth).square().mean(1)
            borders[group.name, clusters] = border_length(labels.view(size, size), seen)
    return _HeldOut(known, residual, squared, borders)
