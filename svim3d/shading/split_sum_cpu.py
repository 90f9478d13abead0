"""Split-sum shading on the CPU: the compiled kernels as one differentiable operation.

Points are dealt to a number of chunks that depends on their count alone, and each chunk adds to its
own copy of the pyramid's gradient, so that the result does not depend on the number of threads.
"""

import math
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from svim3d.shading.directional_albedo import split_sum_table
from svim3d.shading.prefilter import EnvironmentPyramid
from svim3d.shading.split_sum_kernel import shade_backward, shade_forward

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
    multiple_scattering: bool,
) -> tuple[Float[Tensor, "P 3"], Float[Tensor, "P 3"]]:
    """Diffuse and specular radiance; differentiable in everything, arguments as in `shade`."""
    layout = pyramid.layout
    constants = (
        split_sum_table(normal.device, normal.dtype).numpy(),
        torch.tensor(layout.roughness, dtype=normal.dtype).numpy(),
        np.array((*layout.sizes, layout.irradiance_size)),
        np.array(layout.offsets),
        multiple_scattering,
    )
    points = (normal, wo, basecolor, roughness, metallic, pyramid.texels)
    shaded: tuple[Tensor, Tensor] = _Shade.apply(constants, *points)  # type: ignore[no-untyped-call]
    return shaded


class _Shade(torch.autograd.Function):
    """Forward and backward kernels as one differentiable operation."""

    @staticmethod
    def forward(ctx: Any, constants: tuple[Any, ...], *inputs: Tensor) -> tuple[Tensor, Tensor]:
        contiguous = tuple(t.detach().contiguous() for t in inputs)
        ctx.constants, ctx.texels_wanted = constants, inputs[-1].requires_grad
        ctx.save_for_backward(*contiguous)
        diffuse, specular = torch.empty_like(contiguous[0]), torch.empty_like(contiguous[0])
        arguments: list[Any] = [t.numpy() for t in contiguous]
        arguments += [*constants, diffuse.numpy(), specular.numpy()]
        shade_forward(*arguments)
        return diffuse, specular

    @staticmethod
    def backward(
        ctx: Any, grad_diffuse: Tensor, grad_specular: Tensor
    ) -> tuple[Tensor | None, ...]:
        inputs: tuple[Tensor, ...] = ctx.saved_tensors
        gradients = [torch.empty_like(t) for t in inputs[:-1]]
        texels = inputs[-1]
        chunks = _chunk_count(len(inputs[0]))
        # Without a wanted gradient the copies are empty, which the kernel understands.
        copies = texels.new_zeros(chunks, len(texels) if ctx.texels_wanted else 0, 3)
        arguments: list[Any] = [t.numpy() for t in inputs]
        arguments += ctx.constants
        arguments += [g.contiguous().numpy() for g in (grad_diffuse, grad_specular)]
        arguments += [g.numpy() for g in (*gradients, copies)]
        shade_backward(*arguments)
        return None, *gradients, copies.sum(0) if ctx.texels_wanted else None


def _chunk_count(points: int) -> int:
    """Number of independent parts of the backward pass; even, so that two threads share them."""
    return min(MAX_CHUNKS, 2 * math.ceil(points / (2 * POINTS_PER_CHUNK)))
