"""Texels from pixels: the operator against rendering, the solver against a dense solve."""

import scipy.sparse
import torch

from svim3d.cameras import orbit_cameras
from svim3d.mesh.mesh import vertex_normals
from svim3d.raster.texture import bilinear_taps, sample_texture
from svim3d.render.deferred import Geometry, TextureMaterials, render_mesh
from svim3d.render.texture_fit import SAMPLES_PER_AXIS, fit_texels, texel_view
from svim3d.shading.linear_operator import SparseOperator

SIZE = 48


def a_card():
    """A unit square facing +z with its texture upright, seen by three cameras from the front."""
    vertices = torch.tensor(
        [[-0.5, -0.5, 0.0], [0.5, -0.5, 0.0], [0.5, 0.5, 0.0], [-0.5, 0.5, 0.0]]
    )
    faces = torch.tensor([[0, 1, 2], [0, 2, 3]])
    uv = torch.tensor([[0.05, 0.95], [0.95, 0.95], [0.95, 0.05], [0.05, 0.05]])
    angles = [(5.0, 0.0), (5.0, 20.0), (5.0, 340.0)]
    return vertices, faces, uv, orbit_cameras(angles, radius=2.2, fov_y_deg=33.8, size=40)


def rendered(texture, card):
    """Basecolor of all views, every pixel the mean of its samples."""
    vertices, faces, uv, cameras = card
    geometry = Geometry(vertices, faces, vertex_normals(vertices, faces), uv)
    materials = TextureMaterials(texture, torch.ones(SIZE, SIZE, 3))
    views = [
        render_mesh(geometry, materials, cameras, view=v, supersample=SAMPLES_PER_AXIS).basecolor
        for v in range(len(cameras))
    ]
    return torch.stack(views).reshape(-1, 3)


def a_texture():
    return torch.rand(SIZE, SIZE, 3, generator=torch.Generator().manual_seed(0))


def test_taps_reproduce_bilinear_sampling():
    uv = torch.rand(50, 2, generator=torch.Generator().manual_seed(1))
    index, weight = bilinear_taps(uv, SIZE, SIZE)
    by_taps = (a_texture().view(-1, 3)[index] * weight[..., None]).sum(1)
    assert torch.allclose(by_taps, sample_texture(a_texture(), uv), atol=1e-6)


def test_operator_equals_a_supersampled_rendering():
    card = a_card()
    seen = texel_view(*card, texture_size=SIZE)
    assert len(seen.pixel) > 1000
    predicted = seen.operator(a_texture().view(-1, 3))
    assert torch.allclose(predicted, rendered(a_texture(), card)[seen.pixel], atol=1e-5)


def test_pixels_at_the_rim_or_off_the_card_are_left_out():
    card = a_card()
    seen = texel_view(*card, texture_size=SIZE)
    covered = rendered(torch.ones(SIZE, SIZE, 3), card)[:, 0]
    assert torch.allclose(covered[seen.pixel], torch.ones(len(seen.pixel)), atol=1e-5)
    assert (covered > 0).sum() > len(seen.pixel)
    assert (seen.trust > 0.8).all()


def test_fit_recovers_detail_that_the_start_has_lost():
    card = a_card()
    seen = texel_view(*card, texture_size=SIZE)
    truth = torch.nn.functional.avg_pool2d(a_texture().permute(2, 0, 1), 3, 1, 1).permute(1, 2, 0)
    blurred = torch.nn.functional.avg_pool2d(truth.permute(2, 0, 1), 5, 1, 2).permute(1, 2, 0)
    target = rendered(truth, card)[seen.pixel]
    fitted = fit_texels(
        seen.operator, target, seen.trust, blurred.reshape(-1, 3), prior=1e-3, iterations=40
    ).view(SIZE, SIZE, 3)
    inner = slice(6, -6)
    before = (blurred - truth)[inner, inner].square().mean()
    after = (fitted - truth)[inner, inner].square().mean()
    assert after < before / 5


def test_texels_that_no_view_sees_keep_their_value():
    card = a_card()
    seen = texel_view(*card, texture_size=SIZE)
    start = a_texture().view(-1, 3)
    fitted = fit_texels(
        seen.operator, torch.zeros(len(seen.pixel), 3), seen.trust, start, prior=0.1, iterations=5
    )
    assert torch.equal(fitted.view(SIZE, SIZE, 3)[:, 0], a_texture()[:, 0])
    assert not torch.equal(fitted, start)


def test_conjugate_gradients_reach_the_dense_solution():
    generator = torch.Generator().manual_seed(2)
    matrix = torch.rand(30, 12, dtype=torch.float64, generator=generator)
    matrix[matrix < 0.6] = 0.0
    target = torch.rand(30, 2, dtype=torch.float64, generator=generator)
    weight = torch.rand(30, 1, dtype=torch.float64, generator=generator)
    start = torch.rand(12, 2, dtype=torch.float64, generator=generator)
    operator = SparseOperator(scipy.sparse.csr_matrix(matrix.numpy()))
    fitted = fit_texels(operator, target, weight, start, prior=0.05, iterations=40)
    normal = matrix.T @ (weight * matrix) + 0.05 * torch.eye(12, dtype=torch.float64)
    dense = torch.linalg.solve(normal, matrix.T @ (weight * target) + 0.05 * start)
    assert torch.allclose(fitted, dense, atol=1e-9)


def test_a_start_that_is_already_exact_stays():
    card = a_card()
    seen = texel_view(*card, texture_size=SIZE)
    start = torch.zeros(SIZE * SIZE, 1)
    target = torch.zeros(len(seen.pixel), 1)
    fitted = fit_texels(seen.operator, target, seen.trust, start, prior=0.1, iterations=3)
    assert torch.equal(fitted, start)
