"""Strength of guidance over the frames, and what it does to answers."""

import pytest
import torch

from svim3d.diffusion.guidance import (
    GuidanceInterval,
    guide,
    weights_by_azimuth,
    weights_by_index,
)

ENDS = {"weakest": 1.0, "strongest": 2.5}


def test_triangle_over_the_index_is_sv3ds():
    rising = [1.0 + 0.15 * k for k in range(11)]
    expected = torch.tensor(rising + rising[-2::-1])
    assert torch.allclose(weights_by_index(21, **ENDS), expected, atol=1e-6)


def test_triangle_over_the_azimuth_counts_the_distance_to_the_reference_view():
    azimuth = torch.tensor([0.0, 90.0, 180.0, 270.0, 359.0])
    expected = torch.tensor([1.0, 1.75, 2.5, 1.75, 1.0 + 1.5 / 180.0])
    assert torch.allclose(weights_by_azimuth(azimuth, **ENDS), expected, atol=1e-6)


def test_order_of_frames_does_not_matter_to_the_azimuth():
    azimuth = torch.rand(9, generator=torch.Generator().manual_seed(0)) * 360.0
    order = torch.randperm(9, generator=torch.Generator().manual_seed(1))
    shuffled = weights_by_azimuth(azimuth[order], **ENDS)
    assert torch.equal(shuffled, weights_by_azimuth(azimuth, **ENDS)[order])


def test_a_single_frame_has_the_weakest():
    assert weights_by_index(1, **ENDS).tolist() == [1.0]


def test_guiding_extrapolates_frame_by_frame():
    without, given = torch.full((1, 3, 2), 1.0), torch.full((1, 3, 2), 3.0)
    guided = guide(without, given, torch.tensor([0.0, 1.0, 2.5]))
    assert torch.equal(guided[0, :, 0], torch.tensor([1.0, 3.0, 6.0]))
    assert torch.equal(guided[..., 0], guided[..., 1])


@pytest.mark.parametrize(
    ("sigma", "holds"), [(0.28, False), (0.29, True), (5.42, True), (6.0, False)]
)
def test_interval_holds_above_its_low_end_up_to_its_high_end(sigma, holds):
    assert GuidanceInterval(0.28, 5.42).holds(sigma) is holds


def test_without_bounds_guidance_always_acts():
    assert GuidanceInterval().holds(700.0)
    assert GuidanceInterval().holds(0.002)
