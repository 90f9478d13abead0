"""Soft shadows on an object from itself: depth pictures from many directions, made once.

Each direction stands for its share of the sphere. A point sees it where nothing in that direction's
depth picture lies before the point. Both lobes are then scaled by the light that their seen
directions bring over what all of them would, and blocked directions bring the object's own mean
radiance. One set of depth pictures serves all views and lights.

Source: shadow maps after Williams 1978, "Casting curved shadows on curved surfaces"; the ratio of
lit to unlit shading after Heitz et al. 2018, "Combining analytic direct illumination and stochastic
shadows".
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import torch
from jaxtyping import Float, Int
from numba import prange
from numpy.typing import NDArray
from torch import Tensor

from svim3d.compiled import kernel
from svim3d.numerics import normalize, reflect
from svim3d.raster.zbuffer import rasterize
from svim3d.render.deferred import Geometry
from svim3d.shading.metallic_roughness import specular_f0
from svim3d.shading.microfacet import alpha_from_roughness
from svim3d.shading.prefilter import EnvironmentPyramid
from svim3d.synthesis.views import ViewSamples

DIRECTIONS = 80  # over the sphere; half of them lie before any point
MAP_SIZE = 80  # pixels a side of each depth picture, about a pixel of a 64-pixel view
REACH = 0.9  # half side of the depth pictures: an object with sides of at most 1 lies within
LIFT = 1.5 * 2.0 * REACH / MAP_SIZE  # off the surface, so that it does not shadow itself
SLACK = 0.5 * LIFT  # in depth, for the same reason
# GGX alpha of the lobe that is as high as one direction's share of the sphere: 1 / (4 pi alpha^2).
SHARE_ALPHA = 1.0 / math.sqrt(DIRECTIONS)
GOLDEN_ANGLE = math.pi * (3.0 - math.sqrt(5.0))
DARKEST = 1e-6  # light; below it shadows do not matter


@dataclass(frozen=True)
class DepthPictures:
    """What lies outermost in each direction.

    Attributes:
        frames: rows right, up and towards the light, for each direction.
        outermost: distance along the direction of the surface nearest to the light, over
            [-REACH, REACH]^2; minus infinity where there is none.
    """

    frames: Float[Tensor, "D 3 3"]
    outermost: Float[Tensor, "D n n"]

    @classmethod
    def of(cls, geometry: Geometry) -> Self:
        """Depth pictures of a mesh that lies within REACH of the origin."""
        frames = direction_frames(DIRECTIONS)
        local = geometry.vertices @ frames.transpose(1, 2) / REACH
        pictures = []
        for points in local:
            clip = torch.cat([points[:, :2], -points[:, 2:], torch.ones_like(points[:, :1])], 1)
            depth = rasterize(
                clip, geometry.faces, MAP_SIZE, MAP_SIZE, cull_backfaces=not geometry.two_sided
            ).depth
            pictures.append(REACH * (1.0 - 2.0 * depth))
        return cls(frames, torch.stack(pictures))


def direction_frames(count: int) -> Float[Tensor, "D 3 3"]:
    """Frames about directions spread evenly over the sphere. Source: Vogel's spiral."""
    index = torch.arange(count, dtype=torch.float64) + 0.5
    height = 1.0 - 2.0 * index / count
    radius, angle = (1.0 - height**2).sqrt(), index * GOLDEN_ANGLE
    forward = torch.stack([radius * angle.cos(), height, radius * angle.sin()], 1)
    upright = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64).expand_as(forward)
    right = normalize(torch.linalg.cross(upright, forward))
    return torch.stack([right, torch.linalg.cross(forward, right), forward], 1).float()


@dataclass(frozen=True)
class Shares:
    """What is left of each lobe at Q points under E lights.

    Attributes:
        diffuse: share of the unshadowed light, per light and channel.
        specular: the same of the specular lobe.
        open_diffuse: share of the lobe's directions that leave the object.
        open_specular: the same of the specular lobe.
    """

    diffuse: Float[Tensor, "Q E3"]
    specular: Float[Tensor, "Q E3"]
    open_diffuse: Float[Tensor, "Q 1"]
    open_specular: Float[Tensor, "Q 1"]


def shadowed_radiance(
    samples: ViewSamples, pictures: DepthPictures, lights: Sequence[EnvironmentPyramid]
) -> list[Float[Tensor, "P 3"]]:
    """Linear radiance of all samples under each light, shadowed by the object.

    Shadows are found once per pixel, for the first of its samples.
    """
    chosen, of_sample = _one_per_pixel(samples.pixel)
    position, normal = samples.position[chosen], samples.normal[chosen]
    mirrored = reflect(samples.wo[chosen], normal)
    alpha = alpha_from_roughness(samples.roughness[chosen])
    towards = pictures.frames[:, 2].contiguous()
    blur = math.sqrt(SHARE_ALPHA) * torch.ones(DIRECTIONS, 1)
    brought = torch.cat([light.specular(towards, blur) for light in lights], 1)
    shares = seen_shares(position, normal, mirrored, alpha, brought, pictures)
    f0 = specular_f0(samples.basecolor, samples.metallic)
    albedo = samples.basecolor * (1.0 - samples.metallic)
    blocked_diffuse = 1.0 - shares.open_diffuse[of_sample]
    blocked_specular = 1.0 - shares.open_specular[of_sample]
    results = []
    for index, light in enumerate(lights):
        channels = slice(3 * index, 3 * index + 3)
        shading = samples.shading(light)
        lit = shading.diffuse * shares.diffuse[of_sample, channels]
        lit = lit + shading.specular * shares.specular[of_sample, channels]
        # What is in the way shines as the object does on average.
        own = lit.mean(0)
        results.append(lit + own * (albedo * blocked_diffuse + f0 * blocked_specular))
    return results


def _one_per_pixel(pixel: Int[Tensor, "P"]) -> tuple[Int[Tensor, "Q"], Int[Tensor, "P"]]:
    """The first sample of every covered pixel, and which of those stands for each sample."""
    count = int(pixel.max()) + 1 if len(pixel) else 0
    order = torch.arange(len(pixel))
    first = torch.full((count,), len(pixel)).scatter_reduce_(0, pixel, order, "amin")
    covered = torch.nonzero(first < len(pixel))[:, 0]
    place = torch.zeros(count, dtype=torch.long)
    place[covered] = torch.arange(len(covered))
    return first[covered], place[pixel]


def seen_shares(
    position: Float[Tensor, "Q 3"],
    normal: Float[Tensor, "Q 3"],
    mirrored: Float[Tensor, "Q 3"],
    alpha: Float[Tensor, "Q 1"],
    brought: Float[Tensor, "D E3"],
    pictures: DepthPictures,
) -> Shares:
    """Shares of light that reach points, on the CPU; see `seen_shares_plainly`."""
    count, channels = len(position), brought.shape[1]
    diffuse, specular = torch.empty(count, channels), torch.empty(count, channels)
    openness = torch.empty(count, 2)
    _shares(
        tuple(t.contiguous().numpy() for t in (position, normal, mirrored, alpha)),
        brought.contiguous().numpy(),
        pictures.frames.contiguous().numpy(),
        pictures.outermost.contiguous().numpy(),
        (diffuse.numpy(), specular.numpy(), openness.numpy()),
    )
    return Shares(diffuse, specular, openness[:, :1], openness[:, 1:])


def seen_shares_plainly(
    position: Float[Tensor, "Q 3"],
    normal: Float[Tensor, "Q 3"],
    mirrored: Float[Tensor, "Q 3"],
    alpha: Float[Tensor, "Q 1"],
    brought: Float[Tensor, "D E3"],
    pictures: DepthPictures,
) -> Shares:
    """Shares of light that reach points, in plain torch: the twin of the compiled kernel.

    Args:
        position: world frame, on the object.
        normal: unit.
        mirrored: unit mirror directions of the view.
        alpha: GGX width.
        brought: light from each direction, E lights of three channels.
        pictures: of the object.
    """
    towards = pictures.frames[:, 2]
    lifted = position + LIFT * normal
    local = torch.einsum("dij,qj->qdi", pictures.frames, lifted)
    cell = ((local[..., :2] / REACH * 0.5 + 0.5) * MAP_SIZE).floor().long().clamp(0, MAP_SIZE - 1)
    column, row = cell[..., 0], MAP_SIZE - 1 - cell[..., 1]
    nearest = pictures.outermost[torch.arange(len(towards)), row, column]
    seen = (local[..., 2] + SLACK >= nearest).to(position)
    cosine = (normal @ towards.T).clamp_min(0.0)
    width = alpha**2 + SHARE_ALPHA**2
    lobe = torch.exp(2.0 * (mirrored @ towards.T - 1.0) / width) * (normal @ towards.T > 0.0)
    parts = []
    for weight in (cosine, lobe):
        total = (weight @ brought).clamp_min(DARKEST)
        parts.append((((weight * seen) @ brought) / total).clamp_max(1.0))
    for weight in (cosine, lobe):
        total = weight.sum(1, keepdim=True).clamp_min(DARKEST)
        parts.append((weight * seen).sum(1, keepdim=True) / total)
    return Shares(*parts)


@kernel(parallel=True)
def _shares(
    points: tuple[NDArray[Any], ...],
    brought: NDArray[np.float32],
    frames: NDArray[np.float32],
    outermost: NDArray[np.float32],
    out: tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]],
) -> None:
    position, normal, mirrored, alpha = points
    diffuse, specular, openness = out
    size, channels = outermost.shape[1], brought.shape[1]
    scale = 0.5 / REACH * size
    for q in prange(len(position)):
        x = position[q, 0] + LIFT * normal[q, 0]
        y = position[q, 1] + LIFT * normal[q, 1]
        z = position[q, 2] + LIFT * normal[q, 2]
        sharpness = 2.0 / (alpha[q, 0] * alpha[q, 0] + SHARE_ALPHA * SHARE_ALPHA)
        all_light = np.zeros((2, channels))
        seen_light = np.zeros((2, channels))
        every, open_part = np.zeros(2), np.zeros(2)
        for d in range(len(frames)):
            f = frames[d]
            cosine = normal[q, 0] * f[2, 0] + normal[q, 1] * f[2, 1] + normal[q, 2] * f[2, 2]
            if cosine <= 0.0:
                continue
            aligned = mirrored[q, 0] * f[2, 0] + mirrored[q, 1] * f[2, 1] + mirrored[q, 2] * f[2, 2]
            lobe = math.exp((aligned - 1.0) * sharpness)
            right = x * f[0, 0] + y * f[0, 1] + z * f[0, 2]
            up = x * f[1, 0] + y * f[1, 1] + z * f[1, 2]
            along = x * f[2, 0] + y * f[2, 1] + z * f[2, 2]
            column = min(max(math.floor(right * scale + 0.5 * size), 0), size - 1)
            row = size - 1 - min(max(math.floor(up * scale + 0.5 * size), 0), size - 1)
            seen = along + SLACK >= outermost[d, row, column]
            every[0] += cosine
            every[1] += lobe
            for c in range(channels):
                all_light[0, c] += cosine * brought[d, c]
                all_light[1, c] += lobe * brought[d, c]
            if seen:
                open_part[0] += cosine
                open_part[1] += lobe
                for c in range(channels):
                    seen_light[0, c] += cosine * brought[d, c]
                    seen_light[1, c] += lobe * brought[d, c]
        for c in range(channels):
            diffuse[q, c] = min(1.0, seen_light[0, c] / max(all_light[0, c], DARKEST))
            specular[q, c] = min(1.0, seen_light[1, c] / max(all_light[1, c], DARKEST))
        for k in range(2):
            openness[q, k] = open_part[k] / max(every[k], DARKEST)
