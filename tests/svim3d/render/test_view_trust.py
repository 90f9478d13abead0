"""Trust by angle on a sphere with a formula; a view that fights the others loses its weight."""

import pytest
import torch
from sphere_orbit import sphere_cameras, sphere_images

from svim3d.numerics import dot, normalize, smoothstep
from svim3d.render.view_trust import (
    DEVIATIONS,
    MIN_EXCESS,
    TRUSTED_COSINE,
    bilateral_normals,
    facing_trust,
    view_weights,
)

CAMERAS = sphere_cameras(views=4, size=32)
IMAGES = sphere_images(CAMERAS)


def test_trust_is_the_smoothstep_of_the_cosine_over_the_best_views():
    gamma = 1.5
    trust = facing_trust(IMAGES["normal_world"], IMAGES["mask"], CAMERAS, gamma=gamma)
    towards = normalize(CAMERAS.positions)
    for view in range(4):
        _, rays = CAMERAS.rays(view)
        normal = IMAGES["normal_world"][view].reshape(-1, 3)
        here = dot(normal, -rays)[:, 0]
        best = torch.maximum((normal @ towards.T).amax(1), here)
        want = smoothstep(here / best / TRUSTED_COSINE) ** gamma
        # Inside, where the filter's neighbours lie on the sphere all around.
        inside = here > 0.5
        assert int(inside.sum()) > 100
        torch.testing.assert_close(
            trust[view].reshape(-1)[inside], want[inside], atol=0.03, rtol=0.0
        )


def test_trust_falls_to_the_rim_and_is_one_off_the_object():
    cameras = sphere_cameras(views=4, size=96)
    images = sphere_images(cameras)
    trust = facing_trust(images["normal_world"], images["mask"], cameras, gamma=1.0)
    covered = images["mask"] > 0.0
    assert bool((trust[~covered] == 1.0).all())
    normal = images["normal_world"][0].reshape(-1, 3)
    _, rays = cameras.rays(0)
    cosine, seen = dot(normal, -rays)[:, 0], covered[0].reshape(-1)
    # The next camera, a quarter around, looks straight at these.
    slanted = seen & (cosine < 0.25) & (normal[:, 1].abs() < 0.3)
    assert int(slanted.sum()) > 20
    assert float(trust[0].reshape(-1)[slanted].mean()) < 0.6
    assert float(trust[0].reshape(-1)[seen & (cosine > 0.8)].min()) > 0.99


def test_a_surface_that_no_camera_faces_is_trusted_as_far_as_its_best_view():
    """The top of things is slanted to a whole orbit; nobody sees it better."""
    up = torch.tensor([0.0, 1.0, 0.0]).expand(4, 32, 32, 3)
    mask = torch.ones(4, 32, 32, 1)
    trust = facing_trust(up, mask, CAMERAS, gamma=1.0)
    highest = int(CAMERAS.positions[:, 1].argmax())
    assert float(trust[highest, 16, 16, 0]) == pytest.approx(1.0, abs=1e-3)


def test_the_filter_smooths_noise_and_keeps_an_edge():
    normals = torch.zeros(16, 16, 3)
    normals[:, :8, 2], normals[:, 8:, 0] = 1.0, 1.0
    generator = torch.Generator().manual_seed(0)
    noisy = normalize(normals + 0.05 * torch.randn(16, 16, 3, generator=generator))
    filtered = normalize(bilateral_normals(noisy, torch.ones(16, 16, 1)))

    def error(values):
        return float((values - normals).norm(dim=-1).mean())

    assert error(filtered) < 0.5 * error(noisy)
    assert bool((filtered[:, 7] @ normals[0, 0] > 0.98).all())
    assert bool((filtered[:, 8] @ normals[0, 15] > 0.98).all())


def test_an_outlier_counts_less_and_the_others_wholly():
    residuals = torch.tensor([1.0, 1.1, 0.9, 1.05, 0.95, 30.0, 1.0])
    weights = view_weights(residuals, reference=0)
    assert weights[[0, 1, 2, 3, 4, 6]].tolist() == [1.0] * 6
    assert 0.0 < float(weights[5]) < 0.01


def test_views_that_differ_a_little_or_all_alike_keep_their_weight():
    assert bool((view_weights(torch.ones(5), reference=0) == 1.0).all())
    assert bool((view_weights(torch.tensor([1.0, 1.0, 1.0, 0.99 * MIN_EXCESS]), 0) == 1.0).all())
    spread = torch.tensor([1.0, 2.0, 4.0, 8.0, 16.0])
    assert bool((view_weights(spread, reference=0) == 1.0).all())
    assert DEVIATIONS >= 2.0


def test_the_reference_always_counts_wholly():
    residuals = torch.tensor([1.0, 1.1, 0.9, 50.0])
    assert float(view_weights(residuals, reference=3)[3]) == 1.0
    assert float(view_weights(residuals, reference=0)[3]) < 0.01
