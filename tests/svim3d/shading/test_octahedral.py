import math

import pytest
import torch

from svim3d.numerics import normalize
from svim3d.shading.octahedral import (
    DOUBLE,
    bilinear_taps,
    direction_from_octahedral,
    octahedral_from_direction,
    sample_octahedral,
    texel_directions,
    texel_solid_angles,
    total_variation,
)


def random_directions(count: int, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return normalize(torch.randn(count, 3, generator=generator, dtype=torch.float64))


def test_round_trip():
    d = random_directions(1000)
    torch.testing.assert_close(direction_from_octahedral(octahedral_from_direction(d)), d)


def test_axes_lie_where_the_docstring_says():
    up_down_x_z = torch.tensor([[0.0, 1, 0], [0, -1, 0], [1, 0, 0], [0, 0, 1]])
    expected = torch.tensor([[0.0, 0], [1, 1], [1, 0], [0, 1]])
    torch.testing.assert_close(octahedral_from_direction(up_down_x_z), expected)


@pytest.mark.parametrize("n", [2, 6, 32, 128])
def test_solid_angles_sum_to_the_sphere(n):
    assert float(texel_solid_angles(n, DOUBLE).sum()) == pytest.approx(4 * math.pi, abs=1e-12)


def test_solid_angles_subdivide_exactly():
    fine = texel_solid_angles(16, DOUBLE).view(8, 2, 8, 2).sum((1, 3))
    torch.testing.assert_close(fine, texel_solid_angles(8, DOUBLE), rtol=0, atol=1e-14)


def test_solid_angles_match_the_density():
    # Source of 4 |d|_1^3 / n^2: the Jacobian of the projection, exact in the limit of small texels.
    d = texel_directions(128, DOUBLE)
    relative = texel_solid_angles(128, DOUBLE) / (4.0 * d.abs().sum(-1) ** 3 / 128**2) - 1.0
    # Texels on a fold lie on two faces; the others agree to the square of a texel's side.
    folded = (octahedral_from_direction(d).abs().sum(-1) - 1.0).abs() < 1e-9
    assert float(relative[~folded].abs().max()) < 2e-3
    assert float(relative[folded].abs().max()) < 2e-2


def test_odd_size_is_refused():
    with pytest.raises(ValueError, match="even size, got 5"):
        texel_solid_angles(5)


def test_lookup_at_texel_centres_is_exact():
    values = torch.rand(8, 8, 3, dtype=torch.float64)
    found = sample_octahedral(values, texel_directions(8, DOUBLE).view(-1, 3))
    torch.testing.assert_close(found, values.view(-1, 3))


def test_lookup_is_continuous_across_every_seam():
    values = torch.rand(8, 8, 1, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    t = torch.linspace(-1.0, 1.0, 401, dtype=torch.float64)
    edge = torch.full_like(t, 1.0 - 1e-9)
    for uv in (torch.stack([edge, t], -1), torch.stack([t, -edge], -1)):
        d = direction_from_octahedral(uv)
        # The same point of the sphere lies on the same edge, mirrored in its middle.
        other = direction_from_octahedral(torch.where(uv.abs() == edge[:, None], uv, -uv))
        torch.testing.assert_close(d, other, rtol=0, atol=1e-8)
        difference = sample_octahedral(values, d) - sample_octahedral(values, other)
        assert float(difference.abs().max()) < 1e-7


def test_seam_interpolates_as_well_as_the_interior():
    def smooth(d):
        return (2.0 * d[..., :1] + d[..., 1:2] * d[..., 2:]).sin()

    values = smooth(texel_directions(32, DOUBLE))
    d = random_directions(20_000)
    error = (sample_octahedral(values, d) - smooth(d)).abs()[:, 0]
    uv = octahedral_from_direction(d)
    near_seam = uv.abs().amax(-1) > 1.0 - 1.0 / 32
    assert int(near_seam.sum()) > 100
    assert float(error[near_seam].max()) < 1.5 * float(error[~near_seam].max())


def test_size_may_differ_from_point_to_point():
    d = random_directions(50)
    sizes = torch.tensor([4, 16]).repeat(25)
    indices, weights = bilinear_taps(d, sizes)
    for n in (4, 16):
        expected_indices, expected_weights = bilinear_taps(d[sizes == n], n)
        assert torch.equal(indices[sizes == n], expected_indices)
        assert torch.equal(weights[sizes == n], expected_weights)


def test_lookup_gradients():
    values = torch.rand(6, 6, 2, dtype=torch.float64, requires_grad=True)
    d = random_directions(20).requires_grad_()
    assert torch.autograd.gradcheck(sample_octahedral, (values, d))


def test_total_variation_is_zero_only_without_variation_and_sees_the_seams():
    assert float(total_variation(torch.full((8, 8, 3), 2.0))) == 0.0
    # A step across the vertical middle: 8 of 56 rows' pairs, and every seam on top and bottom.
    step = torch.zeros(8, 8, 1)
    step[:, 4:] = 1.0
    pairs = 2 * 8 * 7 + 4 * 8
    assert float(total_variation(step)) == pytest.approx((8 + 2 * 8) / pairs)
