"""Sharpen baked textures against the views they came from: a linear least-squares problem.

A pixel is the mean of the texture over its footprint, so a view is a fixed matrix times the texels
once geometry stands. A field fitted at pixel centres holds the views' blur, and a texture baked
from it is blurred again when rendered; solving for the texels takes that blur out. Texels that no
view sees keep their baked value.
"""

from dataclasses import dataclass

import scipy.sparse
import torch
from jaxtyping import Float, Int
from torch import Tensor

from svim3d.cameras import Cameras
from svim3d.mesh.mesh import face_normals_scaled
from svim3d.numerics import dot, normalize
from svim3d.raster.interpolation import interpolate
from svim3d.raster.texture import bilinear_taps
from svim3d.raster.zbuffer import rasterize
from svim3d.shading.linear_operator import SparseOperator

SAMPLES_PER_AXIS = 3  # of a pixel; texels are about a third of a pixel wide
MAX_DEPTH_SPREAD = 0.02  # world units inside one pixel; beyond it the pixel holds two surfaces


@dataclass(frozen=True)
class TexelView:
    """Pixels of several views as linear functions of the texels.

    Attributes:
        operator: [pixels, texels]; rows sum to one.
        pixel: flat index into all views' pixels.
        trust: cosine between the surface and the viewer.
    """

    operator: SparseOperator
    pixel: Int[Tensor, "P"]
    trust: Float[Tensor, "P 1"]


def texel_view(
    vertices: Float[Tensor, "N 3"],
    faces: Int[Tensor, "F 3"],
    uv: Float[Tensor, "N 2"],
    cameras: Cameras,
    *,
    texture_size: int,
) -> TexelView:
    """The matrix of every pixel that a single smooth piece of surface covers wholly."""
    samples = SAMPLES_PER_AXIS**2
    per_view = cameras.height * cameras.width
    face_normal = normalize(face_normals_scaled(vertices, faces))
    blocks, pixels, trusts = [], [], []
    for view in range(len(cameras)):
        clip = cameras[view].project(vertices)[0]
        size = cameras.height * SAMPLES_PER_AXIS, cameras.width * SAMPLES_PER_AXIS
        fragments = rasterize(clip, faces, *size)
        at, values = interpolate(clip, faces, fragments, torch.cat([uv, vertices], 1))
        row = at // size[1] // SAMPLES_PER_AXIS
        column = at % size[1] // SAMPLES_PER_AXIS
        pixel = row * cameras.width + column
        to_viewer = cameras.positions[view] - values[:, 2:]
        normal = face_normal[fragments.triangle.reshape(-1)[at].long()]
        cosine = dot(normal, normalize(to_viewer))[:, 0]
        whole, mean_cosine = _whole_pixels(pixel, to_viewer.norm(dim=1), cosine, per_view)
        kept = torch.nonzero(whole)[:, 0]
        row_of = torch.full((per_view,), -1).index_copy(0, kept, torch.arange(len(kept)))
        inside = torch.nonzero(whole[pixel])[:, 0]
        texel, weight = bilinear_taps(values[inside, :2], texture_size, texture_size)
        rows = row_of[pixel[inside]][:, None].expand_as(texel)
        blocks.append(
            scipy.sparse.csr_matrix(
                (
                    (weight / samples).reshape(-1).numpy(),
                    (rows.reshape(-1).numpy(), texel.reshape(-1).numpy()),
                ),
                (len(kept), texture_size**2),
            )
        )
        pixels.append(kept + view * per_view)
        trusts.append(mean_cosine[kept])
    matrix = scipy.sparse.vstack(blocks).tocsr()
    return TexelView(SparseOperator(matrix), torch.cat(pixels), torch.cat(trusts)[:, None])


def _whole_pixels(
    pixel: Int[Tensor, "S"],
    distance: Float[Tensor, "S"],
    cosine: Float[Tensor, "S"],
    count: int,
) -> tuple[Tensor, Tensor]:
    """Which pixels all samples hit at one depth, and the mean cosine of each."""
    hits = torch.bincount(pixel, minlength=count)
    nearest = torch.full((count,), torch.inf).scatter_reduce(0, pixel, distance, "amin")
    farthest = torch.zeros(count).scatter_reduce(0, pixel, distance, "amax")
    mean = torch.bincount(pixel, weights=cosine.double(), minlength=count).float() / hits.clamp(1)
    # A slanted surface spans depth in proportion to the pixel; that is no edge.
    whole = (hits == SAMPLES_PER_AXIS**2) & (farthest - nearest < MAX_DEPTH_SPREAD)
    return whole, mean


def fit_texels(
    seen: TexelView,
    target: Float[Tensor, "P C"],
    weight: Float[Tensor, "P C"],
    start: Float[Tensor, "T C"],
    *,
    prior: float,
    iterations: int,
) -> Float[Tensor, "T C"]:
    """Texels that minimise sum w (A x - target)^2 + prior sum (x - start)^2, per channel.

    Conjugate gradients on the normal equations, one system per channel with its own step lengths.
    Few iterations regularise as the prior does: what the views determine well comes first.
    """
    apply, adjoint = seen.operator, seen.operator.adjoint
    residual = adjoint(weight * (target - apply(start)))
    change = torch.zeros_like(start)
    direction = residual.clone()
    energy = residual.square().sum(0)
    for _ in range(iterations):
        product = adjoint(weight * apply(direction)) + prior * direction
        step = energy / (direction * product).sum(0).clamp_min(torch.finfo(energy.dtype).tiny)
        change = change + step * direction
        residual = residual - step * product
        previous, energy = energy, residual.square().sum(0)
        direction = residual + energy / previous.clamp_min(torch.finfo(energy.dtype).tiny) * direction
    return start + change
