import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from generator_objects import ball, body_case, one_sided, plain

from benchmarks.generator_baselines import (
    azimuth_bin,
    best_constant,
    learn,
    mean_image,
    repeated,
    repeated_truth,
    warped,
)
from benchmarks.generator_draws import mean_of, spread_of
from benchmarks.generator_report import (
    Scores,
    azimuth_bins,
    interval,
    main_table,
    paired_gains,
    summarize,
    verdict,
)
from benchmarks.generator_scores import HIGHEST_PSNR_DB, angle_deg, score_views, turning
from benchmarks.generator_views import Views

EMPTY = {"roughness": 0.5, "metallic": 0.25}


@pytest.fixture(scope="module")
def case():
    return body_case(ball(), one_sided)


def test_truth_scores_perfectly(case):
    scores = score_views(case.truth, case.truth, EMPTY)
    for name in ("rgb_psnr", "basecolor_psnr_object"):
        assert bool((scores[name] == HIGHEST_PSNR_DB).all())
    for name in ("rgb_ssim", "basecolor_ssim_object", "mask_iou"):
        torch.testing.assert_close(scores[name], torch.ones(21), atol=2e-6, rtol=0.0)
    for name in ("roughness_rmse", "metallic_rmse", "normal_deg", "normal_deg_both"):
        torch.testing.assert_close(scores[name], torch.zeros(21), atol=1e-3, rtol=0.0)


def test_known_errors_give_known_figures(case):
    truth = case.truth
    found = replace(truth, rgb=truth.rgb + 0.1, roughness=truth.roughness - 0.2)
    scores = score_views(found, truth, EMPTY)
    torch.testing.assert_close(scores["rgb_psnr"], torch.full((21,), 20.0), atol=1e-3, rtol=0.0)
    torch.testing.assert_close(scores["roughness_rmse"], torch.full((21,), 0.2))
    torch.testing.assert_close(scores["roughness_pooled"], torch.full((21,), 0.04))


def test_a_picture_that_is_empty_counts_mean_values_and_right_angles(case):
    nothing = torch.zeros_like(case.truth.mask)
    white = torch.ones_like(case.truth.rgb)
    empty = Views(white, white, nothing, nothing, nothing.expand(-1, -1, -1, 3), nothing)
    scores = score_views(empty, case.truth, EMPTY)
    torch.testing.assert_close(scores["roughness_rmse"], torch.full((21,), 0.1))  # |0.5 - 0.4|
    torch.testing.assert_close(scores["metallic_rmse"], torch.full((21,), 0.25))
    torch.testing.assert_close(scores["normal_deg"], torch.full((21,), 90.0))
    assert bool((scores["mask_iou"] == 0.0).all())
    assert bool(scores["normal_deg_both"].isnan().all())


def test_iou_of_half_a_mask(case):
    mask = case.truth.mask.clone()
    mask[..., 24:, :] = 0.0  # the ball is in the middle of the 48 columns
    iou = score_views(replace(case.truth, mask=mask), case.truth, EMPTY)["mask_iou"]
    torch.testing.assert_close(iou, torch.full((21,), 0.5))


@pytest.mark.parametrize("degrees", [0.01, 60.0, 180.0])
def test_angles_are_exact(degrees):
    turned = torch.tensor([[math.sin(math.radians(degrees)), 0.0, math.cos(math.radians(degrees))]])
    angle = angle_deg(2.0 * turned, torch.tensor([[0.0, 0.0, 3.0]]))
    assert float(angle) == pytest.approx(degrees, rel=1e-5)


def test_truth_turns_with_the_camera_and_a_repeated_view_does_not(case):
    own = turning(case.truth, case.truth, case.azimuth_deg)
    assert (own.rank_1, own.mean_rank, own.error_deg) == (1.0, 1.0, 0.0)
    still = turning(repeated_truth(case), case.truth, case.azimuth_deg)
    # Its nearest true view is always the same, so one of 20 is right; ranks run from 1 to 20.
    assert still.rank_1 == pytest.approx(still.chance_rank_1)
    assert still.mean_rank == pytest.approx(still.chance_rank)
    assert own.asymmetry > 0.01


def test_turning_cannot_be_told_of_an_object_that_looks_the_same_all_around():
    truth = body_case(ball(), plain).truth
    same = Views(**{n: getattr(truth, n)[:1].expand(21, -1, -1, -1) for n in vars(truth)})
    told = turning(same, same, body_case(ball(), plain).azimuth_deg)
    assert (told.mean_rank, told.asymmetry) == (told.chance_rank, 0.0)
    assert told.rank_1 == pytest.approx(told.chance_rank_1)


def test_turning_the_wrong_way_is_told_from_the_right_one(case):
    back = Views(**{n: getattr(case.truth, n).flip(0).roll(-1, 0) for n in vars(case.truth)})
    assert turning(back, case.truth, case.azimuth_deg).error_deg > 80.0


def test_interval_of_equal_objects_has_no_width_and_a_seed_repeats_it():
    assert interval(np.full(7, 3.0)) == {"mean": 3.0, "low": 3.0, "high": 3.0}
    values = np.random.default_rng(0).normal(size=50)
    assert interval(values, seed=1) == interval(values, seed=1)
    told = interval(values)
    # The normal approximation: 1.96 standard errors, to a tenth for 50 objects.
    half = 1.96 * values.std() / math.sqrt(50)
    assert told["high"] - told["mean"] == pytest.approx(half, rel=0.1)
    assert interval(np.array([1.0, np.nan, 3.0]))["mean"] == 2.0
    assert interval(np.full(3, 4.0), root=True)["mean"] == 2.0


def test_views_are_binned_by_their_distance_from_the_reference():
    degrees = np.array([17.1, 340.0, 180.0, 171.4, 188.6, 3.0, 0.0])
    assert azimuth_bins(degrees).tolist() == [1, 1, 10, 10, 10, 1, 0]
    assert azimuth_bin(torch.tensor([0.0, 17.1, 351.5, 342.0])).tolist() == [0, 1, 0, 20]


def test_report_of_a_method_that_is_better_by_a_known_amount(case):
    better, worse = Scores(), Scores()
    turned = turning(case.truth, case.truth, case.azimuth_deg)
    for shift, scores in ((0.1, better), (0.2, worse)):
        for _ in range(3):
            rgb, roughness = case.truth.rgb + shift, case.truth.roughness + shift
            found = replace(case.truth, rgb=rgb, roughness=roughness)
            scores.add(
                score_views(found, case.truth, EMPTY), case.azimuth_deg, turned, materials=True
            )
    rows = {"ours": better, "other": worse}
    gains = paired_gains(rows, ["other"])
    assert gains["other"]["rgb_psnr"]["low"] == pytest.approx(20.0 * math.log10(2.0), abs=1e-3)
    assert gains["other"]["roughness_rmse"]["mean"] == pytest.approx(0.1, abs=1e-5)
    told = verdict(gains)
    assert told["rgb_psnr"] == "beats all"
    assert told["mask_iou"] == "not clearly better than other"
    summary = summarize(rows)
    assert summary["ours"]["figures"]["roughness_pooled"]["mean"] == pytest.approx(0.1, abs=1e-5)
    assert "| ours | 20.00 ± 0.00 |" in main_table(summary)


def test_materials_that_mean_nothing_are_left_out(case):
    scores = Scores()
    turned = turning(case.truth, case.truth, case.azimuth_deg)
    told = score_views(case.truth, case.truth, EMPTY)
    scores.add(told, case.azimuth_deg, turned, materials=False)
    assert math.isnan(scores.per_object("metallic_rmse")[0])
    assert scores.per_object("mask_iou")[0] == 1.0


def test_best_constant_is_the_median_like_one():
    # Two of three views are dielectric, one is metal: 0 errs by 1/3 on average, the mean by 4/9.
    assert best_constant(torch.tensor([[0.0, 0.0], [0.0, 0.0], [1.0, 0.0]])) == 0.0


def test_baselines_learn_means_and_a_set_of_one_is_its_own_mean(case):
    training = learn([case], 48)
    assert training.mean_value["roughness"] == pytest.approx(0.4)
    found = mean_image(case, training)
    scores = score_views(found, case.truth, training.mean_value)
    assert float(scores["rgb_psnr"].min()) == HIGHEST_PSNR_DB
    assert float(scores["mask_iou"].min()) == 1.0
    assert float(scores["normal_deg"].max()) < 0.1
    for baseline in (repeated, warped):
        assert all(plane.isfinite().all() for plane in vars(baseline(case, training)).values())


def test_mean_and_spread_of_two_orbits(case):
    truth = case.truth
    other = replace(truth, rgb=truth.rgb + 0.2)
    torch.testing.assert_close(mean_of([truth, other]).rgb, truth.rgb + 0.1)
    spread = spread_of([truth, other])
    assert spread["rgb"] == pytest.approx(0.1, rel=1e-5)
    assert spread["normal"] == pytest.approx(0.0, abs=1e-4)
