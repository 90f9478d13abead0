import math

import pytest
import torch

from svim3d.numerics import dot, normalize
from svim3d.shading.monte_carlo import (
    Surface,
    gather_compiled,
    gather_plainly,
    shade_by_sampling,
    specular_brdf,
    strategy_counts,
)
from svim3d.shading.octahedral import (
    DOUBLE,
    octahedral_from_direction,
    sample_octahedral,
    texel_directions,
    texel_solid_angles,
)
from svim3d.shading.sampled_light import SampledLight

SIZE = 16


def sunny_environment(size: int = SIZE) -> torch.Tensor:
    """A dim sky with one texel of sun, a hundred thousand times brighter, on the lower seam."""
    sky = 0.5 + 0.4 * texel_directions(size, DOUBLE)[..., 1:2].expand(-1, -1, 3).clone()
    sky[2, 0] = torch.tensor([3e4, 2e4, 1e4], dtype=torch.float64)
    sky[9, 7] = 400.0
    return sky


def random_points(count: int, seed: int = 0) -> list[torch.Tensor]:
    """Normals, views in front of them, base colour, roughness, metallic."""
    generator = torch.Generator().manual_seed(seed)
    normal, wo = (
        normalize(torch.randn(count, 3, generator=generator, dtype=torch.float64)) for _ in "nv"
    )
    wo = normalize(torch.where(dot(normal, wo) < 0, -wo, wo) + 0.1 * normal)
    shapes = ((count, 3), (count, 1), (count, 1))
    return [normal, wo, *(torch.rand(*s, generator=generator, dtype=torch.float64) for s in shapes)]


def test_light_density_is_a_density():
    # Over the square exactly, and over the sphere by quadrature at texel centres of a finer map.
    light = SampledLight.build(sunny_environment())
    assert float(light.density.mean() * 4.0) == pytest.approx(1.0, abs=1e-12)
    fine = texel_directions(32 * SIZE, DOUBLE)
    omega = texel_solid_angles(32 * SIZE, DOUBLE)[..., None]
    assert float((light.density_towards(fine) * omega).sum()) == pytest.approx(1.0, abs=1e-4)


def test_light_directions_follow_their_density():
    # Bins are quarters of texels, so that places inside texels are tested too. Without the sun,
    # whose texel would hold nearly all counts. Chi-squared of k bins has mean k, deviation (2k)^.5.
    count, bins = 400_000, 2 * SIZE
    light = SampledLight.build(sunny_environment().clamp_max(3.0))
    u = torch.rand(count, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    column, row = ((octahedral_from_direction(light.sample(u)) + 1.0) * (bins / 2)).long().T
    found = torch.bincount(row * bins + column, minlength=bins * bins).double()
    share = light.density.view(SIZE, SIZE).repeat_interleave(2, 0).repeat_interleave(2, 1)
    expected = share.reshape(-1) * (4.0 / bins**2) * count
    chi_squared = float(((found - expected) ** 2 / expected).sum())
    assert abs(chi_squared - bins**2) < 4.0 * math.sqrt(2.0 * bins**2)


def test_black_light_is_sampled_evenly_and_bad_light_refused():
    light = SampledLight.build(torch.zeros(SIZE, SIZE, 3))
    even = texel_solid_angles(SIZE, DOUBLE).reshape(-1) / (4.0 * math.pi)
    torch.testing.assert_close(light.density * (4.0 / SIZE**2), even)
    with pytest.raises(ValueError, match="physical_radiance"):
        SampledLight.build(torch.full((SIZE, SIZE, 3), -1.0))


def test_compiled_kernel_equals_its_plain_twin():
    points = random_points(300)
    points[3][:20] = 0.0  # mirrors
    surface, light = Surface.build(*points), SampledLight.build(sunny_environment())
    u = torch.rand(300, 16, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    for samples in (1, 2, 16):
        arguments = (surface, light, strategy_counts(samples), u[:, :samples].contiguous())
        for fast, plain in zip(
            gather_compiled(*arguments), gather_plainly(*arguments), strict=True
        ):
            torch.testing.assert_close(fast, plain, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("samples", [4, 64])
def test_sampling_is_unbiased(samples):
    # Quadrature over a fine map is the truth; the mean of independent estimates must lie within
    # four standard errors of it, for few samples as for many.
    repeats = 4096 // samples * 4
    normal, wo, basecolor, _, metallic = random_points(6, seed=3)
    roughness = torch.tensor([[0.4], [0.5], [0.6], [0.7], [0.8], [1.0]], dtype=torch.float64)
    environment = sunny_environment()
    truth = quadrature(normal, wo, basecolor, roughness, metallic, environment)
    points = (t.repeat(repeats, 1) for t in (normal, wo, basecolor, roughness, metallic))
    shading = shade_by_sampling(
        *points,
        SampledLight.build(environment),
        samples=samples,
        generator=torch.Generator().manual_seed(0),
    )
    for lobe, expected in zip((shading.diffuse, shading.specular), truth, strict=True):
        estimates = lobe.view(repeats, 6, 3)
        allowed = 4.0 * estimates.std(0) / math.sqrt(repeats) + 2e-3 * expected
        assert bool(((estimates.mean(0) - expected).abs() < allowed).all())


def quadrature(normal, wo, basecolor, roughness, metallic, environment, size=768):
    """Diffuse and specular radiance as sums over all texels of a fine map."""
    wi = texel_directions(size, DOUBLE).view(-1, 3)
    omega = texel_solid_angles(size, DOUBLE).view(-1, 1)
    light = sample_octahedral(environment, wi) * omega
    surface = Surface.build(normal, wo, basecolor, roughness, metallic)
    lobes = []
    for p in range(len(normal)):
        n_dot_wi = wi @ normal[p][:, None]
        wh = normalize(wi + wo[p])
        cosine = n_dot_wi.clamp_min(1e-9)
        brdf = specular_brdf(
            (normal[p] @ wo[p]).view(1, 1),
            cosine,
            wh @ normal[p][:, None],
            wh @ wo[p][:, None],
            surface.f0[p][None],
            surface.alpha[p][None],
        )
        incoming = torch.where(n_dot_wi > 0, light * cosine, 0.0)
        lobes.append((surface.base[p] * incoming.sum(0), (brdf * incoming).sum(0)))
    return [torch.stack(lobe) for lobe in zip(*lobes, strict=True)]


def test_result_depends_on_the_seed_alone():
    points, light = random_points(50), SampledLight.build(sunny_environment())
    first, again, other = (
        shade_by_sampling(
            *points, light, samples=8, generator=torch.Generator().manual_seed(seed)
        ).radiance
        for seed in (0, 0, 1)
    )
    assert torch.equal(first, again)
    assert not torch.equal(first, other)
    empty = [t[:0] for t in points]
    generator = torch.Generator()
    assert len(shade_by_sampling(*empty, light, samples=8, generator=generator).radiance) == 0
    with pytest.raises(ValueError, match="at least one sample"):
        shade_by_sampling(*points, light, samples=0, generator=generator)
