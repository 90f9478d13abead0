import pytest
import torch

from svim3d.cameras import orbit_cameras
from svim3d.render.gbuffer import GBuffer


def buffers(views: int, size: int) -> GBuffer:
    cameras = orbit_cameras(
        [(10.0 * v, 70.0 * v) for v in range(views)], radius=2.5, fov_y_deg=40.0, size=size
    )
    one, three = torch.rand(views, size, size, 1), torch.rand(views, size, size, 3)
    return GBuffer(cameras, one, three, one, one, three)


def test_positions_project_back_to_their_pixel_and_depth():
    gbuffer = buffers(3, 8)
    depth = torch.rand(3, 8, 8, 1) + 1.0
    points = GBuffer.of(gbuffer.cameras, {**gbuffer.images(), "depth": depth}).positions(2)
    clip = gbuffer.cameras[2].project(points.view(-1, 3))[0]
    torch.testing.assert_close(clip[:, 3].view(8, 8, 1), depth[2])
    column = (clip[:, 0] / clip[:, 3] * 0.5 + 0.5) * 8
    torch.testing.assert_close(column.view(8, 8), (torch.arange(8) + 0.5).expand(8, 8))


def test_directions_lead_from_the_surface_to_the_viewer():
    gbuffer = buffers(2, 8)
    with_depth = GBuffer.of(
        gbuffer.cameras, {**gbuffer.images(), "depth": torch.full((2, 8, 8, 1), 1.5)}
    )
    to_viewer = gbuffer.cameras.positions[1] - with_depth.positions(1)
    expected = to_viewer / to_viewer.norm(dim=-1, keepdim=True)
    torch.testing.assert_close(with_depth.view_directions(1), expected)


def test_positions_need_depth():
    with pytest.raises(ValueError, match=r"depth\.Z"):
        buffers(1, 4).positions(0)


def test_views_are_taken_in_the_order_given():
    gbuffer = buffers(3, 4)
    taken = gbuffer.take([2, 0])
    assert len(taken) == 2
    assert taken.depth is None
    assert torch.equal(taken.basecolor[0], gbuffer.basecolor[2])
    assert torch.equal(taken.cameras.c2w[1], gbuffer.cameras.c2w[0])
