"""What an environment pyramid holds: its levels, and how each is filtered.

Two profiles: `optimisation`, for a map that changes every step, and `relighting`, for a map that is
filtered once and looked at closely. Three modes of either:

- `sampled`: the paper's scheme, a few importance samples per texel.
- `exact`: the lobes' integrals, to one standard at every roughness.
- `hybrid`: samples where the lobe is hardly wider than a texel, above that the integrals, with side
  and accuracy of every level on the front of error against time (`benchmarks/bench_prefilter.py`).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal

PrefilterMode = Literal["sampled", "exact", "hybrid"]
PrefilterProfile = Literal["optimisation", "relighting"]
SMALLEST_MIP = 4  # a 4 x 4 map still tells up from down
LARGEST_SIZE = 1024  # beyond it an operator takes gigabytes
SMALLEST_LEVEL = 8  # keeps the widest lobe's gradient
IRRADIANCE_SIZE = 32  # at the map's creases bilinear lookup is off by half a texel's slope

PAPER_ROUGHNESS = (0.25, 0.5, 0.75, 1.0)  # Source: SViM3D, section 4: l / 4
PAPER_COUNTS = (4, 16, 24, 24)  # Source: SViM3D, section 4; level 0 is not filtered
PAPER_IRRADIANCE_COUNT = 16  # Source: SViM3D, section 4
PAPER_RELIGHT_ROUGHNESS = tuple(level / 7 for level in range(1, 8))  # Source: SViM3D, section 4
# The paper says "up to 256"; doubled from level to level until there.
PAPER_RELIGHT_COUNTS = (16, 32, 64, 128, 256, 256, 256)
PAPER_RELIGHT_IRRADIANCE_COUNT = 256

# Steps of about two in lobe width keep the blend of two levels within 2 % under a broad light.
ROUGHNESS = (0.1, 0.18, 0.25, 0.35, 0.5, 0.7, 1.0)
EXACT_SHIFTS = (0, 1, 1, 2, 2, 2, 2)  # a texel is at most half as wide as the level's lobe
EXACT_ACCURACIES = (0.7, 0.7, 0.7, 0.35, 0.35, 0.35, 0.35)  # coarse levels are cheap to do well
EXACT_RELIGHT_SHIFTS = (0, 0, 1, 1, 2, 2, 2)
EXACT_RELIGHT_ACCURACIES = (0.7, 0.5, 0.5, 0.35, 0.25, 0.25, 0.25)
LOD_BIAS = 1.0  # one mip coarser than one sample's share: halves the error at 4 to 256 samples


@dataclass(frozen=True)
class Samples:
    """A level filtered by importance sampling.

    Attributes:
        count: directions per texel.
        lod_bias: mips coarser than a sample's share of the lobe at which it is read.
    """

    count: int
    lod_bias: float = LOD_BIAS


@dataclass(frozen=True)
class Integral:
    """A level filtered by quadrature of the lobe; see `lobe_quadrature.exact_rows`."""

    accuracy: float


@dataclass(frozen=True)
class Level:
    """One level of a pyramid.

    Attributes:
        roughness: perceptual roughness of the GGX lobe, or None for the cosine lobe (irradiance).
        size: side of the level's octahedral map.
        filter: how its texels come about.
    """

    roughness: float | None
    size: int
    filter: Samples | Integral


# Sides do not grow with the map's: a level needs no more texels than its lobe has detail.
HYBRID = (
    # The lobe is as wide as a texel of a 128^2 map: more than bilinear lookup would blur it.
    Level(0.1, 128, Samples(8, lod_bias=-2.0)),
    Level(0.18, 64, Integral(0.7)),
    Level(0.25, 64, Integral(0.7)),
    Level(0.35, 32, Integral(0.35)),
    Level(0.5, 32, Integral(0.25)),
    Level(0.7, 32, Integral(0.25)),
    Level(1.0, 16, Integral(0.25)),
    Level(None, 32, Integral(0.25)),
)
HYBRID_RELIGHT = (
    Level(0.1, 256, Integral(0.7)),
    Level(0.18, 128, Integral(0.7)),
    Level(0.25, 128, Integral(0.5)),
    Level(0.35, 64, Integral(0.35)),
    Level(0.5, 64, Integral(0.25)),
    Level(0.7, 32, Integral(0.18)),
    Level(1.0, 32, Integral(0.18)),
    Level(None, 32, Integral(0.18)),
)


@dataclass(frozen=True)
class PrefilterSpec:
    """Which pyramid to make of which maps.

    Attributes:
        size: side of the octahedral map, a power of two.
        mode: how the lobes are integrated.
        profile: what the pyramid is for.

    Raises:
        ValueError: `size` is not a power of two from 8 to LARGEST_SIZE.
    """

    size: int
    mode: PrefilterMode = "exact"
    profile: PrefilterProfile = "optimisation"

    def __post_init__(self) -> None:
        if self.size < 2 * SMALLEST_MIP or self.size & (self.size - 1) or self.size > LARGEST_SIZE:
            raise ValueError(
                f"the environment's size must be a power of two >= 8 and <= {LARGEST_SIZE}, "
                f"got {self.size}; resample the map"
            )

    def levels(self) -> tuple[Level, ...]:
        """All levels after the map itself, by roughness; the irradiance map comes last."""
        return tuple(
            # The irradiance map keeps its side, whatever the map's.
            level if level.roughness is None else replace(level, size=min(level.size, self.size))
            for level in _plan(self)
        )


def _plan(spec: PrefilterSpec) -> tuple[Level, ...]:
    """Levels before their sides are limited to the map's."""
    shifts: tuple[int, ...]
    relight = spec.profile == "relighting"
    if spec.mode == "hybrid":
        return HYBRID_RELIGHT if relight else HYBRID
    if spec.mode == "exact":
        shifts = EXACT_RELIGHT_SHIFTS if relight else EXACT_SHIFTS
        accuracies = EXACT_RELIGHT_ACCURACIES if relight else EXACT_ACCURACIES
        filters: list[Samples | Integral] = [Integral(accuracy) for accuracy in accuracies]
        last = Level(None, IRRADIANCE_SIZE, filters[-1])
        return (*_halved(spec.size, ROUGHNESS, shifts, filters), last)
    roughness = PAPER_RELIGHT_ROUGHNESS if relight else PAPER_ROUGHNESS
    counts = PAPER_RELIGHT_COUNTS if relight else PAPER_COUNTS
    irradiance = PAPER_RELIGHT_IRRADIANCE_COUNT if relight else PAPER_IRRADIANCE_COUNT
    shifts = tuple(range(1, len(roughness) + 1))  # each level has half the side of the one before
    last = Level(None, IRRADIANCE_SIZE, Samples(irradiance))
    return (*_halved(spec.size, roughness, shifts, [Samples(count) for count in counts]), last)


def _halved(
    size: int,
    roughness: tuple[float, ...],
    shifts: tuple[int, ...],
    filters: Sequence[Samples | Integral],
) -> Iterator[Level]:
    """Levels whose sides are `size` halved `shifts` times."""
    for rough, shift, filtering in zip(roughness, shifts, filters, strict=True):
        yield Level(rough, max(size >> shift, SMALLEST_LEVEL), filtering)
