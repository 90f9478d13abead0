import pytest
import torch
from analytic_views import buffer_of, camera, plane, sphere

from svim3d.render.regions import region_of_points, resized_region


def view(size: int = 64):
    cameras = camera(size)
    floor = plane(cameras, (0.0, 1.0, 0.0), -0.2, 0.5)
    return buffer_of(cameras, [floor, sphere(cameras, (0.0, 0.0, 0.0), 0.2)])


def test_points_of_the_view_itself_take_their_own_pixel():
    seen = view()
    region = torch.rand(64, 64, 1, generator=torch.Generator().manual_seed(0))
    covered = seen.mask[0, ..., 0] > 0
    found = region_of_points(seen.positions(0)[covered], region, seen)
    torch.testing.assert_close(found, region[covered], rtol=0, atol=1e-4)


def test_hidden_points_and_points_outside_the_picture_take_nothing():
    seen, region = view(), torch.ones(64, 64, 1)
    behind_the_ball = seen.cameras.positions[0] * -0.2 / seen.cameras.positions[0].norm()
    outside = torch.tensor([0.0, 3.0, 0.0])
    behind_the_camera = seen.cameras.positions[0] * 2.0
    points = torch.stack([behind_the_ball, outside, behind_the_camera])
    assert torch.equal(region_of_points(points, region, seen), torch.zeros(3, 1))


def test_regions_keep_their_share_when_resized():
    region = torch.zeros(8, 16, 1)
    region[2:6, 4:12] = 1.0
    larger = resized_region(region, 16, 32)
    assert larger.shape == (16, 32, 1)
    assert float(larger.mean()) == pytest.approx(float(region.mean()), abs=1e-6)
    with pytest.raises(ValueError, match="in the proportions of 16 x 16"):
        resized_region(region, 16, 16)
