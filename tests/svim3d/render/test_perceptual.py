"""Pictures compared three channels at a time: encoding, choice, trust, crops."""

import pytest
import torch
from sphere_orbit import sphere_cameras, sphere_images

from svim3d.color import srgb_from_linear
from svim3d.metrics.pictures import SSIM_C1
from svim3d.render.perceptual import (
    CHANNELS,
    crop_around,
    draw_triplets,
    encoded_channels,
    perceptual_loss,
    structural_distance,
)
from svim3d.render.ray_losses import tonemap

CAMERAS = sphere_cameras(views=3, size=24)
SPHERE = {name: image[0] for name, image in sphere_images(CAMERAS).items()}
TRIPLETS = torch.tensor([[0, 4, 9], [6, 7, 10]])


def nonsense():
    """The sphere with everything wrong in a patch."""
    images = {name: image.clone() for name, image in SPHERE.items()}
    for image in images.values():
        image[8:16, 8:16] = 1.0 - image[8:16, 8:16]
    return images


def with_gradient():
    return {name: image.clone().requires_grad_() for name, image in SPHERE.items()}


def test_channels_are_encoded_in_their_order():
    encoded = encoded_channels(SPHERE)
    assert encoded.shape == (24, 24, CHANNELS)
    torch.testing.assert_close(encoded[..., :3], tonemap(SPHERE["radiance"]))
    torch.testing.assert_close(encoded[..., 3:6], srgb_from_linear(SPHERE["basecolor"]))
    torch.testing.assert_close(encoded[..., 6:7], SPHERE["roughness"])
    torch.testing.assert_close(encoded[..., 7:8], SPHERE["metallic"])
    torch.testing.assert_close(encoded[..., 8:] * 2 - 1, SPHERE["normal_world"])
    assert float(encoded.min()) >= 0.0
    assert float(encoded.max()) <= 1.0


def test_triplets_hold_three_channels_each_and_all_come_up():
    drawn = [draw_triplets(torch.Generator().manual_seed(seed)) for seed in range(30)]
    assert all(len(set(triplet.tolist())) == 3 for pair in drawn for triplet in pair)
    assert set(torch.stack(drawn).flatten().tolist()) == set(range(CHANNELS))


def test_dssim_of_flat_pictures_matches_closed_form():
    a, b = 0.3, 0.7
    luminance = (2 * a * b + SSIM_C1) / (a * a + b * b + SSIM_C1)
    flat = torch.ones(1, 12, 12, 3, dtype=torch.float64)
    assert float(structural_distance(a * flat, b * flat)) == pytest.approx(0.5 * (1 - luminance))


def test_only_the_drawn_channels_are_compared():
    wrong = dict(SPHERE, metallic=1.0 - SPHERE["metallic"])
    with_it = perceptual_loss(SPHERE, wrong, torch.tensor([[0, 7, 3]]), structural_distance)
    without = perceptual_loss(SPHERE, wrong, torch.tensor([[0, 6, 3]]), structural_distance)
    assert float(with_it) > 0.1
    assert float(without) == pytest.approx(0.0, abs=1e-6)


def test_full_trust_changes_no_bit():
    full = torch.ones(24, 24, 1)
    for trust in ({"trust": full}, {"normal_trust": full}):
        assert torch.equal(
            perceptual_loss(SPHERE, nonsense(), TRIPLETS, structural_distance, **trust),
            perceptual_loss(SPHERE, nonsense(), TRIPLETS, structural_distance),
        )


def test_what_is_not_trusted_asks_for_nothing():
    trust = torch.ones(24, 24, 1)
    trust[8:16, 8:16] = 0.0
    blind = with_gradient()
    perceptual_loss(blind, nonsense(), TRIPLETS, structural_distance).backward()
    assert float(blind["metallic"].grad.abs().max()) > 1e-4
    warned = with_gradient()
    loss = perceptual_loss(
        warned, nonsense(), TRIPLETS, structural_distance, trust=trust, normal_trust=trust
    )
    loss.backward()
    assert float(loss.detach()) == pytest.approx(0.0, abs=1e-6)
    assert float(warned["metallic"].grad.abs().max()) < 1e-6


def test_trust_in_normals_leaves_materials_alone():
    none = torch.zeros(24, 24, 1)
    for channel, stays in ((7, True), (10, False)):
        triplets = torch.full((1, 3), channel)
        loss = perceptual_loss(SPHERE, nonsense(), triplets, structural_distance, normal_trust=none)
        assert (float(loss) > 0.01) == stays


@pytest.mark.parametrize(
    ("row", "column", "first"), [(12, 11, (8, 7)), (0, 23, (0, 16)), (23, 1, (16, 0))]
)
def test_crops_stay_in_their_view(row, column, first):
    crop = crop_around((2 * 24 + row) * 24 + column, CAMERAS, 8)
    want = torch.arange(3 * 24 * 24).view(3, 24, 24)[2, first[0] :, first[1] :][:8, :8]
    assert torch.equal(crop, want)


def test_a_view_smaller_than_the_crop_is_taken_whole():
    crop = crop_around(24 * 24 + 5, CAMERAS, 64)
    assert torch.equal(crop, torch.arange(24 * 24, 2 * 24 * 24).view(24, 24))
