import math

import numpy as np
import pytest
import torch

from svim3d.numerics import dot, normalize
from svim3d.shading.directional_albedo import integrate_split_sum
from svim3d.shading.environment_sampling import SampledLight
from svim3d.shading.monte_carlo import shade_by_sampling, specular_brdf
from svim3d.shading.octahedral import (
    DOUBLE,
    direction_from_octahedral,
    octahedral_from_direction,
    sample_octahedral,
    texel_directions,
    texel_solid_angles,
)

SUN = torch.tensor([0.4, 0.8, -0.3], dtype=torch.float64)


def sunny(n: int = 16) -> torch.Tensor:
    """A dim gradient and a sun within one texel, 2000 times as bright; black below."""
    d = texel_directions(n, DOUBLE)
    sky = (0.4 * d[..., 1:2]).clamp_min(0.0).expand(-1, -1, 3).clone()
    nearest = int((d.view(-1, 3) @ normalize(SUN)).argmax())
    sky.view(-1, 3)[nearest] = 800.0 * torch.tensor([1.0, 0.9, 0.7], dtype=torch.float64)
    return sky


def fine_grid(n: int = 256) -> tuple[torch.Tensor, torch.Tensor]:
    """Directions and solid angles of a fine quadrature of the sphere."""
    return texel_directions(n, DOUBLE).view(-1, 3), texel_solid_angles(n, DOUBLE).view(-1, 1)


def one_point(n_dot_v: float, count: int) -> tuple[torch.Tensor, torch.Tensor]:
    """The same tilted normal and view, repeated."""
    normal = normalize(torch.tensor([0.2, 1.0, 0.1], dtype=torch.float64))
    tangent = normalize(torch.linalg.cross(normal, torch.tensor([0.3, 0.1, 1.0]).double()))
    wo = n_dot_v * normal + math.sqrt(1.0 - n_dot_v**2) * tangent
    return normal.expand(count, 3), wo.expand(count, 3)


def test_density_of_the_light_integrates_to_one():
    light = SampledLight.build(sunny())
    directions, omega = fine_grid()
    # The midpoint of the Jacobian over a texel of 256^2 is right to 1e-4.
    assert float((light.density(directions) * omega).sum()) == pytest.approx(1.0, abs=2e-4)


def test_drawn_directions_follow_their_density():
    # Chi-square over quarter texels: also the place within a texel must be right.
    n, count = 4, 200_000
    d = texel_directions(n, DOUBLE)
    light = SampledLight.build((1.2 + d[..., :1] + 3.0 * (d[..., 1:2] > 0.6)).expand(-1, -1, 3))
    u = torch.rand(count, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    drawn = light.sample(u)
    cell = ((octahedral_from_direction(drawn) * 0.5 + 0.5) * 2 * n).long().clamp(0, 2 * n - 1)
    found = torch.bincount(cell[:, 1] * 2 * n + cell[:, 0], minlength=4 * n * n)
    expected = light.probability.view(n, n).repeat_interleave(2, 0).repeat_interleave(2, 1)
    expected = expected.reshape(-1) * count / (n * n)
    chi_square = float(((found - expected) ** 2 / expected).sum())
    # 63 degrees of freedom: mean 63, standard deviation 11; 110 has probability 2e-4.
    assert chi_square < 110.0
    torch.testing.assert_close(drawn.norm(dim=1), torch.ones(count).double())


def test_every_lit_direction_can_be_drawn():
    light = SampledLight.build(sunny())
    directions, _ = fine_grid(128)
    lit = sample_octahedral(light.radiance, directions).sum(-1) > 0
    assert float(light.density(directions)[lit].min()) > 0.0


def test_black_light_is_drawn_from_evenly_and_gives_black():
    light = SampledLight.build(torch.zeros(8, 8, 3).double())
    normal, wo = one_point(0.5, 4)
    grey = torch.full((4, 3), 0.5, dtype=torch.float64)
    shading = shade_by_sampling(
        normal, wo, grey, grey[:, :1], grey[:, :1], light, samples=8,
        generator=torch.Generator().manual_seed(0),
    )  # fmt: skip
    assert float(shading.radiance.abs().max()) == 0.0


@pytest.mark.parametrize(
    ("n_dot_v", "roughness", "metallic"),
    [(0.9, 0.3, 1.0), (0.5, 0.5, 0.0), (0.15, 0.7, 0.5), (0.3, 1.0, 1.0)],
)
def test_sampling_agrees_with_quadrature(n_dot_v, roughness, metallic):
    light, count = SampledLight.build(sunny()), 512
    normal, wo = one_point(n_dot_v, count)
    basecolor = torch.tensor([0.9, 0.5, 0.2], dtype=torch.float64).expand(count, 3)
    r, m = (torch.full((count, 1), x, dtype=torch.float64) for x in (roughness, metallic))
    found = shade_by_sampling(
        normal, wo, basecolor, r, m, light, samples=96,
        generator=torch.Generator().manual_seed(0),
    )  # fmt: skip
    wi, omega = fine_grid(512)
    n, v = normal[:1].expand_as(wi), wo[:1].expand_as(wi)
    wh, cosine = normalize(wi + v), dot(wi, n)
    f0 = (0.04 * (1.0 - m) + basecolor * m)[:1]
    alpha = (r * r)[:1].expand(len(wi), 1)
    lobe = specular_brdf(
        dot(n, v), cosine.clamp_min(1e-9), dot(n, wh), dot(v, wh), f0.expand_as(wi), alpha
    )
    incoming = sample_octahedral(light.radiance, wi) * cosine.clamp_min(0.0) * omega
    scale, bias = integrate_split_sum(dot(normal, wo)[:1], r[:1])
    base = basecolor[:1] * (1.0 - m[:1]) * (1.0 - f0 * scale - bias) / math.pi
    # 512 independent means; four standard errors, and 2e-3 for quadrature and table.
    for values, truth in (
        (found.specular, (lobe * incoming).sum(0)), (found.diffuse, (base * incoming).sum(0)),
    ):  # fmt: skip
        error = 4.0 * values.std(0) / math.sqrt(count) + 2e-3 * truth
        assert bool(((values.mean(0) - truth).abs() <= error).all())
        assert float((error / truth.clamp_min(1e-6)).max()) < 0.03 or float(truth.max()) == 0.0


def test_sampling_the_light_finds_a_sun():
    # Sixteen directions see a sun of one texel in 1024: without the light's own they miss it.
    light = SampledLight.build(sunny(32))
    normal, wo = one_point(0.7, 400)
    white = torch.ones(400, 3, dtype=torch.float64)
    radiance = shade_by_sampling(
        normal, wo, white, 0.6 * white[:, :1], 0 * white[:, :1], light, samples=24,
        generator=torch.Generator().manual_seed(0),
    ).radiance  # fmt: skip
    assert float((radiance.std(0) / radiance.mean(0)).max()) < 0.35


def test_visibility_hides_light_ray_by_ray():
    light = SampledLight.build(torch.ones(8, 8, 3).double())
    normal, wo = one_point(0.7, 6)
    white = torch.ones(6, 3, dtype=torch.float64)

    def shade(visibility):
        return shade_by_sampling(
            normal, wo, white, 0.5 * white[:, :1], 0 * white[:, :1], light, samples=30,
            generator=torch.Generator().manual_seed(0), visibility=visibility,
        ).radiance  # fmt: skip

    def only_even(point, wi):
        assert wi.shape == (180, 3)
        torch.testing.assert_close(wi.norm(dim=1), torch.ones(180).double())
        return (point % 2 == 0).double()[:, None]

    open_sky, covered = shade(None), shade(only_even)
    assert torch.equal(covered[::2], open_sky[::2])
    assert float(covered[1::2].abs().max()) == 0.0


def test_result_does_not_depend_on_the_chunk_size(monkeypatch):
    light = SampledLight.build(sunny())
    normal, wo = one_point(0.7, 10)
    grey = torch.full((10, 3), 0.5, dtype=torch.float64)
    results = []
    for rays in (1 << 18, 64):
        monkeypatch.setattr("svim3d.shading.monte_carlo.MAX_RAYS", rays)
        results.append(
            shade_by_sampling(
                normal, wo, grey, grey[:, :1], grey[:, :1], light, samples=16,
                generator=torch.Generator().manual_seed(0),
            ).radiance
        )  # fmt: skip
    torch.testing.assert_close(*results, rtol=1e-12, atol=0)


def test_too_few_samples_are_refused():
    light = SampledLight.build(sunny())
    normal, wo = one_point(0.7, 1)
    grey = torch.full((1, 3), 0.5, dtype=torch.float64)
    with pytest.raises(ValueError, match="at least 3, got 2"):
        shade_by_sampling(
            normal, wo, grey, grey[:, :1], grey[:, :1], light, samples=2,
            generator=torch.Generator().manual_seed(0),
        )  # fmt: skip


def test_specular_reflection_is_reciprocal_and_the_diffuse_base_is_not():
    # The base receives what the lobe does not reflect towards the viewer, whatever the light's
    # direction: an energy-conserving coupling that is not reciprocal.
    generator = torch.Generator().manual_seed(0)
    z = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand(500, 3)
    wo, wi = (
        normalize(torch.randn(500, 3, generator=generator, dtype=torch.float64)) for _ in "vl"
    )
    wo, wi = (torch.cat([d[:, :2], d[:, 2:].abs().clamp_min(0.02)], -1) for d in (wo, wi))
    wo, wi = normalize(wo), normalize(wi)
    wh = normalize(wo + wi)
    f0 = torch.rand(500, 3, generator=generator, dtype=torch.float64)
    alpha = torch.rand(500, 1, generator=generator, dtype=torch.float64).clamp_min(0.01)
    there, back = (
        specular_brdf(dot(z, a), dot(z, b), dot(z, wh), dot(a, wh), f0, alpha)
        for a, b in ((wo, wi), (wi, wo))
    )
    torch.testing.assert_close(there, back, rtol=1e-9, atol=0)
    bases = []
    for seen in (0.9, 0.1):
        scale, bias = integrate_split_sum(torch.tensor([[seen]]).double(), torch.tensor([[0.3]]))
        bases.append(float(1.0 - 0.04 * scale - bias))
    assert bases[0] - bases[1] > 0.2


def test_square_points_of_a_texel_stay_in_it():
    light = SampledLight.build(sunny(8))
    corners = torch.tensor(np.array([[0.0, 0.0], [1.0 - 1e-12, 1.0 - 1e-12]]))
    drawn = light.sample(corners)
    assert bool(torch.isfinite(drawn).all())
    square = octahedral_from_direction(drawn)
    torch.testing.assert_close(direction_from_octahedral(square), drawn)
