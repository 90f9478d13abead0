"""Environment maps: between the lat-long pictures of files and the octahedral maps of the renderer.

Lat-long convention: u = atan2(d.x, -d.z)/(2 pi) + 0.5, v = acos(d.y)/pi; the image centre is -z,
right of the centre is +x, the top row is +y. Radiance is linear, unbounded, Rec.709 primaries.
"""

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from svim3d.shading.octahedral import sample_octahedral, texel_directions
from svim3d.shading.resampling import SphereCells, octahedral_from_cells, weighted_blocks

CHUNK_SAMPLES = 1 << 20  # sub-samples held in memory at a time while resampling
MIN_SUBDIVISION = 2  # samples per texel side, so that a texel is a mean and not a point
SLENDER = 0.25  # width over height of a texel from which a row's texels are merged in pairs


def latlong_from_direction(d: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 2"]:
    """Picture coordinates (u, v) in [0, 1] of unit directions."""
    u = torch.atan2(d[..., 0], -d[..., 2]) / (2.0 * math.pi) + 0.5
    return torch.stack([u, torch.acos(d[..., 1].clamp(-1.0, 1.0)) / math.pi], -1)


def direction_from_latlong(uv: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch 3"]:
    """Unit directions of picture coordinates (u, v) in [0, 1]."""
    azimuth = (uv[..., 0] - 0.5) * (2.0 * math.pi)
    polar = uv[..., 1] * math.pi
    sine = torch.sin(polar)
    return torch.stack([sine * azimuth.sin(), polar.cos(), -sine * azimuth.cos()], -1)


def sample_latlong(
    latlong: Float[Tensor, "H W c"], d: Float[Tensor, "*batch 3"]
) -> Float[Tensor, "*batch c"]:
    """Bilinear lookup; wraps around in u and crosses the poles into the opposite meridian."""
    height, width, channels = latlong.shape
    index, weight = latlong_taps(d.reshape(-1, 3), height, width)
    found = (latlong.reshape(-1, channels)[index] * weight[..., None]).sum(1)
    return found.view(*d.shape[:-1], channels)


def latlong_taps(
    d: Float[Tensor, "P 3"], height: int, width: int
) -> tuple[Int[Tensor, "P 4"], Float[Tensor, "P 4"]]:
    """Flat texel indices and weights of a bilinear lookup that keeps energy.

    Rows towards a pole are shorter than those away from it, so that plain bilinear weights give
    the row at the pole 8 % more of the sphere than its texels cover. Between two rows the weight
    is therefore bent by k t (1 - t), k = (row height / 4) cot(angle of their common edge), which
    gives every row what is its own, up to the row height squared.
    """
    uv = latlong_from_direction(d)
    x = uv[..., 0] * width - 0.5
    y = uv[..., 1] * height - 0.5
    x0, y0 = x.floor(), y.floor()
    fx, fy = x - x0, y - y0
    edge = (y0 + 1.0) * (math.pi / height)
    inside = (y0 >= 0) & (y0 < height - 1)  # across a pole both rows are alike
    bend = torch.where(inside, (0.25 * math.pi / height) / torch.tan(edge), 0.0)
    fy = fy + bend * fy * (1.0 - fy)
    indices, weights = [], []
    for dy, wy in ((0, 1.0 - fy), (1, fy)):
        for dx, wx in ((0, 1.0 - fx), (1, fx)):
            row, column = y0.long() + dy, x0.long() + dx
            beyond = (row < 0) | (row >= height)
            column = torch.where(beyond, column + width // 2, column) % width
            indices.append(row.clamp(0, height - 1) * width + column)
            weights.append(wx * wy)
    return torch.stack(indices, -1), torch.stack(weights, -1)


def octahedral_from_latlong(
    latlong: Float[Tensor, "H W 3"], size: int
) -> Float[Tensor, "size size 3"]:
    """Resample a lat-long picture; every texel is the mean radiance over its solid angle.

    The integral over the sphere is kept exactly. `size` is even.
    """
    return octahedral_from_cells(latlong_cells(latlong), size)


def latlong_cells(latlong: Float[Tensor, "H W c"]) -> SphereCells:
    """The texels of a lat-long picture; near the poles 2, 4, 8, ... neighbours of a row are one.

    Merging loses nothing: those texels are so slender that the merged cell is still narrower than
    it is high. Unmerged, a lamp of one of them would fall between all samples.
    """
    height, width, channels = latlong.shape
    # Texels of a row are this wide, in units of their height.
    middle = (torch.arange(height, dtype=torch.float64) + 0.5) * (math.pi / height)
    aspect = torch.sin(middle) * (2.0 * height / width)
    pairs = torch.floor(torch.log2(2.0 * SLENDER / aspect)).clamp(0.0, 30.0)
    merged = (2.0**pairs).long().clamp_max(width)[:, None]
    column = torch.arange(width)[None, :] // merged
    flat = (torch.arange(height)[:, None] * width + column).flatten()
    _, cell = torch.unique(flat, return_inverse=True)
    cell = cell.to(latlong.device)
    omega = latlong_solid_angles(height, width, latlong.double()).reshape(-1, 1)
    count = int(cell.max()) + 1
    solid_angles = omega.new_zeros(count, 1).index_add_(0, cell, omega)
    energy = omega.new_zeros(count, channels)
    energy.index_add_(0, cell, latlong.reshape(-1, channels).double() * omega)

    def taps(d: Float[Tensor, "P 3"]) -> tuple[Int[Tensor, "P 4"], Float[Tensor, "P 4"]]:
        index, weight = latlong_taps(d, height, width)
        return cell[index], weight

    side = min(math.pi / height, 2.0 * math.pi / width)
    return SphereCells((energy / solid_angles).to(latlong), solid_angles, taps, side)


def latlong_from_octahedral(
    octahedral: Float[Tensor, "n n 3"], *, height: int
) -> Float[Tensor, "height width 3"]:
    """Resample to a lat-long picture of width 2 height; texels are means over their solid angle."""
    subdivision = max(MIN_SUBDIVISION, math.ceil(2.0 * octahedral.shape[0] / height))
    n = height * subdivision
    rows = []
    centres = _texel_centres(n, 2 * n, octahedral)
    for uv in torch.split(centres, _rows_per_chunk(subdivision, 2 * n)):
        directions = direction_from_latlong(uv)
        radiance = sample_octahedral(octahedral, directions.reshape(-1, 3)).view_as(directions)
        rows.append(weighted_blocks(radiance, torch.sin(uv[..., 1:] * math.pi), subdivision))
    return torch.cat(rows)


def downsample_latlong(latlong: Float[Tensor, "H W c"], factor: int) -> Float[Tensor, "h w c"]:
    """Solid-angle weighted mean of factor x factor texels; both sides must divide evenly."""
    height, width, _ = latlong.shape
    if height % factor or width % factor:
        raise ValueError(f"a {height} x {width} picture cannot be cut into {factor}-texel blocks")
    return weighted_blocks(latlong, latlong_solid_angles(height, width, latlong), factor)


def blurred_latlong(
    latlong: Float[Tensor, "H W c"], *, height: int
) -> Float[Tensor, "height width c"]:
    """Low-pass to `height` rows: a Gaussian of half a texel's width about every texel centre.

    Unlike block means it does not depend on which side of a block's edge a small lamp falls: the
    means of one map and of the same map resampled to 128^2 differ by 17 %, these by 1 %.
    """
    rows, columns, channels = latlong.shape
    directions = direction_from_latlong(_texel_centres(rows, columns, latlong)).view(-1, 3)
    energy = latlong * latlong_solid_angles(rows, columns, latlong)
    omega = latlong_solid_angles(rows, columns, latlong).reshape(-1, 1)
    axes = direction_from_latlong(_texel_centres(height, 2 * height, latlong)).view(-1, 3)
    width = 0.5 * math.pi / height
    blurred = []
    for chunk in torch.split(axes, 128):
        kernel = torch.exp((chunk @ directions.T - 1.0) / width**2)
        blurred.append(kernel @ energy.reshape(-1, channels) / (kernel @ omega))
    return torch.cat(blurred).view(height, 2 * height, channels)


def latlong_solid_angles(height: int, width: int, like: Tensor) -> Float[Tensor, "height width 1"]:
    """Exact solid angles of lat-long texels, steradian; they sum to 4 pi."""
    edges = torch.cos(torch.linspace(0.0, math.pi, height + 1, dtype=torch.float64))
    rows = (edges[:-1] - edges[1:]) * (2.0 * math.pi / width)
    return rows.to(like)[:, None, None].expand(height, width, 1)


def rotate_about_y(
    octahedral: Float[Tensor, "n n c"], azimuth_deg: float
) -> Float[Tensor, "n n c"]:
    """Turn the light counter-clockwise seen from above: light from +z comes from +x after 90.

    Bilinear; exact at multiples of 90 degrees.
    """
    angle = math.radians(azimuth_deg)
    cosine, sine = math.cos(angle), math.sin(angle)
    x, y, z = texel_directions(octahedral.shape[0], octahedral).unbind(-1)
    source = torch.stack([cosine * x - sine * z, y, sine * x + cosine * z], -1)
    return sample_octahedral(octahedral, source.reshape(-1, 3)).view_as(octahedral)


def physical_radiance(
    radiance: Float[Tensor, "*shape 3"],
) -> tuple[Float[Tensor, "*shape 3"], int]:
    """Radiance that can exist, and how many texels had to be mended.

    Compressed HDR files ring below zero beside lamps and overflow in the sun: negative values and
    NaN become zero, infinity the largest finite value.
    """
    valid = torch.isfinite(radiance) & (radiance >= 0.0)
    brightest = torch.where(valid, radiance, torch.zeros_like(radiance)).max()
    overflow = radiance == math.inf
    mended = torch.where(valid, radiance, torch.where(overflow, brightest, 0.0))
    return mended, int((~valid.all(-1)).sum())


def _texel_centres(height: int, width: int, like: Tensor) -> Float[Tensor, "height width 2"]:
    """Picture coordinates (u, v) in [0, 1] of all texel centres."""
    v_axis = ((torch.arange(height, dtype=torch.float64) + 0.5) / height).to(like)
    u_axis = ((torch.arange(width, dtype=torch.float64) + 0.5) / width).to(like)
    v, u = torch.meshgrid(v_axis, u_axis, indexing="ij")
    return torch.stack([u, v], -1)


def _rows_per_chunk(subdivision: int, width: int) -> int:
    """Rows of sub-samples per chunk: whole texels, bounded memory."""
    return subdivision * max(1, CHUNK_SAMPLES // (width * subdivision))
