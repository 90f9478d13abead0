"""What the network is told: camera numbers, both branches of guidance, the picture's token."""

import math

import pytest
import torch
from diffusers.pipelines.stable_video_diffusion.pipeline_stable_video_diffusion import (
    _resize_with_antialiasing,
)
from tiny_diffusion import some_conditioning, some_latents, tiny_model
from torch.nn import functional

from svim3d.cameras import CameraPath
from svim3d.diffusion.conditioning import blur_and_resize, camera_numbers, embed_picture


def test_camera_numbers_of_sv3ds_orbit():
    numbers = camera_numbers(*CameraPath.orbit(21, 10.0).tensors(), 1e-5)
    assert numbers.shape == (21, 3)
    assert torch.equal(numbers[:, 0], torch.full((21,), 1e-5))
    assert torch.allclose(numbers[:, 1], torch.full((21,), math.radians(80.0)))
    degrees = torch.tensor([360.0 * k / 21 for k in range(1, 21)] + [0.0])
    assert torch.allclose(numbers[:, 2], torch.deg2rad(degrees), atol=1e-6)


def test_azimuth_counts_from_the_last_frame_and_stays_below_a_full_turn():
    azimuth = torch.tensor([30.0, 350.0, 20.0 - 1e-6, 20.0])
    numbers = camera_numbers(torch.zeros(4), azimuth, 0.0)
    expected = torch.deg2rad(torch.tensor([10.0, 330.0, 0.0, 0.0]))
    assert torch.allclose(numbers[:, 2], expected, atol=1e-6)


def test_a_frames_azimuth_alters_that_frames_number_alone():
    elevation, azimuth = CameraPath.orbit(21, 10.0).tensors()
    turned = azimuth.clone()
    turned[4] += 5.0
    before, after = (camera_numbers(elevation, a, 1e-5) for a in (azimuth, turned))
    changed = (before != after).nonzero().tolist()
    assert changed == [[4, 2]]


def test_unconditional_branch_comes_first_and_keeps_the_cameras():
    told = some_conditioning()
    both = told.beside_unconditional()
    assert torch.equal(both.token, torch.cat([torch.zeros_like(told.token), told.token]))
    assert torch.equal(both.latent, torch.cat([torch.zeros_like(told.latent), told.latent]))
    assert torch.equal(both.camera, torch.cat([told.camera, told.camera]))


def test_dropping_acts_on_whole_clips():
    told = some_conditioning(clips=2)
    left = told.dropped(torch.tensor([1.0, 0.0]))
    assert not left.token[0].any()
    assert not left.latent[0].any()
    assert torch.equal(left.token[1], told.token[1])
    assert torch.equal(left.camera, told.camera)


def test_latent_of_the_reference_view_follows_the_noisy_ones_unscaled():
    told, noisy = some_conditioning(), some_latents()
    beside = told.beside(noisy)
    assert torch.equal(beside[:, :, :16], noisy)
    assert torch.equal(beside[:, :, 16:], told.latent[:, None].expand(-1, 5, -1, -1, -1))


@pytest.mark.parametrize(("rows", "columns", "side"), [(57, 41, 22), (16, 16, 8), (8, 8, 16)])
def test_resizing_is_that_of_stable_video_diffusion(rows, columns, side):
    picture = torch.rand(2, 3, rows, columns, generator=torch.Generator().manual_seed(0))
    theirs = _resize_with_antialiasing(picture, (side, side))
    assert torch.allclose(blur_and_resize(picture, side), theirs, atol=1e-6)


def test_resizing_to_the_same_size_changes_nothing():
    picture = torch.rand(1, 3, 8, 8, generator=torch.Generator().manual_seed(0))
    assert blur_and_resize(picture, 8) is picture


def test_token_is_clips_projected_answer():
    encoder = tiny_model().image_encoder
    picture = 2.0 * torch.rand(1, 3, 8, 8, generator=torch.Generator().manual_seed(0)) - 1.0
    token = embed_picture(encoder, picture)
    # As CLIP's own processor would: pictures in [0, 1] less the mean, over the deviation.
    mean = torch.tensor([0.48145466, 0.4578275, 0.40821073]).view(3, 1, 1)
    std = torch.tensor([0.26862954, 0.26130258, 0.27577711]).view(3, 1, 1)
    expected = encoder(pixel_values=((picture + 1.0) / 2.0 - mean) / std).image_embeds
    assert token.shape == (1, 1, 16)
    assert torch.allclose(token[:, 0], expected, atol=1e-6)


def test_token_of_a_bigger_picture_is_shrunk_as_asked():
    encoder = tiny_model().image_encoder
    picture = 2.0 * torch.rand(1, 3, 20, 20, generator=torch.Generator().manual_seed(0)) - 1.0
    small = functional.interpolate(picture, size=(8, 8), mode="bicubic", antialias=True)
    assert torch.equal(embed_picture(encoder, picture), embed_picture(encoder, small))
    blurred = embed_picture(encoder, picture, "blur")
    assert torch.equal(blurred, embed_picture(encoder, blur_and_resize(picture, 8)))
    assert not torch.equal(blurred, embed_picture(encoder, picture))
