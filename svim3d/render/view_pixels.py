"""What views say of a texture: weighted pixels, each a known mean of texels.

The evidence that a material's forms are weighed by. How many of the pixels count as independent is
read off the residuals: noise of a generator is smooth, so that neighbours repeat each other.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse
from jaxtyping import Bool, Float, Int
from torch import Tensor

from svim3d.shading.linear_operator import SparseOperator

FLOOR_DB = 45.0  # of a peak of 1: what is closer than 1.4 steps of 8 bits is not told apart
FLOOR_RMS = 10.0 ** (-FLOOR_DB / 20.0)
KNOWN = 0.99  # share of a pixel whose texels other views have seen
OUTLIER = 3.0 * 1.4826  # times the median magnitude: three standard deviations of Gaussian noise
# Of the picture's side. What errs alike over more is no noise but another material.
MAX_LAG = 1 / 8
MIN_CORRELATION = 0.05  # lags from the first below it on are left out: they would add up noise


@dataclass(frozen=True)
class ViewPixels:
    """Pixels of V views of H x W that see one surface.

    Attributes:
        operator: [pixels, texels] of a square texture; rows sum to one.
        pixel: flat index into V x H x W.
        target: what the views show there.
        weight: how far each is to be trusted.
        shape: V, H, W.
        texture_size: texels per side.
    """

    operator: SparseOperator
    pixel: Int[Tensor, "P"]
    target: Float[Tensor, "P C"]
    weight: Float[Tensor, "P 1"]
    shape: tuple[int, int, int]
    texture_size: int

    @property
    def view(self) -> Int[Tensor, "P"]:
        """Which view each pixel belongs to."""
        return self.pixel // (self.shape[1] * self.shape[2])

    def coarsened(self, factor: int) -> "ViewPixels":
        """The same pixels over a texture whose texels are blocks of factor x factor of these."""
        if factor == 1:
            return self
        size = self.texture_size // factor
        fine = self.operator.forward_matrix.scipy()
        row, column = fine.indices // self.texture_size, fine.indices % self.texture_size
        block = row // factor * size + column // factor
        # Copies: entries are summed in place.
        entries = fine.data.copy(), block, fine.indptr.copy()
        matrix = scipy.sparse.csr_matrix(entries, (fine.shape[0], size**2))
        matrix.sum_duplicates()
        return replace(self, operator=SparseOperator(matrix), texture_size=size)

    def take(self, chosen: Bool[Tensor, "P"]) -> "ViewPixels":
        """Some of the pixels."""
        matrix = self.operator.forward_matrix.scipy()[chosen.numpy()]
        return replace(
            self,
            operator=SparseOperator(matrix),
            pixel=self.pixel[chosen],
            target=self.target[chosen],
            weight=self.weight[chosen],
        )

    def of(self, channels: slice) -> "ViewPixels":
        """The same pixels with some of the target's channels."""
        return replace(self, target=self.target[:, channels])

    def mean(self) -> Float[Tensor, "C"]:
        """The one value that fits all pixels best: rows sum to one, so it is their mean."""
        weight = self.weight.double()
        total = (weight * self.target).sum(0) / weight.sum().clamp_min(1e-12)
        return total.to(self.target)

    def mass(self) -> Float[Tensor, "T"]:
        """Summed weight of the pixels that see each texel."""
        return self.operator.adjoint(self.weight)[:, 0]

    def known_to(self, others: "ViewPixels") -> Bool[Tensor, "P"]:
        """Pixels that show only texels which the others have seen, too."""
        seen = (others.mass() > 0).float()
        return self.operator(seen[:, None])[:, 0] > KNOWN

    def distinct(self) -> tuple[float, int]:
        """Pixels of the surface's parts, each part in the view that shows it largest; and texels.

        Returns:
            The number of pixels, and how many texels they see.
        """
        matrix = self.operator.forward_matrix.scipy()
        trusted = (self.weight[:, 0] > 0).numpy()
        view = self.view.numpy()
        largest = np.zeros(matrix.shape[1], np.float32)
        for index in np.unique(view):
            rows = matrix[trusted & (view == index)]
            seen = np.bincount(rows.indices, rows.data, matrix.shape[1]).astype(np.float32)
            np.maximum(largest, seen, out=largest)
        return float(largest.sum()), int((largest > 0).sum())

    def independent(self, residual: Float[Tensor, "P C"]) -> float:
        """How many independent pixels of equal weight say as much as all of these.

        Weights count by (sum w)^2 / sum w^2 (Kish); each pixel stands for the area within which
        residuals agree.

        Args:
            residual: what is left of the target when the richest model has explained its part.
        """
        weight = self.weight.double()
        equal = float(weight.sum() ** 2 / weight.square().sum().clamp_min(1e-12))
        return equal / self._correlation_area(residual)

    def _correlation_area(self, residual: Float[Tensor, "P C"]) -> float:
        """Integral of the residuals' autocorrelation in pixels, as a product of two axes.

        Large residuals are cut: those along an edge that a texture cannot draw would pass for
        noise that is smooth along the edge. What is below the floor counts as noise without any.
        """
        views, height, width = self.shape
        image = residual.new_zeros(views * height * width, residual.shape[1])
        known = residual.new_zeros(views * height * width, 1)
        trusted = self.weight[:, 0] > 0
        spread = residual[trusted].abs().median() if bool(trusted.any()) else residual.new_zeros(())
        limit = OUTLIER * float(spread) + FLOOR_RMS
        image[self.pixel] = residual.clamp(-limit, limit) * trusted[:, None]
        known[self.pixel] = trusted[:, None].to(residual)
        image, known = image.view(*self.shape, -1), known.view(*self.shape, 1)
        return math.prod(_correlation_length(image, known, axis) for axis in (1, 2))


def _correlation_length(
    image: Float[Tensor, "V H W C"], known: Float[Tensor, "V H W 1"], axis: int
) -> float:
    """1 + 2 sum of the correlations at growing lags along an axis, until they have died away."""
    length = 1.0
    for lag in range(1, round(MAX_LAG * image.shape[axis]) + 1):
        here, there = (
            (t.narrow(axis, 0, t.shape[axis] - lag), t.narrow(axis, lag, t.shape[axis] - lag))
            for t in (image, known)
        )
        both = there[0] * there[1]
        product = float((here[0] * here[1] * both).double().sum())
        floor = FLOOR_RMS**2 * float(both.sum()) * image.shape[-1]
        energies = [float((h.square() * both).double().sum()) + floor for h in here]
        energy = math.sqrt(energies[0] * energies[1])
        correlation = product / energy if energy > 0.0 else 0.0
        if correlation < MIN_CORRELATION:
            break
        length += 2.0 * correlation
    return length
