import math

import pytest
import torch
from sphere_orbit import sphere_cameras, sphere_images

from svim3d.color import srgb_from_linear
from svim3d.render.view_figures import Perceptual, relit, view_figures
from svim3d.shading.prefilter import PyramidOperator


@pytest.fixture(scope="module")
def seen():
    cameras = sphere_cameras(2, 32)
    return cameras, sphere_images(cameras)


def one_view(images):
    return {name: image[0] for name, image in images.items()}


def test_the_truth_is_perfect(seen):
    truth = one_view(seen[1])
    figures = view_figures(truth, truth, gain=0.5, true_gain=0.5)
    assert figures["mask_iou"] == 1.0
    assert math.isinf(figures["rgb_db"]) and math.isinf(figures["basecolor_db"])
    assert figures["rgb_ssim"] == pytest.approx(1.0)
    assert figures["roughness_rmse"] == figures["metallic_rmse"] == 0.0
    assert figures["normal_deg"] == pytest.approx(0.0, abs=1e-6)


def test_a_photo_s_exposure_is_taken_out(seen):
    truth = one_view(seen[1])
    shown = truth | {"radiance": 0.5 * truth["radiance"]}
    assert view_figures(shown, truth, gain=1.0, true_gain=0.5)["rgb_db"] > 120


def test_a_scaled_basecolor_is_right_but_for_its_scale(seen):
    truth = one_view(seen[1])
    shown = truth | {"basecolor": 0.5 * truth["basecolor"]}
    figures = view_figures(shown, truth, gain=1.0, true_gain=1.0)
    assert figures["basecolor_scaled_db"] > 100
    mask = truth["mask"][..., 0] > 0.5
    apart = srgb_from_linear(0.5 * truth["basecolor"]) - srgb_from_linear(truth["basecolor"])
    expected = -10 * math.log10(float(apart[mask].square().mean()))
    assert figures["basecolor_db"] == pytest.approx(expected, abs=1e-3)


def test_what_is_not_shown_is_black_and_edge_on(seen):
    truth = one_view(seen[1])
    nothing = {name: 0.0 * image for name, image in truth.items()}
    figures = view_figures(nothing, truth, gain=1.0, true_gain=1.0)
    assert figures["mask_iou"] == 0.0
    assert figures["normal_deg"] == pytest.approx(90.0)
    assert figures["roughness_rmse"] == pytest.approx(0.5, abs=1e-3)


def test_only_what_both_have_is_compared(seen):
    truth = one_view(seen[1])
    bare = {name: truth[name] for name in ("radiance", "mask")}
    assert view_figures(truth, bare, gain=1.0, true_gain=1.0).keys() == {
        "mask_iou",
        "rgb_db",
        "rgb_ssim",
    }


def test_rough_plastic_in_even_light_shows_its_basecolor(seen):
    cameras, images = seen
    size = 16
    light = PyramidOperator.build(size)(torch.full((size, size, 3), 2.0))
    plastic = images | {
        "metallic": torch.zeros_like(images["mask"]),
        "roughness": torch.ones_like(images["mask"]),
    }
    shown = relit(cameras, plastic, 0, light)
    inside = images["mask"][0, ..., 0] > 0
    ratio = shown[inside] / (2.0 * images["basecolor"][0][inside])
    # A dielectric's layer takes from the base what it reflects: a few per cent of white.
    assert 0.9 < float(ratio.median()) < 1.1
    assert float(shown[~inside].abs().max()) == 0.0


def test_a_learned_distance_is_called_by_its_name(seen):
    truth = one_view(seen[1])
    asked = []

    def distance(image, true):
        asked.append((image, true))
        return (image - true).abs().mean()

    shown = truth | {"radiance": 0.0 * truth["radiance"]}
    figures = view_figures(
        shown, truth, gain=1.0, true_gain=1.0, perceptual=Perceptual("st_lpips", distance)
    )
    mask = (truth["mask"] > 0.5).expand(-1, -1, 3)
    encoded = torch.where(mask, srgb_from_linear(truth["radiance"].clamp(0, 1)), 0.0)
    assert figures["rgb_st_lpips"] == pytest.approx(float(encoded.mean()), rel=1e-5)
    assert figures["basecolor_st_lpips"] == 0.0
    # Outside the true mask all is black.
    assert all(float((image[0] * ~mask).abs().max()) == 0.0 for pair in asked for image in pair)
