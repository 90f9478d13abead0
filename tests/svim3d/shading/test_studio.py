import torch

from svim3d.numerics import normalize
from svim3d.shading.octahedral import texel_directions
from svim3d.shading.studio import CEILING, EDGE_DEG, FLOOR, SOFT_BOXES, studio_radiance


def test_poles_show_floor_and_what_hangs_above():
    down, up = studio_radiance(torch.tensor([[0.0, -1.0, 0.0], [0.0, 1.0, 0.0]]))
    torch.testing.assert_close(down, torch.tensor(FLOOR))
    torch.testing.assert_close(up, torch.tensor(CEILING) + torch.tensor(SOFT_BOXES[3][2]))


def test_boxes_shine_at_their_centre_and_end_beyond_their_edge():
    for centre, half_angles, colour in SOFT_BOXES:
        forward = normalize(torch.tensor(centre))
        room = studio_radiance(forward[None])[0] - torch.tensor(colour)
        assert bool((room >= torch.tensor(FLOOR) - 1e-6).all())
        assert bool((room <= torch.tensor(CEILING) + 1e-6).all())
        axis = normalize(torch.linalg.cross(torch.tensor([0.0, 1.0, 1e-3]), forward))
        angle = torch.tensor(half_angles[0] + EDGE_DEG + 0.5).deg2rad()
        beside = forward * angle.cos() + axis * angle.sin()
        assert float(studio_radiance(beside[None]).max()) <= max(CEILING) + 1e-6


def test_light_is_everywhere_positive_and_bounded():
    radiance = studio_radiance(texel_directions(64))
    assert float(radiance.min()) >= min(FLOOR) - 1e-6
    assert float(radiance.max()) <= max(max(box[2]) for box in SOFT_BOXES) + max(CEILING)
