"""Random choices: everything invented here is drawn from one generator, so a seed tells it all."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import torch
from jaxtyping import Float
from torch import Tensor

from svim3d.numerics import normalize

T = TypeVar("T")


@dataclass(frozen=True)
class Dice:
    """Draws from a generator on the CPU, which every draw advances.

    Attributes:
        generator: the source of all draws.
    """

    generator: torch.Generator

    @classmethod
    def of(cls, seed: int, index: int) -> "Dice":
        """The dice of one of many independent things made under one seed."""
        # Neighbouring seeds of the generator are independent; the factor keeps pairs apart.
        return cls(torch.Generator().manual_seed((seed * 1_000_003 + index) % (1 << 63)))

    def uniform(self, low: float, high: float) -> float:
        """A number, evenly from [low, high)."""
        return low + (high - low) * float(torch.rand((), generator=self.generator))

    def logarithmic(self, low: float, high: float) -> float:
        """A positive number whose logarithm is even over [log low, log high)."""
        return math.exp(self.uniform(math.log(low), math.log(high)))

    def integer(self, low: int, high: int) -> int:
        """A whole number, evenly from low to high, both included."""
        return int(torch.randint(low, high + 1, (), generator=self.generator))

    def chance(self, probability: float) -> bool:
        """True as often as `probability` says."""
        return self.uniform(0.0, 1.0) < probability

    def choice(self, options: Sequence[T], weights: Sequence[float] | None = None) -> T:
        """One of the options; evenly, or by weights that need not sum to 1."""
        shares = torch.ones(len(options)) if weights is None else torch.tensor(weights)
        return options[int(torch.multinomial(shares, 1, generator=self.generator))]

    def uniforms(self, low: float, high: float, *shape: int) -> Float[Tensor, "..."]:
        """Numbers, evenly from [low, high)."""
        return low + (high - low) * torch.rand(*shape, generator=self.generator)

    def direction(self) -> Float[Tensor, "3"]:
        """A unit vector, evenly over the sphere."""
        return normalize(torch.randn(3, generator=self.generator))
