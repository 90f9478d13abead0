import math

import pytest
import torch

from svim3d.numerics import dot, normalize, reflect
from svim3d.shading.directional_albedo import (
    integrate_split_sum,
    lobe_albedos,
    lookup_split_sum,
    split_sum_table,
)
from svim3d.shading.metallic_roughness import diffuse_albedo, specular_f0
from svim3d.shading.microfacet import (
    alpha_from_roughness,
    distribution_ggx,
    fresnel_schlick,
    masking_shadowing,
    sample_visible_normal,
    smith_lambda,
    visible_normal_density,
)
from svim3d.shading.monte_carlo import specular_brdf


def column(*values: float) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)[:, None]


@pytest.mark.parametrize("alpha", [0.05, 0.3, 1.0])
def test_distribution_projects_to_unit_area(alpha):
    # The microfacets of a unit of surface cover it: the integral of D(h) n.h is one.
    z = torch.linspace(0.0, 1.0, 400_001, dtype=torch.float64)
    density = distribution_ggx(z[:, None], torch.tensor(alpha, dtype=torch.float64).view(1, 1))
    integral = torch.trapezoid(2 * math.pi * density[:, 0] * z, z)
    assert float(integral) == pytest.approx(1.0, abs=1e-4)


@pytest.mark.parametrize("alpha", [0.1, 0.6])
@pytest.mark.parametrize("cosine", [0.2, 0.9])
def test_masking_leaves_the_projected_area(alpha, cosine):
    # The visible area of microfacets is the surface's own: int G1 D <v.h> dh = n.v.
    n = 1500
    z = (torch.arange(n, dtype=torch.float64) + 0.5) / n
    phi = (torch.arange(n, dtype=torch.float64) + 0.5) / n * 2 * math.pi
    z, phi = torch.meshgrid(z, phi, indexing="ij")
    sine = (1 - z * z).sqrt()
    wh = torch.stack([sine * phi.cos(), sine * phi.sin(), z], -1)
    wo = torch.tensor([math.sqrt(1 - cosine**2), 0.0, cosine], dtype=torch.float64)
    width = torch.tensor([[alpha]], dtype=torch.float64)
    g1 = 1.0 / (1.0 + smith_lambda(torch.tensor([[cosine]], dtype=torch.float64), width))
    facing = (wh @ wo).clamp_min(0.0)[..., None]
    visible = (g1 * distribution_ggx(z[..., None], width) * facing).sum() * 2 * math.pi / n**2
    assert float(visible) == pytest.approx(cosine, rel=2e-3)


def test_brdf_is_reciprocal():
    generator = torch.Generator().manual_seed(0)
    wo, wi = (
        normalize(torch.rand(100, 3, generator=generator, dtype=torch.float64)) for _ in range(2)
    )
    wh, alpha = normalize(wo + wi), torch.rand(100, 1, generator=generator, dtype=torch.float64)
    f0 = torch.rand(100, 3, generator=generator, dtype=torch.float64)
    one = specular_brdf(wo[:, 2:], wi[:, 2:], wh[:, 2:], dot(wo, wh), f0, alpha)
    other = specular_brdf(wi[:, 2:], wo[:, 2:], wh[:, 2:], dot(wi, wh), f0, alpha)
    torch.testing.assert_close(one, other)


def test_masking_shadowing_limits():
    full = masking_shadowing(column(1.0), column(1.0), column(0.7))
    assert float(full) == pytest.approx(1.0)
    assert float(masking_shadowing(column(1e-4), column(0.5), column(0.7))) < 1e-3


def test_fresnel_ends():
    f0 = torch.tensor([[0.04, 0.5, 1.0]])
    torch.testing.assert_close(fresnel_schlick(f0, torch.ones(1, 1)), f0)
    torch.testing.assert_close(fresnel_schlick(f0, torch.zeros(1, 1)), torch.ones(1, 3))


@pytest.mark.parametrize("cosine", [0.15, 0.95])
@pytest.mark.parametrize("alpha", [0.15, 0.8])
def test_visible_normals_follow_their_density(cosine, alpha):
    # Chi-square over cells of the reflected direction's hemisphere: expected by quadrature.
    count, rows, columns = 200_000, 8, 12
    generator = torch.Generator().manual_seed(1)
    u = torch.rand(count, 2, generator=generator, dtype=torch.float64)
    wo = torch.tensor([[math.sqrt(1 - cosine**2), 0.0, cosine]], dtype=torch.float64)
    width = torch.full((1, 1), alpha, dtype=torch.float64)
    wi = reflect(wo.expand(count, 3), sample_visible_normal(wo.expand(count, 3), width, u))
    above = wi[:, 2] > 0
    row = (wi[above, 2] * rows).long().clamp_max(rows - 1)
    azimuth = torch.atan2(wi[above, 1], wi[above, 0]) / (2 * math.pi) + 0.5
    cell = row * columns + (azimuth * columns).long().clamp_max(columns - 1)
    observed = torch.bincount(cell, minlength=rows * columns).double()
    fine = 60
    z = (torch.arange(rows * fine, dtype=torch.float64) + 0.5) / (rows * fine)
    phi = ((torch.arange(columns * fine, dtype=torch.float64) + 0.5) / (columns * fine) - 0.5) * (
        2 * math.pi
    )
    z, phi = torch.meshgrid(z, phi, indexing="ij")
    sine = (1 - z * z).sqrt()
    direction = torch.stack([sine * phi.cos(), sine * phi.sin(), z], -1)
    wh = normalize(direction + wo)
    n_dot_wo = torch.full_like(z, cosine)[..., None]
    density = visible_normal_density(n_dot_wo, wh[..., 2:], width)[..., 0]
    expected = density.view(rows, fine, columns, fine).sum((1, 3)).view(-1)
    expected *= 2 * math.pi / (rows * fine * columns * fine) * count
    enough = expected > 20
    statistic = ((observed - expected)[enough] ** 2 / expected[enough]).sum()
    freedom = int(enough.sum())
    assert float(statistic) < freedom + 4.0 * math.sqrt(2.0 * freedom)


@pytest.mark.parametrize(
    ("n_dot_v", "roughness", "scale", "bias"),
    [
        (0.502, 0.502, 0.8343, 0.0219),
        (0.900, 0.502, 0.9057, 0.0003),
        (0.252, 0.900, 0.6429, 0.0154),
        (0.0996, 0.0996, 0.4145, 0.5798),
    ],
)
def test_table_agrees_with_nvdiffrec(n_dot_v, roughness, scale, bias):
    for function in (integrate_split_sum, lookup_split_sum):
        found_scale, found_bias = function(column(n_dot_v), column(roughness))
        assert float(found_scale) == pytest.approx(scale, abs=1e-3)
        assert float(found_bias) == pytest.approx(bias, abs=1e-3)


def test_albedo_of_the_roughest_surface_seen_from_above():
    # GGX of alpha 1 at normal incidence reflects 1 - ln 2 (closed form).
    scale, bias = integrate_split_sum(column(1.0), column(1.0))
    assert float(scale + bias) == pytest.approx(1.0 - math.log(2.0), abs=3e-4)


def test_mirror_reflects_by_fresnel_alone():
    cosine = column(0.1, 0.4, 0.8)
    scale, bias = integrate_split_sum(cosine, torch.zeros_like(cosine))
    weight = (1.0 - cosine) ** 5
    torch.testing.assert_close(scale, 1.0 - weight, rtol=0, atol=2e-3)
    torch.testing.assert_close(bias, weight, rtol=0, atol=2e-3)


def test_lookup_interpolates_the_table_well():
    generator = torch.Generator().manual_seed(0)
    n_dot_v = 0.01 + 0.99 * torch.rand(500, 1, generator=generator, dtype=torch.float64)
    roughness = 0.05 + 0.95 * torch.rand(500, 1, generator=generator, dtype=torch.float64)
    for found, true in zip(
        lookup_split_sum(n_dot_v, roughness), integrate_split_sum(n_dot_v, roughness), strict=True
    ):
        assert float((found - true).abs().max()) < 5e-3
        assert float((found - true).abs().mean()) < 3e-4


@pytest.mark.parametrize("multiple_scattering", [True, "scaled"])
def test_white_furnace_is_exact_for_every_roughness_and_angle(multiple_scattering):
    axis = torch.linspace(0.0, 1.0, 40, dtype=torch.float64)
    roughness, n_dot_v = (t.reshape(-1, 1) for t in torch.meshgrid(axis, axis, indexing="ij"))
    white = torch.ones(len(roughness), 3, dtype=torch.float64)
    single, multiple = lobe_albedos(
        white, n_dot_v, roughness, multiple_scattering=multiple_scattering
    )
    torch.testing.assert_close(single + multiple, white, rtol=0, atol=1e-12)


def test_no_material_makes_energy():
    table = split_sum_table(torch.device("cpu"), torch.float64)
    assert float(table.min()) >= 0.0
    assert float(table[..., :2].sum(-1).max()) <= 1.0 + 1e-4
    generator = torch.Generator().manual_seed(0)
    roughness, n_dot_v, metallic = torch.rand(3, 2000, 1, generator=generator, dtype=torch.float64)
    basecolor = torch.rand(2000, 3, generator=generator, dtype=torch.float64)
    for flag in (False, True, "scaled"):
        single, multiple = lobe_albedos(
            specular_f0(basecolor, metallic), n_dot_v, roughness, multiple_scattering=flag
        )
        base = diffuse_albedo(basecolor, metallic) * (1.0 - single - multiple)
        assert float((single + multiple + base).max()) <= 1.0 + 1e-9
        assert float(base.min()) >= 0.0


def test_alpha_is_floored_where_the_distribution_would_be_infinite():
    assert float(alpha_from_roughness(torch.zeros(1, 1))) > 0.0
    assert float(alpha_from_roughness(torch.full((1, 1), 0.5))) == 0.25
