"""A region drawn on one view, found again on other views and on the textures of the asset."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import grid_sample, interpolate, max_pool2d

from svim3d.mesh.source_mesh import SourceMesh
from svim3d.mesh.texels import fill_empty, rasterize_uv
from svim3d.render.gbuffer import GBuffer

DEPTH_SLACK = 0.01  # world units; a point this far behind what is seen there still counts as seen
MAX_REPEATS = 8  # of a texture along one face and axis that are told apart; all share their texels
ON_CENTRE_TEXELS = 0.01  # rounding of interpolated texture coordinates, with room to spare


def resized_region(
    region: Float[Tensor, "h w 1"], height: int, width: int
) -> Float[Tensor, "height width 1"]:
    """A region at the size of a picture of the same shape.

    Raises:
        ValueError: the proportions differ.
    """
    rows, columns, _ = region.shape
    # Half a pixel of rounding on either side.
    if abs(rows * width - columns * height) > 0.5 * max(width, height):
        raise ValueError(
            f"wanted a region in the proportions of {width} x {height} pixels, "
            f"got {columns} x {rows}; draw it on the view itself"
        )
    scaled = interpolate(
        region.permute(2, 0, 1)[None], size=(height, width), mode="bilinear", antialias=True
    )
    return scaled[0].permute(1, 2, 0)


def region_of_points(
    points: Float[Tensor, "P 3"], region: Float[Tensor, "H W 1"], seen: GBuffer
) -> Float[Tensor, "P 1"]:
    """Share of the region that world-space points have: zero where the view does not see them.

    A point is seen when it is no farther than the farthest of the four pixels around it. On a
    tilted surface its depth lies between theirs; compared with the nearest one alone, every other
    point would seem to lie behind the surface that it is on.

    Args:
        points: on the surface.
        region: drawn on the one view of `seen`, at its size.
        seen: that view, with depth.
    """
    if seen.depth is None:
        raise ValueError("a region is carried to other views by depth, and these views have none")
    height, width, _ = region.shape
    clip = seen.cameras.project(points)[0]
    ahead = clip[:, 3:].clamp_min(DEPTH_SLACK)
    # Rows grow downwards, clip space upwards.
    position = clip[:, :2] / ahead * clip.new_tensor([1.0, -1.0])
    share = grid_sample(
        region.permute(2, 0, 1)[None], position.view(1, 1, -1, 2), mode="bilinear",
        align_corners=False,
    )  # fmt: skip
    # Cell (i, j) of the farthest depths lies between the pixels i - 1 and i, j - 1 and j.
    farthest = max_pool2d(seen.depth[0, None, ..., 0], 2, stride=1, padding=1)[0]
    cell = ((position + 1.0) * 0.5 * position.new_tensor([width, height])).round().long()
    column, row = cell[:, 0].clamp(0, width), cell[:, 1].clamp(0, height)
    depth = farthest[row, column][:, None]
    is_seen = (depth > 0.0) & (clip[:, 3:] > 0.0) & (clip[:, 3:] <= depth + DEPTH_SLACK)
    return share.view(-1, 1) * is_seen


def region_of_texels(
    mesh: SourceMesh,
    material: int,
    size: tuple[int, int],
    region: Float[Tensor, "H W 1"],
    seen: GBuffer,
) -> Float[Tensor, "height width 1"]:
    """The same in the texture space of one material, whose texture has `size` rows and columns.

    Texture coordinates may repeat. Several places of the surface may share a texel: it takes the
    share of one that faces the view within the region, if any does.
    """
    of_material = mesh.faces[mesh.face_material == material].long()
    image, filled = torch.zeros(*size, 1), torch.zeros(*size, dtype=torch.bool)
    may_show = _may_show(mesh.vertices[of_material], region, seen)
    for faces, shows in ((of_material[~may_show], False), (of_material[may_show], True)):
        if not len(faces):
            continue
        uv, source = _within_one_tile(mesh.uv[faces])
        apart: Int[Tensor, "G 3"] = torch.arange(3 * len(uv)).view(-1, 3)
        # Texels are square for the rasteriser: the rest of its square stays empty.
        side = max(size)
        scale = uv.new_tensor([size[1] / side, size[0] / side])
        texels = rasterize_uv((uv * scale).reshape(-1, 2), apart, side)
        row, column = texels.pixel // side, texels.pixel % side
        # A face claims the centres it holds; a texel that it merely touches may belong to another.
        nearest = texels.interpolate(apart, (uv * scale * side).reshape(-1, 2))
        centre = torch.stack([column, row], 1) + 0.5
        inside = (nearest - centre).abs().amax(1) < ON_CENTRE_TEXELS
        row_, column_ = row.clamp(max=size[0] - 1), column.clamp(max=size[1] - 1)
        mine = (row == row_) & (column == column_) & (inside | ~filled[row_, column_])
        row, column = row[mine], column[mine]
        if shows:
            corners = mesh.vertices[faces[source]].reshape(-1, 3)
            points = texels.interpolate(apart, corners)[mine]
            image[row, column] = region_of_points(points, region, seen)
        filled[row, column] = True
    return fill_empty(image, filled)


def _may_show(
    corners: Float[Tensor, "F 3 3"], region: Float[Tensor, "H W 1"], seen: GBuffer
) -> Bool[Tensor, "F"]:
    """Faces that face the view and whose bounding box in the picture meets the region."""
    a, b, c = corners.unbind(1)
    towards = seen.cameras.positions[0] - a
    faces_viewer = (torch.linalg.cross(b - a, c - a) * towards).sum(-1) > 0.0
    height, width, _ = region.shape
    clip = seen.cameras.project(corners.reshape(-1, 3))[0].view(-1, 3, 4)
    ahead = clip[..., 3:]
    size = clip.new_tensor([width, height])
    flipped = clip[..., :2] * clip.new_tensor([1.0, -1.0])
    pixel = (flipped / ahead.clamp_min(DEPTH_SLACK) + 1.0) * 0.5 * size
    # One pixel more on each side: the region is sampled between pixel centres.
    low = (pixel.amin(1).floor() - 1.0).clamp_min(0.0).minimum(size).long()
    high = (pixel.amax(1).ceil() + 1.0).clamp_min(0.0).minimum(size).long()
    count = torch.zeros(height + 1, width + 1, dtype=torch.long)
    count[1:, 1:] = (region[..., 0] > 0.0).long().cumsum(0).cumsum(1)
    (x0, y0), (x1, y1) = low.unbind(1), high.unbind(1)
    within = count[y1, x1] - count[y0, x1] - count[y1, x0] + count[y0, x0]
    # What reaches behind the camera has no box; it is left to the depth test.
    return faces_viewer & ((within > 0) | (ahead <= 0.0).any(1)[:, 0])


def _within_one_tile(
    uv: Float[Tensor, "F 3 2"],
) -> tuple[Float[Tensor, "G 3 2"], Int[Tensor, "G"]]:
    """Copies of faces moved by whole textures, one for each repetition that a face reaches.

    Returns:
        Their coordinates, and the face that each is a copy of.
    """
    low = uv.amin(1).floor()
    reach = (uv.amax(1).ceil() - low).clamp(1, MAX_REPEATS).long()
    copies = reach.prod(1)
    source = torch.repeat_interleave(torch.arange(len(uv)), copies)
    number = torch.arange(len(source)) - (torch.cumsum(copies, 0) - copies)[source]
    across = reach[source, 0]
    tile = low[source] + torch.stack([number % across, number // across], 1)
    return uv[source] - tile[:, None], source
