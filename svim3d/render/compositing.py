"""Front-to-back compositing of packed samples, with exact backward passes."""

from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numba import prange
from numpy.typing import NDArray
from torch import Tensor

from svim3d.compiled import kernel
from svim3d.render.march import Samples

Floats = NDArray[np.float32]
Ints = NDArray[np.int64]

MAX_OPACITY = 1.0 - 1e-6  # keeps the logarithm of what passes finite in the reference


def density_opacity(density: Float[Tensor, "*batch"], step: float) -> Float[Tensor, "*batch"]:
    """Opacity 1 - exp(-density step) of a homogeneous section."""
    return -torch.expm1(-density * step)


def surface_opacity(
    sdf: Float[Tensor, "N 1"],
    slope: Float[Tensor, "N 1"],
    step: float,
    sharpness: float,
) -> Float[Tensor, "N 1"]:
    """Opacity of a section of a ray through a signed distance.

    With P(f) = sigmoid(-sharpness f) the share still outside, a section that runs from f0 to f1
    absorbs (P(f0) - P(f1)) / P(f0), and nothing where the ray leaves the surface (f1 < f0).
    Source: Wang et al. 2021, "NeuS", eq. 13, with their sign of the distance turned.

    Args:
        sdf: distance at the section's middle, positive inside, world units.
        slope: its derivative along the ray.
        step: length of the section, world units.
        sharpness: inverse width of the transition, per world unit.
    """
    half_rise = torch.relu(slope) * (0.5 * step)
    # (P0 - P1) / P0 with P1 / P0 = exp(logP1 - logP0): stable where both shares vanish.
    log_ratio = torch.nn.functional.logsigmoid(
        -sharpness * (sdf + half_rise)
    ) - torch.nn.functional.logsigmoid(-sharpness * (sdf - half_rise))
    return -torch.expm1(log_ratio)


@kernel(parallel=True)
def _weights_kernel(opacity: Floats, starts: Ints, weights: Floats, passed: Floats) -> None:
    """Weight of each sample and the transmittance in front of it."""
    for ray in prange(len(starts) - 1):
        transmittance = np.float32(1.0)
        for i in range(starts[ray], starts[ray + 1]):
            passed[i] = transmittance
            weights[i] = transmittance * opacity[i]
            transmittance *= np.float32(1.0) - opacity[i]


@kernel(parallel=True)
def _weights_backward_kernel(
    opacity: Floats, passed: Floats, starts: Ints, grad_weights: Floats, grad: Floats
) -> None:
    """dw_j/da_i = T_i for j = i and -w_j / (1 - a_i) behind it, summed from the back."""
    for ray in prange(len(starts) - 1):
        behind = np.float32(0.0)  # sum over later j of grad_j w_j, relative to their entry
        for i in range(starts[ray + 1] - 1, starts[ray] - 1, -1):
            grad[i] = passed[i] * (grad_weights[i] - behind)
            behind = grad_weights[i] * opacity[i] + (np.float32(1.0) - opacity[i]) * behind


class _Weights(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, opacity: Tensor, starts: Tensor) -> Tensor:
        opacity = opacity.detach().contiguous()
        weights, passed = torch.empty_like(opacity), torch.empty_like(opacity)
        _weights_kernel(opacity.numpy(), starts.numpy(), weights.numpy(), passed.numpy())
        ctx.save_for_backward(opacity, passed, starts)
        return weights

    @staticmethod
    def backward(ctx: Any, grad_weights: Tensor) -> tuple[Tensor, None]:
        opacity, passed, starts = ctx.saved_tensors
        grad = torch.empty_like(opacity)
        _weights_backward_kernel(
            opacity.numpy(),
            passed.numpy(),
            starts.numpy(),
            grad_weights.contiguous().numpy(),
            grad.numpy(),
        )
        return grad, None


def composite_weights_reference(
    opacity: Float[Tensor, "N 1"], samples: Samples
) -> Float[Tensor, "N 1"]:
    """`composite_weights` in plain torch, on any device."""
    log_pass = torch.log1p(-opacity[:, 0].clamp_max(MAX_OPACITY)).double()
    before = torch.cumsum(log_pass, 0) - log_pass
    first = samples.starts[:-1].clamp_max(max(len(samples) - 1, 0))
    if not len(samples):
        return opacity
    transmittance = torch.exp(before - before[first][samples.ray]).to(opacity.dtype)
    return transmittance[:, None] * opacity


def composite_weights(opacity: Float[Tensor, "N 1"], samples: Samples) -> Float[Tensor, "N 1"]:
    """Share of the picture that each sample contributes: T_i a_i, T_i = prod_{j<i} (1 - a_j).

    Differentiable in `opacity`; a ray's weights sum to at most 1.
    """
    if opacity.device.type == "cpu" and opacity.dtype == torch.float32:
        weights: Tensor = _Weights.apply(opacity[:, 0], samples.starts)  # type: ignore[no-untyped-call]
        return weights[:, None]
    return composite_weights_reference(opacity, samples)


@kernel(parallel=True)
def _accumulate_kernel(weights: Floats, values: Floats, starts: Ints, out: Floats) -> None:
    for ray in prange(len(starts) - 1):
        for i in range(starts[ray], starts[ray + 1]):
            for channel in range(values.shape[1]):
                out[ray, channel] += weights[i] * values[i, channel]


@kernel(parallel=True)
def _accumulate_backward_kernel(
    weights: Floats,
    values: Floats,
    starts: Ints,
    grad_out: Floats,
    grad_weights: Floats,
    grad_values: Floats,
) -> None:
    for ray in prange(len(starts) - 1):
        for i in range(starts[ray], starts[ray + 1]):
            total = np.float32(0.0)
            for channel in range(values.shape[1]):
                total += grad_out[ray, channel] * values[i, channel]
                grad_values[i, channel] = grad_out[ray, channel] * weights[i]
            grad_weights[i] = total


class _Accumulate(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, weights: Tensor, values: Tensor, starts: Tensor) -> Tensor:
        weights, values = weights.detach().contiguous(), values.detach().contiguous()
        out = values.new_zeros(len(starts) - 1, values.shape[1])
        _accumulate_kernel(weights.numpy(), values.numpy(), starts.numpy(), out.numpy())
        ctx.save_for_backward(weights, values, starts)
        return out

    @staticmethod
    def backward(ctx: Any, grad_out: Tensor) -> tuple[Tensor, Tensor, None]:
        weights, values, starts = ctx.saved_tensors
        grad_weights, grad_values = torch.empty_like(weights), torch.empty_like(values)
        _accumulate_backward_kernel(
            weights.numpy(),
            values.numpy(),
            starts.numpy(),
            grad_out.contiguous().numpy(),
            grad_weights.numpy(),
            grad_values.numpy(),
        )
        return grad_weights, grad_values, None


def accumulate(
    weights: Float[Tensor, "N 1"], values: Float[Tensor, "N C"], samples: Samples
) -> Float[Tensor, "R C"]:
    """Weighted sum of the values of each ray's samples. Differentiable in both."""
    if weights.device.type == "cpu" and weights.dtype == torch.float32:
        summed: Tensor = _Accumulate.apply(weights[:, 0], values, samples.starts)  # type: ignore[no-untyped-call]
        return summed
    rays = len(samples.starts) - 1
    return values.new_zeros(rays, values.shape[1]).index_add(0, samples.ray, weights * values)
