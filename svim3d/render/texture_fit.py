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
    """The matrix of every pixel that one smooth piece of surface covers wholly, in all views."""
    per_view = cameras.height * cameras.width
    blocks, pixels, trusts = [], [], []
    for view in range(len(cameras)):
        block, pixel, trust = _one_view(vertices, faces, uv, cameras[view], texture_size)
        blocks.append(block)
        pixels.append(pixel + view * per_view)
        trusts.append(trust)
    matrix = scipy.sparse.vstack(blocks).tocsr()
    return TexelView(SparseOperator(matrix), torch.cat(pixels), torch.cat(trusts)[:, None])


def _one_view(
    vertices: Tensor, faces: Tensor, uv: Tensor, camera: Cameras, texture_size: int
) -> tuple[scipy.sparse.csr_matrix, Tensor, Tensor]:
    """Rows of one view, their pixels, and the cosine under which each sees the surface."""
    samples = SAMPLES_PER_AXIS**2
    height, width = camera.height * SAMPLES_PER_AXIS, camera.width * SAMPLES_PER_AXIS
    clip = camera.project(vertices)[0]
    fragments = rasterize(clip, faces, height, width)
    sample, values = interpolate(clip, faces, fragments, torch.cat([uv, vertices], 1))
    row, column = sample // width // SAMPLES_PER_AXIS, sample % width // SAMPLES_PER_AXIS
    pixel = row * camera.width + column

    to_viewer = camera.positions - values[:, 2:]
    face = fragments.triangle.reshape(-1)[sample].long()
    normal = normalize(face_normals_scaled(vertices, faces))[face]
    cosine = dot(normal, normalize(to_viewer))[:, 0]
    whole, trust = _whole_pixels(pixel, to_viewer.norm(dim=1), cosine, camera.height * camera.width)
    kept = torch.nonzero(whole)[:, 0]
    row_of = torch.full((len(whole),), -1).index_copy(0, kept, torch.arange(len(kept)))
    inside = torch.nonzero(whole[pixel])[:, 0]
    texel, weight = bilinear_taps(values[inside, :2], texture_size, texture_size)
    rows = row_of[pixel[inside]][:, None].expand_as(texel)
    entries = (weight / samples).reshape(-1).numpy()
    places = rows.reshape(-1).numpy(), texel.reshape(-1).numpy()
    block = scipy.sparse.csr_matrix((entries, places), (len(kept), texture_size**2))
    return block, kept, trust[kept]


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
    whole = (hits == SAMPLES_PER_AXIS**2) & (farthest - nearest < MAX_DEPTH_SPREAD)
    return whole, mean


def fit_texels(
    operator: SparseOperator,
    target: Float[Tensor, "P C"],
    weight: Float[Tensor, "P 1"],
    start: Float[Tensor, "T C"],
    *,
    prior: float,
    iterations: int,
) -> Float[Tensor, "T C"]:
    """Texels that minimise sum w (A x - target)^2 + prior sum (x - start)^2, per channel.

    Conjugate gradients on the normal equations, one system per channel with its own step lengths.
    Few iterations regularise as the prior does: what the views determine well comes first.
    """
    residual = operator.adjoint(weight * (target - operator(start)))
    change = torch.zeros_like(start)
    direction = residual
    energy = residual.square().sum(0)
    tiny = torch.finfo(energy.dtype).tiny  # a channel that is already exact divides zero by it
    for _ in range(iterations):
        product = operator.adjoint(weight * operator(direction)) + prior * direction
        step = energy / (direction * product).sum(0).clamp_min(tiny)
        change = change + step * direction
        residual = residual - step * product
        previous, energy = energy, residual.square().sum(0)
        direction = residual + energy / previous.clamp_min(tiny) * direction
    return start + change
