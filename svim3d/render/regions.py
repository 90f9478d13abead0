"""A region drawn on one view, found again on other views and on the textures of the asset."""

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import grid_sample, interpolate

from svim3d.mesh.source_mesh import SourceMesh
from svim3d.mesh.texels import rasterize_uv, to_image
from svim3d.render.gbuffer import GBuffer

DEPTH_SLACK = 0.01  # world units; a point this far behind what is seen there still counts as seen


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

    Args:
        points: on the surface.
        region: drawn on the one view of `seen`, at its size.
        seen: that view, with depth.
    """
    if seen.depth is None:
        raise ValueError("a region is carried to other views by depth, and these views have none")
    clip = seen.cameras.project(points)[0]
    ahead = clip[:, 3:].clamp_min(DEPTH_SLACK)
    # Rows grow downwards, clip space upwards.
    position = clip[:, :2] / ahead * clip.new_tensor([1.0, -1.0])
    images = torch.cat([region, seen.depth[0]], -1).permute(2, 0, 1)[None]
    grid = position.view(1, 1, -1, 2)
    share = grid_sample(images[:, :1], grid, mode="bilinear", align_corners=False)
    depth = grid_sample(images[:, 1:], grid, mode="nearest", align_corners=False)
    depth = depth.view(-1, 1)
    is_ahead = (clip[:, 3:] > 0.0) & (depth > 0.0)
    return share.view(-1, 1) * (is_ahead & (clip[:, 3:] <= depth + DEPTH_SLACK))


def region_of_texels(
    mesh: SourceMesh, material: int, size: int, region: Float[Tensor, "H W 1"], seen: GBuffer
) -> Float[Tensor, "size size 1"]:
    """The same in the texture space of one material; texture coordinates may repeat."""
    faces = mesh.faces[mesh.face_material == material].long()
    if not len(faces):
        return torch.zeros(size, size, 1)
    corner_uv = mesh.uv[faces]
    # Every face is moved by whole textures to where it is stored.
    corner_uv = corner_uv - corner_uv.mean(1, keepdim=True).floor()
    apart: Int[Tensor, "F 3"] = torch.arange(3 * len(faces)).view(-1, 3)
    texels = rasterize_uv(corner_uv.reshape(-1, 2), apart, size)
    points = texels.interpolate(apart, mesh.vertices[faces].reshape(-1, 3))
    normals = texels.interpolate(apart, mesh.normals[faces].reshape(-1, 3))
    towards = seen.cameras.positions[0] - points
    faces_viewer = (normals * towards).sum(-1, keepdim=True) > 0.0
    return to_image(region_of_points(points, region, seen) * faces_viewer, texels)
