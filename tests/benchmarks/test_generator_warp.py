import math

import pytest
import torch
from generator_objects import (
    FOV_DEG,
    RADIUS,
    SIZE,
    ball,
    body_case,
    body_views,
    mirrored_waves,
    plain,
)

from benchmarks.generator_baselines import learn, repeated, warped
from benchmarks.generator_scores import angle_deg, decibels, masked_mean, score_views
from benchmarks.generator_views import COVERED, framing_zoom, resample, window_weights
from benchmarks.generator_warp import (
    Ellipsoid,
    fit_ellipsoid,
    inflated_normals,
    outline_box,
    visible_twin,
    warp_views,
)
from svim3d.cameras import orbit_cameras
from svim3d.diffusion.groups import without_background
from svim3d.numerics import normalize

EMPTY = {"roughness": 0.5, "metallic": 0.5}


def test_outline_of_a_ball_is_that_of_its_cone():
    camera = orbit_cameras([(20.0, 0.0)], radius=RADIUS, fov_y_deg=FOV_DEG, size=SIZE)
    slope = math.tan(math.asin(0.6 / RADIUS))
    expected = torch.tensor([-slope, slope, -slope, slope])
    torch.testing.assert_close(outline_box(ball(), camera), expected, atol=1e-6, rtol=0.0)


@pytest.mark.parametrize("elevation_deg", [-5.0, 10.0, 30.0])
def test_a_body_is_found_from_its_mask(elevation_deg):
    body = Ellipsoid(torch.tensor([0.1, -0.05, 0.0]), torch.tensor([0.4, 0.65, 0.4]))
    mask = body_views(body, plain, [(elevation_deg, 0.0)]).mask[0]
    found = fit_ellipsoid(mask, elevation_deg, FOV_DEG)
    # A pixel is 0.037 wide at the body; thresholding may move each side by half of one. The
    # height answers to the outline by its cosine squared only, and depth is not seen.
    torch.testing.assert_close(found.half_axes, body.half_axes, atol=0.03, rtol=0.0)
    torch.testing.assert_close(found.centre[:2], body.centre[:2], atol=0.03, rtol=0.0)


@pytest.fixture(scope="module")
def waves():
    return body_case(ball(), mirrored_waves, elevation_deg=0.0)


@pytest.fixture(scope="module")
def training(waves):
    return learn([waves], SIZE)


def test_repeating_is_perfect_for_a_plain_ball(training):
    case = body_case(ball(), plain)
    scores = score_views(repeated(case, training), case.truth, EMPTY)
    # All pictures are equal but for rounding of the rays.
    assert float(scores["rgb_psnr"].min()) > 45.0
    assert float(scores["rgb_ssim"].min()) > 0.999
    assert float(scores["mask_iou"].min()) > 0.99
    assert float(scores["roughness_rmse"].max()) < 1e-5


def test_warping_a_painted_ball_whose_back_mirrors_its_front(waves):
    straight = without_background(waves.picture, waves.mask, 1.0)
    seen = warp_views(waves, ball(), straight, carves=False)
    torch.testing.assert_close(seen.mask, waves.truth.mask, atol=1e-5, rtol=0.0)
    inside = waves.truth.mask > COVERED
    assert float(masked_mean(angle_deg(seen.normal, waves.truth.normal), inside).max()) < 0.1
    truth = without_background(waves.truth.rgb, waves.truth.mask, 1.0)
    db = decibels(masked_mean((seen.colours - truth).square().mean(-1, keepdim=True), inside))
    # The reference view itself and its mirror image come back but for resampling twice; seen from
    # the side, the stretched pixels of the reference's rim are in the middle.
    assert float(db[[20, 9, 10]].min()) > 33.0
    assert float(db.min()) > 23.0


def test_warping_on_a_fitted_body_beats_repeating(waves, training):
    scores = score_views(warped(waves, training), waves.truth, EMPTY)
    still = score_views(repeated(waves, training), waves.truth, EMPTY)
    assert float(scores["rgb_psnr"].mean()) > float(still["rgb_psnr"].mean()) + 3.0
    assert float(scores["mask_iou"].min()) > 0.95
    # The outline's box is known to a quarter of a pixel of the radius of 17.
    assert float(scores["normal_deg"].max()) < 4.0


def test_twins_are_visible_and_the_visible_are_their_own():
    point = normalize(torch.randn(500, 3, generator=torch.Generator().manual_seed(0)))
    eye = torch.tensor([0.0, 1.5, 4.0])
    twin = visible_twin(point, eye)
    assert float((twin @ eye).min()) > 1.0 - 1e-4
    torch.testing.assert_close(torch.linalg.vector_norm(twin, dim=1), torch.ones(500))
    seen = (point @ eye) > 1.0
    assert torch.equal(twin[seen], point[seen])
    behind = ~seen & ((point * torch.tensor([1.0, 1.0, -1.0])) @ eye > 1.0)
    torch.testing.assert_close(twin[behind], point[behind] * torch.tensor([1.0, 1.0, -1.0]))


def test_an_inflated_disc_is_a_sphere():
    line = (torch.arange(64) + 0.5 - 32.0) / 24.0
    x, y = torch.meshgrid(line, -line, indexing="xy")
    squared = x * x + y * y
    normal = inflated_normals((squared < 1.0).float()[..., None])
    truth = torch.stack([x, y, (1.0 - squared).clamp(min=0.0).sqrt()], -1)
    inner = squared < 0.8  # the rim of a disc of pixels is ragged
    assert float(angle_deg(normal, truth)[inner].mean()) < 2.5


def test_area_weights_keep_what_is_inside_and_see_nothing_outside():
    weights = window_weights(10, 5, 0.0, 10.0)
    torch.testing.assert_close(weights.sum(1), torch.ones(5))
    torch.testing.assert_close(weights.sum(0), torch.full((10,), 0.5))
    assert torch.equal(window_weights(6, 6, 0.0, 6.0), torch.eye(6))
    # A window twice as wide as the source: half of it is outside.
    assert float(window_weights(8, 4, -4.0, 16.0).sum(1).mean()) == 0.5
    assert window_weights(8, 2, 1.5, 2.0)[0].tolist() == [0, 0.5, 0.5, 0, 0, 0, 0, 0]


def test_zoom_brings_a_small_object_to_the_framing_of_training():
    mask = torch.zeros(3, 100, 100, 1)
    mask[:, 40:60, 45:55] = 1.0  # 20 tall: fills 0.9 at a zoom of 4.5
    assert framing_zoom(mask) == pytest.approx(4.5)
    shown = resample(mask, 100, 4.5)
    assert float(shown[..., 0].sum(1).amax()) == pytest.approx(90.0, abs=0.1)
    mask[0, 50, 20:80] = 1.0  # another view is 60 wide: it must keep within 0.96
    assert framing_zoom(mask) == pytest.approx(0.96 * 50.0 / 30.0)
