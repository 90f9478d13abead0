"""Octahedral maps: the sphere of directions on one square without poles or wasted corners.

The pole is the world's up axis: the centre of the map is +y, its four corners are -y, the inner
diamond is the sky. Columns run along +x, rows along +z, so a quarter turn about y is a quarter turn
of the square. Texel (row i, column j) of an n x n map is centred at u = (2j + 1)/n - 1,
v = (2i + 1)/n - 1.

Source: Engelhardt and Dachsbacher 2008, "Octahedron environment maps".
"""

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from svim3d.numerics import normalize

MIN_L1_NORM = 1e-12  # sends the zero vector (no surface there) to the pole instead of to NaN
DOUBLE = torch.empty(0, dtype=torch.float64)  # a `like` for tables that are built once


def _sign(x: Tensor) -> Tensor:
    """Sign that counts zero as positive, so that no point of the square is lost."""
    return torch.where(x >= 0, 1.0, -1.0).to(x.dtype)


def octahedral_from_direction(d: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 2"]:
    """Square coordinates (u, v) in [-1, 1] of directions of any length."""
    x, y, z = (d / d.abs().sum(-1, keepdim=True).clamp_min(MIN_L1_NORM)).unbind(-1)
    upper = y >= 0
    u = torch.where(upper, x, (1.0 - z.abs()) * _sign(x))
    v = torch.where(upper, z, (1.0 - x.abs()) * _sign(z))
    return torch.stack([u, v], -1)


def direction_from_octahedral(uv: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch 3"]:
    """Unit directions of square coordinates (u, v) in [-1, 1]."""
    u, v = uv.unbind(-1)
    y = 1.0 - u.abs() - v.abs()
    fold = (-y).clamp_min(0.0)
    return normalize(torch.stack([u - fold * _sign(u), y, v - fold * _sign(v)], -1))


def texel_directions(n: int, like: Tensor | None = None) -> Float[Tensor, "n n 3"]:
    """Unit directions of all texel centres, float32 on the CPU or as `like`."""
    axis = _texel_centres(n, like)
    v, u = torch.meshgrid(axis, axis, indexing="ij")
    return direction_from_octahedral(torch.stack([u, v], -1))


def texel_solid_angles(n: int, like: Tensor | None = None) -> Float[Tensor, "n n"]:
    """Exact solid angles of all texels of an even-sized map, steradian; they sum to 4 pi.

    Texel edges are straight on the octahedron and therefore great-circle arcs on the sphere. Each
    texel is cut along the diagonal parallel to the fold of its quadrant, so that either half lies
    on one face.
    """
    if n % 2:
        raise ValueError(f"an octahedral map needs an even size, got {n}")
    axis = torch.linspace(-1.0, 1.0, n + 1, dtype=torch.float64)
    v, u = torch.meshgrid(axis, axis, indexing="ij")
    corners = direction_from_octahedral(torch.stack([u, v], -1))
    a, b, c, d = corners[:-1, :-1], corners[:-1, 1:], corners[1:, 1:], corners[1:, :-1]
    main = _triangle_solid_angle(a, b, c) + _triangle_solid_angle(a, c, d)
    anti = _triangle_solid_angle(a, b, d) + _triangle_solid_angle(b, c, d)
    negative = axis[:-1] < 0
    omega = torch.where(negative[:, None] == negative[None, :], anti, main)
    return omega.float() if like is None else omega.to(like)


def bilinear_taps(
    d: Float[Tensor, "P 3"], n: int | Int[Tensor, "P"]
) -> tuple[Int[Tensor, "P 4"], Float[Tensor, "P 4"]]:
    """Flat texel indices and weights of the bilinear lookup of directions in an n x n map.

    `n` may differ from point to point. A tap beyond an edge is the texel that touches the same
    edge from the other side: the edge's own row or column, mirrored along the edge. So the seam
    behaves as the interior. The weights are differentiable in `d`.
    """
    x, y = (octahedral_from_direction(d) * 0.5 + 0.5).unbind(-1)
    x, y = x * n - 0.5, y * n - 0.5
    x0, y0 = x.detach().floor(), y.detach().floor()
    fx, fy = x - x0, y - y0
    indices, weights = [], []
    for dy, wy in ((0, 1.0 - fy), (1, fy)):
        for dx, wx in ((0, 1.0 - fx), (1, fx)):
            indices.append(_wrap(x0.long() + dx, y0.long() + dy, n))
            weights.append(wx * wy)
    return torch.stack(indices, -1), torch.stack(weights, -1)


def sample_octahedral(
    radiance: Float[Tensor, "n n c"], d: Float[Tensor, "P 3"]
) -> Float[Tensor, "P c"]:
    """Bilinear lookup, continuous over the whole sphere; differentiable in both arguments."""
    n, channels = radiance.shape[0], radiance.shape[-1]
    indices, weights = bilinear_taps(d, n)
    texels = radiance.reshape(-1, channels).index_select(0, indices.reshape(-1))
    return (texels.view(-1, 4, channels) * weights[..., None]).sum(1)


def total_variation(values: Float[Tensor, "n n c"]) -> Float[Tensor, ""]:
    """Mean absolute difference of texels that touch on the sphere, seams included."""
    inner = [values[1:] - values[:-1], values[:, 1:] - values[:, :-1]]
    # Along each edge of the square, a texel touches its mirror image in the edge's middle.
    edges = torch.stack([values[0], values[-1], values[:, 0], values[:, -1]])
    seams = [edges - edges.flip(1)]
    return torch.cat([d.abs().reshape(-1) for d in inner + seams]).mean()


def _texel_centres(n: int, like: Tensor | None) -> Float[Tensor, "n"]:
    """Coordinates of the n texel centres along one side, in [-1, 1]."""
    axis = (torch.arange(n, dtype=torch.float64) * 2.0 + 1.0) / n - 1.0
    return axis.float() if like is None else axis.to(like)


def _wrap(x: Int[Tensor, "P"], y: Int[Tensor, "P"], n: int | Int[Tensor, "P"]) -> Int[Tensor, "P"]:
    """Flat index of texel (row y, column x), both at most one beyond the square."""
    y = torch.where((x < 0) | (x >= n), n - 1 - y, y)
    x = torch.minimum(x.clamp_min(0), torch.as_tensor(n - 1, device=x.device))
    x = torch.where((y < 0) | (y >= n), n - 1 - x, x)
    y = torch.minimum(y.clamp_min(0), torch.as_tensor(n - 1, device=y.device))
    return y * n + x


def _triangle_solid_angle(
    a: Float[Tensor, "*batch 3"], b: Float[Tensor, "*batch 3"], c: Float[Tensor, "*batch 3"]
) -> Float[Tensor, "*batch"]:
    """Solid angle of spherical triangles with unit corners.

    Source: Van Oosterom and Strackee 1983, "The solid angle of a plane triangle".
    """
    volume = (a * torch.linalg.cross(b, c)).sum(-1).abs()
    scale = 1.0 + (a * b).sum(-1) + (b * c).sum(-1) + (c * a).sum(-1)
    return 2.0 * torch.atan2(volume, scale) % (4.0 * math.pi)
