import math

import numpy as np
import pytest
import scipy.sparse
import torch

from svim3d.numerics import normalize
from svim3d.shading.linear_operator import SparseOperator
from svim3d.shading.lobe_quadrature import exact_rows
from svim3d.shading.lobe_sampling import (
    cosine_lobe_samples,
    ggx_lobe_samples,
    halton,
    sample_lod,
    sampled_rows,
    tangent_frame,
)
from svim3d.shading.octahedral import (
    DOUBLE,
    sample_octahedral,
    texel_directions,
    texel_solid_angles,
)
from svim3d.shading.prefilter import PyramidOperator, mip_sizes, pooling_matrix

SIZE = 16


def random_map(size: int, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(size, size, 3, generator=generator, dtype=torch.float64) ** 4


def random_directions(count: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(3)
    return normalize(torch.randn(count, 3, generator=generator, dtype=torch.float64))


def brute_force(radiance, axes, alpha, subdivision=8):
    """Quadrature of the lobe over every texel, `subdivision`^2 points each."""
    n = radiance.shape[0] * subdivision
    d, omega = texel_directions(n, DOUBLE).view(-1, 3), texel_solid_angles(n, DOUBLE).view(-1)
    fine = radiance.repeat_interleave(subdivision, 0).repeat_interleave(subdivision, 1)
    cosine = (axes @ d.T).clamp(0.0, 1.0)
    half_squared = 0.5 * (1.0 + cosine)
    lobe = cosine / (alpha * alpha * half_squared + 1.0 - half_squared) ** 2 * omega
    return (lobe @ fine.reshape(-1, 3)) / lobe.sum(1, keepdim=True)


@pytest.mark.parametrize("mode", ["sampled", "exact", "hybrid"])
def test_constant_environment_gives_constant_pyramid(mode):
    operator = PyramidOperator.build(SIZE, mode)
    pyramid = operator(torch.full((SIZE, SIZE, 3), 1.75, dtype=torch.float64))
    torch.testing.assert_close(pyramid.texels, torch.full_like(pyramid.texels, 1.75))
    d, roughness = random_directions(200), torch.rand(200, 1, dtype=torch.float64)
    expected = torch.full((200, 3), 1.75, dtype=torch.float64)
    torch.testing.assert_close(pyramid.specular(d, roughness), expected)
    torch.testing.assert_close(pyramid.irradiance(d), expected)


def test_mips_hold_the_same_energy():
    radiance = random_map(SIZE)
    stack = torch.from_numpy(pooling_matrix(SIZE) @ radiance.view(-1, 3).numpy())
    expected = (radiance * texel_solid_angles(SIZE, DOUBLE)[..., None]).sum((0, 1))
    start = 0
    for n in mip_sizes(SIZE):
        mip = stack[start : start + n * n]
        energy = (mip * texel_solid_angles(n, DOUBLE).view(-1, 1)).sum(0)
        torch.testing.assert_close(energy, expected)
        start += n * n


@pytest.mark.parametrize("roughness", [0.2, 0.5, 1.0])
def test_exact_rows_match_brute_force(roughness):
    radiance, mips, n = random_map(32), mip_sizes(32), 8
    stack = pooling_matrix(32) @ radiance.view(-1, 3).numpy()
    axes = texel_directions(n, DOUBLE).view(-1, 3)
    truth = brute_force(radiance, axes, roughness**2)
    fine = torch.from_numpy(exact_rows(n, mips, roughness, 0.1) @ stack)
    rough = torch.from_numpy(exact_rows(n, mips, roughness, 0.7) @ stack)
    scale = truth.mean()
    assert float((fine - truth).abs().mean() / scale) < 0.01
    assert float((rough - truth).abs().mean() / scale) < 0.06


def test_exact_rows_count_every_direction_once():
    # Weights are positive, sum to one within float32, and a texel and its mips never overlap.
    mips = mip_sizes(SIZE)
    matrix = exact_rows(SIZE, mips, 0.3, 0.7)
    assert float(matrix.data.min()) > 0.0
    np.testing.assert_allclose(matrix.astype(float).sum(1), 1.0, atol=5e-7)
    covered = (matrix != 0).astype(float) @ (pooling_matrix(SIZE) != 0).astype(float)
    assert covered.max() == 1.0


def test_half_sky_irradiance_is_a_raised_cosine():
    # Light from the upper half alone gives E = pi (1 + cos theta) / 2 at a normal theta from up.
    size = 64
    height = texel_directions(size, DOUBLE)[..., 1:2]
    # Texels centred on the horizon are lit by half.
    sky = torch.where(height.abs() < 1e-9, 0.5, (height > 0).double()).expand(-1, -1, 3)
    pyramid = PyramidOperator.build(size, "exact")(sky)
    normal = random_directions(300)
    expected = (1.0 + normal[:, 1:2]) / 2.0
    error = pyramid.irradiance(normal) - expected
    # At most half a texel of slope is lost where the map has a crease, and 0.008 by quadrature.
    assert float(error.abs().max()) < 0.03
    assert float(error.abs().mean()) < 0.008


@pytest.mark.parametrize("roughness", [0.25, 1.0, None])
def test_sampled_rows_equal_the_direct_loop(roughness):
    radiance, mips, n = random_map(SIZE), mip_sizes(SIZE), 4
    stack = torch.from_numpy(pooling_matrix(SIZE) @ radiance.view(-1, 3).numpy())
    starts = np.cumsum([0, *(m * m for m in mips)])
    maps = [stack[a : a + m * m].view(m, m, 3) for a, m in zip(starts, mips, strict=False)]
    samples = 6
    local, density, weight = (
        cosine_lobe_samples(samples) if roughness is None else ggx_lobe_samples(samples, roughness)
    )
    expected = torch.zeros(n * n, 3, dtype=torch.float64)
    for index, normal in enumerate(texel_directions(n, DOUBLE).view(-1, 1, 3)):
        tangent, bitangent = tangent_frame(normal)
        for s in range(len(local)):
            d = local[s, 0] * tangent + local[s, 1] * bitangent + local[s, 2] * normal
            lod = float(
                sample_lod(d, float(1.0 / (samples * density[s])), SIZE, len(mips) - 1, 1.0)
            )
            lower = min(int(lod), len(mips) - 2)
            blend = lod - lower
            value = (1 - blend) * sample_octahedral(maps[lower], d)
            value = value + blend * sample_octahedral(maps[lower + 1], d)
            expected[index] += (weight[s] / weight.sum() * value)[0]
    found = torch.from_numpy(sampled_rows(n, mips, roughness, samples, 1.0) @ stack.numpy())
    torch.testing.assert_close(found, expected)


def test_sampled_lobes_converge_to_the_exact_ones():
    # A smooth map: what remains at 256 samples is the filter's own blur.
    d = texel_directions(32, DOUBLE)
    radiance = 1.0 + d * d.roll(1, -1)
    stack, mips = pooling_matrix(32) @ radiance.view(-1, 3).numpy(), mip_sizes(32)
    for roughness in (0.5, 1.0):
        exact = exact_rows(8, mips, roughness, 0.1) @ stack
        few, many = (sampled_rows(8, mips, roughness, n, 1.0) @ stack for n in (16, 256))
        assert np.abs(many - exact).mean() < 0.01
        assert np.abs(many - exact).mean() < 0.5 * np.abs(few - exact).mean()


def test_ggx_samples_have_the_stated_density():
    # The mean of 1/density over samples is the solid angle that they cover: below 2 pi, since
    # directions under the horizon are dropped, and the mean of cosine^k follows by quadrature.
    local, density, _ = ggx_lobe_samples(4096, 0.6)
    alpha = 0.36
    z = torch.linspace(0.0, 1.0, 20_001, dtype=torch.float64)
    half_squared = 0.5 * (1.0 + z)
    pdf = alpha**2 / (4 * math.pi * (1 + (alpha**2 - 1) * half_squared) ** 2)
    above = torch.trapezoid(2 * math.pi * pdf, z)
    assert len(local) / 4096 == pytest.approx(float(above), abs=2e-3)
    mean_cosine = torch.trapezoid(2 * math.pi * pdf * z, z) / above
    assert float(local[:, 2].mean()) == pytest.approx(float(mean_cosine), abs=2e-3)
    assert float(density.min()) > 0.0


def test_halton_is_the_radical_inverse():
    assert halton(4, 2).tolist() == [0.5, 0.25, 0.75, 0.125]
    np.testing.assert_allclose(halton(3, 3), [1 / 3, 2 / 3, 1 / 9])


def test_tangent_frame_is_orthonormal_and_right_handed():
    n = torch.cat([random_directions(100), torch.tensor([[0.0, 0, -1]], dtype=torch.float64)])
    frame = torch.stack([*tangent_frame(n), n], 1)
    identity = torch.eye(3, dtype=torch.float64).expand(101, 3, 3)
    torch.testing.assert_close(frame @ frame.mT, identity)
    torch.testing.assert_close(torch.linalg.det(frame), torch.ones(101, dtype=torch.float64))


def test_levels_blend_linearly_in_roughness():
    operator = PyramidOperator.build(SIZE, "exact")
    pyramid, layout = operator(random_map(SIZE)), operator.layout
    d = random_directions(30)
    for level in range(len(layout.roughness)):
        roughness = torch.full((30, 1), layout.roughness[level], dtype=torch.float64)
        expected = sample_octahedral(pyramid.level(level), d)
        torch.testing.assert_close(pyramid.specular(d, roughness), expected, rtol=1e-5, atol=1e-7)


def test_lookup_and_operator_gradients():
    operator = PyramidOperator.build(8, "exact")
    d = random_directions(5).requires_grad_()
    roughness = torch.tensor([[0.03], [0.2], [0.45], [0.6], [0.9]], dtype=torch.float64)

    def chain(radiance, direction, roughness):
        pyramid = operator(radiance)
        return pyramid.specular(direction, roughness) + pyramid.irradiance(direction)

    inputs = (random_map(8).requires_grad_(), d, roughness.requires_grad_())
    assert torch.autograd.gradcheck(chain, inputs)


def test_wrong_sizes_are_refused():
    with pytest.raises(ValueError, match="power of two"):
        PyramidOperator.build(24, "exact")
    with pytest.raises(ValueError, match=r"prefilters 8\^2 maps, got 16\^2"):
        PyramidOperator.build(8, "exact")(torch.ones(16, 16, 3))


def test_sparse_operator_twins_and_adjoint():
    generator = np.random.default_rng(0)
    matrix = scipy.sparse.random(40, 30, 0.2, format="csr", random_state=generator)
    operator = SparseOperator(matrix)
    x = torch.rand(30, 3, dtype=torch.float64, requires_grad=True)
    expected = torch.from_numpy(matrix @ x.detach().numpy())
    torch.testing.assert_close(operator(x), expected)
    torch.testing.assert_close(operator.forward_matrix.tensor(x) @ x.detach(), expected)
    y = torch.rand(40, 3, dtype=torch.float64, requires_grad=True)
    torch.testing.assert_close((operator(x) * y).sum(), (x * operator.adjoint(y)).sum())
    assert torch.autograd.gradcheck(operator, (x,))
    assert torch.autograd.gradcheck(operator.adjoint, (y,))
    single = operator(x.detach().float())
    torch.testing.assert_close(single, expected.float())
