"""Materials as functions of space: noise, patterns, layers, good and low quality."""

from dataclasses import replace

import pytest
import torch

from svim3d.color import srgb_from_linear
from svim3d.synthesis.dice import Dice
from svim3d.synthesis.materials import (
    Layer,
    SolidMaterial,
    random_material,
    with_decal,
)
from svim3d.synthesis.matter import Matter, from_hue, random_dielectric, random_metal, srgb
from svim3d.synthesis.noise import fractal_noise, fractal_noise_plainly
from svim3d.synthesis.objects import (
    EXPORTED,
    LOW_QUALITY_SHARE,
    good_materials,
    low_quality_materials,
    random_object,
)
from svim3d.synthesis.patterns import Bands, Checks, Decal, Half, Settled


def dice(seed):
    return Dice(torch.Generator().manual_seed(seed))


def surface(count, seed=0):
    """Points in the object's cube and unit normals."""
    generator = torch.Generator().manual_seed(seed)
    points = torch.rand(count, 3, generator=generator) - 0.5
    normals = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=1)
    return points, normals


def test_compiled_noise_is_its_twin():
    points = 20.0 * surface(4000)[0]
    for octaves, seed in ((1, 0), (4, 7), (3, 1 << 20)):
        compiled = fractal_noise(points, octaves=octaves, seed=seed)
        # Both compute in double precision; only the last rounding to float may differ.
        twin = fractal_noise_plainly(points, octaves=octaves, seed=seed)
        torch.testing.assert_close(compiled, twin, atol=1e-7, rtol=0.0)


def test_noise_is_centred_bounded_and_differs_by_seed():
    points = 50.0 * surface(20000)[0]
    first = fractal_noise(points, octaves=3, seed=1)
    second = fractal_noise(points, octaves=3, seed=2)
    assert float(first.min()) >= 0.0 and float(first.max()) <= 1.0
    # 50^3 cells: the mean over 20 000 points deviates by about 0.001.
    assert float(first.mean()) == pytest.approx(0.5, abs=0.01)
    correlation = torch.corrcoef(torch.stack([first, second]))[0, 1]
    assert abs(float(correlation)) < 0.05


def test_noise_is_continuous_across_cells():
    at = torch.tensor([[3.0, 1.3, -2.0]])
    step = torch.tensor([[1e-4, 1e-4, 1e-4]])
    jump = fractal_noise(at + step, octaves=1, seed=0) - fractal_noise(at - step, octaves=1, seed=0)
    assert abs(float(jump)) < 1e-3


def test_bands_cover_their_share():
    points, normals = surface(20000)
    bands = Bands((0.0, 1.0, 0.0), 5.0, 0.0, 0.3, 0.05, 0.0, 0)
    assert float(bands(points, normals).mean()) == pytest.approx(0.3, abs=0.02)


def test_checks_cover_half():
    points, normals = surface(20000)
    unit = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    assert float(Checks(unit, 10.0, None)(points, normals).mean()) == pytest.approx(0.5, abs=0.02)


def test_half_covers_its_side_only():
    points, normals = surface(5000)
    cover = Half((1.0, 0.0, 0.0), 0.1, 0.0, 0.02, 0)(points, normals)[:, 0]
    assert bool((cover[points[:, 0] > 0.12] == 1.0).all())
    assert bool((cover[points[:, 0] < 0.08] == 0.0).all())


def test_a_decal_lies_on_the_side_that_faces_its_stencil():
    decal = Decal((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0), 0.2, "disc")
    points = torch.tensor([[0.5, 0.0, 0.0], [-0.5, 0.0, 0.0], [0.5, 0.3, 0.0], [0.4, 0.0, -0.1]])
    normals = torch.nn.functional.normalize(points, dim=1)
    assert decal(points, normals)[:, 0].tolist() == [1.0, 0.0, 0.0, 1.0]


def test_dust_settles_on_what_looks_up():
    points, _ = surface(2000)
    up, down = torch.tensor([[0.0, 1.0, 0.0]]), torch.tensor([[0.0, -1.0, 0.0]])
    dust = Settled((0.0, 1.0, 0.0), 0.5, 3)
    assert float(dust(points, up.expand(2000, 3)).min()) > 0.8
    assert float(dust(points, down.expand(2000, 3)).max()) == 0.0


def test_a_layer_changes_all_channels_together():
    steel, rust = Matter((0.6, 0.6, 0.6), 0.2, 1.0), Matter((0.3, 0.1, 0.05), 0.9, 0.0)
    material = SolidMaterial(steel, (Layer(rust, Half((1.0, 0.0, 0.0), 0.0, 0.0, 0.02, 0)),))
    points = torch.tensor([[-0.3, 0.0, 0.0], [0.3, 0.0, 0.0], [0.0, 0.0, 0.0]])
    rows = material(points, torch.nn.functional.normalize(points + 1e-3, dim=1))
    bare, rusty = (torch.tensor([*m.basecolor, m.roughness, m.metallic]) for m in (steel, rust))
    torch.testing.assert_close(rows[0], bare)
    torch.testing.assert_close(rows[1], rusty)
    torch.testing.assert_close(rows[2], 0.5 * (bare + rusty))


def test_colours_are_those_of_their_names():
    encoded = srgb_from_linear(torch.tensor(srgb("#804020"))) * 255.0
    torch.testing.assert_close(encoded, torch.tensor([128.0, 64.0, 32.0]), atol=1e-3, rtol=0.0)
    torch.testing.assert_close(torch.tensor(from_hue(0.0, 1.0, 1.0)), torch.tensor([1.0, 0.0, 0.0]))
    third = torch.tensor(from_hue(1.0 / 3.0, 1.0, 1.0))
    torch.testing.assert_close(third, torch.tensor([0.0, 1.0, 0.0]), atol=1e-5, rtol=0.0)


@pytest.mark.parametrize("seed", range(30))
def test_random_materials_are_physical(seed):
    d = dice(seed)
    rows = with_decal(random_material(d), d)(*surface(300))
    assert bool(torch.isfinite(rows).all())
    assert float(rows.min()) >= 0.0 and float(rows.max()) <= 1.0


@pytest.mark.parametrize("seed", range(9))
def test_low_quality_says_nothing_of_roughness_and_metal(seed):
    for material in low_quality_materials(dice(seed), 3):
        rows = material(*surface(200))
        assert bool((rows[:, 3] == EXPORTED.roughness).all())
        assert bool((rows[:, 4] == EXPORTED.metallic).all())


def told_by_colour(matters):
    """Share of the variance of roughness that the 20 nearest of other colours tell."""
    colours = srgb_from_linear(torch.tensor([m.basecolor for m in matters]))
    roughness = torch.tensor([m.roughness for m in matters])
    half = len(matters) // 2
    nearest = torch.cdist(colours[:half], colours[half:]).topk(20, largest=False).indices
    told, true = roughness[half:][nearest].mean(1), roughness[:half]
    return 1.0 - float((told - true).square().mean() / true.var())


@pytest.mark.parametrize("make", [random_dielectric, random_metal])
def test_the_look_of_stuff_tells_of_its_roughness(make):
    matters = [make(dice(seed)) for seed in range(1000)]
    roughness = torch.tensor([m.roughness for m in matters])
    # Known by colour in part, not wholly: both finishes are met in most colours.
    assert 0.1 < told_by_colour(matters) < 0.7
    assert float(roughness.min()) < 0.1 and float(roughness.max()) > 0.58
    # Where finish is drawn apart from colour, nothing is told.
    shuffled = roughness[torch.randperm(1000, generator=torch.Generator().manual_seed(0))]
    apart = [replace(m, roughness=float(r)) for m, r in zip(matters, shuffled, strict=True)]
    assert told_by_colour(apart) < 0.05


def test_good_materials_vary():
    rows = torch.cat([m(*surface(200)) for s in range(8) for m in good_materials(dice(s), 2)])
    assert float(rows[:, 3].std()) > 0.1
    assert float(rows[:, 4].std()) > 0.1


def test_the_flag_says_which_materials_an_object_got():
    flags = []
    for seed in range(24):
        thing = random_object(dice(seed))
        rows = torch.cat([material(*surface(50)) for material in thing.materials])
        exported = bool((rows[:, 3:] == torch.tensor([EXPORTED.roughness, 0.0])).all())
        assert exported == (thing.quality == "low")
        flags.append(thing.quality == "low")
    # Within three standard deviations of a binomial.
    spread = 3.0 * (24 * LOW_QUALITY_SHARE * (1.0 - LOW_QUALITY_SHARE)) ** 0.5
    assert abs(sum(flags) - 24 * LOW_QUALITY_SHARE) < spread
