"""Split-sum shading on the CPU: the compiled kernels as one differentiable operation.

Points are dealt to a number of chunks that depends on their count alone, and each chunk adds to its
own copy of the pyramid's gradient, so that the result does not depend on the number of threads.
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from svim3d.shading.directional_albedo import MultipleScattering, split_sum_table
from svim3d.shading.prefilter import EnvironmentPyramid
from svim3d.shading.split_sum_kernel import BROAD, OFF, SCALED, shade_backward, shade_forward

POINTS_PER_CHUNK = 4096  # large enough to repay one copy of the pyramid's gradient
MAX_CHUNKS = 32  # bounds the memory of those copies


def fused_shade(
    normal: Float[Tensor, "P 3"],
    wo: Float[Tensor, "P 3"],
    basecolor: Float[Tensor, "P 3"],
    roughness: Float[Tensor, "P 1"],
    metallic: Float[Tensor, "P 1"],
    pyramid: EnvironmentPyramid,
    *,
    multiple_scattering: MultipleScattering,
) -> tuple[Float[Tensor, "P 3"], Float[Tensor, "P 3"]]:
    """Diffuse and specular radiance; differentiable in everything, arguments as in `shade`."""
    layout = pyramid.layout
    levels = (
        torch.tensor(layout.roughness, dtype=normal.dtype).numpy(),
        np.array((*layout.sizes, layout.irradiance_size)),
        np.array(layout.offsets),
    )
    bounces = SCALED if multiple_scattering == "scaled" else BROAD if multiple_scattering else OFF
    settings = (split_sum_table(normal.device, normal.dtype).numpy(), bounces)
    points = (normal, wo, basecolor, roughness, metallic, pyramid.texels)
    shaded: tuple[Tensor, Tensor] = _Shade.apply(levels, settings, *points)  # type: ignore[no-untyped-call]
    return shaded


class _Shade(torch.autograd.Function):
    """Forward and backward kernels as one differentiable operation."""

    @staticmethod
    def forward(
        ctx: Any, levels: tuple[Any, ...], settings: tuple[Any, int], *inputs: Tensor
    ) -> tuple[Tensor, Tensor]:
        contiguous = [t.detach().contiguous() for t in inputs]
        ctx.levels, ctx.settings = levels, settings
        ctx.texels_wanted = inputs[-1].requires_grad
        ctx.save_for_backward(*contiguous)
        shaded = torch.empty_like(contiguous[0]), torch.empty_like(contiguous[0])
        *points, texels = contiguous
        shade_forward(_arrays(points), (texels.numpy(), *levels), *settings, _arrays(shaded))
        return shaded

    @staticmethod
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor | None, ...]:
        *points, texels = ctx.saved_tensors
        table, bounces = ctx.settings
        gradients = [torch.empty_like(t) for t in points]
        # Without a wanted gradient the copies are empty, which the kernel understands.
        chunks = _chunk_count(len(points[0]))
        copies = texels.new_zeros(chunks, len(texels) if ctx.texels_wanted else 0, 3)
        shade_backward(
            _arrays(points),
            (texels.numpy(), *ctx.levels),
            table,
            bounces,
            _arrays([g.contiguous() for g in upstream]),
            _arrays(gradients),
            copies.numpy(),
        )
        return None, None, *gradients, copies.sum(0) if ctx.texels_wanted else None


def _arrays(tensors: Sequence[Tensor]) -> Any:
    """The tensors' memory as a tuple of arrays."""
    return tuple(t.numpy() for t in tensors)


def _chunk_count(points: int) -> int:
    """Number of independent parts of the backward pass; even, so that two threads share them."""
    return min(MAX_CHUNKS, 2 * math.ceil(points / (2 * POINTS_PER_CHUNK)))
