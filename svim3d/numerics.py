"""Guarded elementary operations shared by the whole library."""

from jaxtyping import Float
from torch import Tensor

MIN_NORM_SQUARED = 1e-20  # keeps the gradient of |v| finite at v = 0 in float32


def dot(a: Float[Tensor, "*batch n"], b: Float[Tensor, "*batch n"]) -> Float[Tensor, "*batch 1"]:
    """Inner product over the last axis, which is kept."""
    return (a * b).sum(-1, keepdim=True)


def length(v: Float[Tensor, "*batch n"]) -> Float[Tensor, "*batch 1"]:
    """Euclidean length over the last axis, which is kept; its gradient is finite at zero."""
    return (v * v).sum(-1, keepdim=True).clamp_min(MIN_NORM_SQUARED).sqrt()


def normalize(v: Float[Tensor, "*batch n"]) -> Float[Tensor, "*batch n"]:
    """Unit vectors along the last axis; the zero vector stays zero."""
    return v / length(v)


def saturate(x: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """Clamp to [0, 1]."""
    return x.clamp(0.0, 1.0)


def reflect(
    wo: Float[Tensor, "*batch 3"], normal: Float[Tensor, "*batch 3"]
) -> Float[Tensor, "*batch 3"]:
    """Mirror direction of `wo` about a unit `normal`; both leave the surface."""
    return 2.0 * dot(wo, normal) * normal - wo


def smoothstep(x: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """Hermite step 3x^2 - 2x^3 of `x` clamped to [0, 1]."""
    t = saturate(x)
    return t * t * (3.0 - 2.0 * t)
