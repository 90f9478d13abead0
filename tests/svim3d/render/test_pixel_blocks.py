"""Pixel blocks: neighbours together, targets with their rays, offsets that stay in the pixel."""

import torch

from svim3d.cameras import orbit_angles, orbit_cameras
from svim3d.render.pixel_blocks import PixelBlocks


def make_blocks(size=6, views=3):
    cameras = orbit_cameras(orbit_angles(views, 10.0, 20.0), radius=2.0, fov_y_deg=40.0, size=size)
    number = torch.arange(views * size * size, dtype=torch.float32).view(views, size, size, 1)
    return cameras, PixelBlocks.cut(cameras, {"number": number})


def test_blocks_hold_two_by_two_neighbours_and_their_targets():
    _, blocks = make_blocks()
    assert len(blocks) == 3 * 9
    assert blocks.pixels[0].tolist() == [0, 1, 6, 7]
    assert blocks.pixels[1].tolist() == [2, 3, 8, 9]
    assert blocks.pixels[9].tolist() == [36, 37, 42, 43]
    assert torch.equal(blocks.targets["number"][..., 0], blocks.pixels.float())
    assert sorted(blocks.pixels.flatten().tolist()) == list(range(108))


def test_odd_sizes_lose_their_last_row_and_column():
    _, blocks = make_blocks(size=5)
    assert len(blocks) == 3 * 4
    assert blocks.pixels[0].tolist() == [0, 1, 5, 6]


def test_rays_are_those_of_the_cameras():
    cameras, blocks = make_blocks()
    chosen = blocks.take(torch.tensor([13, 2]))
    rays = chosen.rays()
    for place, pixel in enumerate(chosen.pixels.flatten().tolist()):
        origins, directions = cameras.rays(pixel // 36)
        torch.testing.assert_close(rays.origins[place], origins[pixel % 36])
        torch.testing.assert_close(rays.directions[place], directions[pixel % 36])


def test_offset_of_one_pixel_is_the_neighbours_ray():
    _, blocks = make_blocks()
    centre = blocks.rays().directions.view(-1, 4, 3)
    count = blocks.pixels.numel()
    right = blocks.rays(torch.tensor([[1.0, 0.0]]).expand(count, 2)).directions.view(-1, 4, 3)
    down = blocks.rays(torch.tensor([[0.0, 1.0]]).expand(count, 2)).directions.view(-1, 4, 3)
    torch.testing.assert_close(right[:, 0], centre[:, 1])
    torch.testing.assert_close(down[:, 1], centre[:, 3])


def test_footprint_is_a_pixel_at_the_origin():
    cameras, blocks = make_blocks()
    seen = cameras.project(torch.tensor([[0.0, 0.0, 0.0]]))[0, 0]
    right = cameras.c2w[0, :3, 0] * blocks.footprint
    moved = cameras.project(right[None])[0, 0]
    shift = (moved[0] / moved[3] - seen[0] / seen[3]) * 0.5 * cameras.width
    torch.testing.assert_close(shift, torch.tensor(1.0), atol=1e-4, rtol=0)
