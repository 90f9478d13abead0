"""Turning and mirroring an object only reorders and mirrors its frames."""

import pytest
import torch

from svim3d.diffusion import clips
from svim3d.diffusion.clips import StoredClip

VIEWS = 7


def azimuths() -> torch.Tensor:
    return (torch.arange(1, VIEWS + 1) * (360.0 / VIEWS)) % 360.0


def clip(azimuth: torch.Tensor, elevation: torch.Tensor) -> StoredClip:
    latents = torch.zeros(1, VIEWS, 1, 1, 1)
    return StoredClip(
        rgb=latents,
        materials=torch.zeros(1, 3, VIEWS, 1, 1, 1),
        form=torch.zeros(1, dtype=torch.long),
        pictures=torch.zeros(1, VIEWS, 3, 2, 2, dtype=torch.uint8),
        elevation_deg=elevation[None],
        azimuth_deg=azimuth[None],
        has_good_materials=True,
    )


@pytest.mark.parametrize("reference", range(VIEWS))
def test_any_frame_of_an_even_orbit_can_be_the_reference(reference):
    even = clip(azimuths(), torch.full((VIEWS,), 10.0))
    assert even.is_even(0)
    order = even.frames_seen_from(reference)
    assert int(order[-1]) == reference
    turned = (azimuths()[order] - azimuths()[reference]) % 360.0
    # Up to rounding of the division, the turned orbit is the same orbit.
    difference = (turned - azimuths() + 180.0) % 360.0 - 180.0
    assert float(difference.abs().max()) < 1e-4


def test_uneven_orbits_keep_their_reference():
    level = torch.full((VIEWS,), 10.0)
    jittered = azimuths() + torch.tensor([1.0] + [0.0] * (VIEWS - 1))
    swinging = level + torch.linspace(0.0, 5.0, VIEWS)
    assert not clip(jittered, level).is_even(0)
    assert not clip(azimuths(), swinging).is_even(0)


def test_mirroring_twice_changes_nothing():
    draw = torch.Generator().manual_seed(0)
    pictures = torch.randint(256, (VIEWS, 4, 4, 3), generator=draw, dtype=torch.uint8)
    mask = pictures.amax(-1, keepdim=True)
    assert torch.equal(clips.mirrored_pictures(clips.mirrored_pictures(pictures)), pictures)
    once = clips.mirrored_normals(pictures, mask)
    assert torch.equal(clips.mirrored_normals(once, clips.mirrored_pictures(mask)), pictures)
    uneven = azimuths() + torch.tensor([3.0] + [0.0] * (VIEWS - 1))
    torch.testing.assert_close(clips.mirrored_azimuths(clips.mirrored_azimuths(uneven)), uneven)


def test_mirrored_frames_show_the_object_from_the_mirrored_side():
    """What stood at azimuth a stands at 360 - a, left and right exchanged; azimuths ascend."""
    uneven = torch.tensor([10.0, 50.0, 100.0, 200.0, 210.0, 300.0, 0.0])
    pictures = torch.zeros(VIEWS, 1, 2, 1, dtype=torch.uint8)
    pictures[:, 0, 0, 0] = torch.arange(VIEWS, dtype=torch.uint8)
    azimuth, shown = clips.mirrored_azimuths(uneven), clips.mirrored_pictures(pictures)
    assert azimuth.tolist() == [60.0, 150.0, 160.0, 260.0, 310.0, 350.0, 0.0]
    for frame in range(VIEWS):
        origin = int(shown[frame, 0, 1, 0])
        assert float((azimuth[frame] + uneven[origin]) % 360.0) == 0.0


def test_mirrored_normals_point_the_other_way():
    normal = torch.tensor([0.6, 0.0, 0.8])
    encoded = ((normal + 1.0) / 2.0 * 255.0).round().byte().expand(2, 1, 1, 3)
    mask = torch.full((2, 1, 1, 1), 255, dtype=torch.uint8)
    mirrored = clips.mirrored_normals(encoded, mask)[0, 0, 0].float() / 255.0 * 2.0 - 1.0
    torch.testing.assert_close(mirrored, torch.tensor([-0.6, 0.0, 0.8]), atol=1.01 / 255, rtol=0.0)
    empty = torch.zeros(2, 1, 1, 1, dtype=torch.uint8)
    assert int(clips.mirrored_normals(torch.zeros_like(encoded), empty).max()) == 0
