import hashlib
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from sphere_orbit import sphere_cameras, sphere_images
from spoilt_views import spoilt, trusted, warned

from stages.artifacts import EnvironmentLight, MaterialViews
from stages.env_preopt import ENV_PREOPT
from stages.errors import InputError
from stages.settings.env_preopt import EnvPreoptConfig
from svim3d.io.exr import read_rgb
from svim3d.numerics import normalize
from svim3d.shading.environment import blurred_latlong, latlong_from_octahedral
from svim3d.shading.octahedral import texel_directions
from svim3d.shading.prefilter import PyramidOperator
from svim3d.shading.split_sum import shade

TINY = EnvPreoptConfig(size=16, steps=60, max_pixels=2000, learning_rate=0.3)


def smooth_environment(size: int = 16) -> torch.Tensor:
    """A warm lamp in a dim blue room."""
    d = texel_directions(size)
    lamp = torch.exp(8.0 * (d @ normalize(torch.tensor([0.5, 0.7, 0.5])) - 1.0))[..., None]
    return torch.tensor([0.2, 0.25, 0.3]) + lamp * torch.tensor([4.0, 3.0, 2.0])


def sphere_views(environment: torch.Tensor, *, roughness: float, size: int = 24) -> MaterialViews:
    """A gold sphere seen from four sides, shaded by the library without multiple scattering."""
    cameras = sphere_cameras(4, size)
    images = sphere_images(cameras)
    mask = images["mask"]
    images["normal_world"] = normalize(images["normal_world"])
    images["roughness"] = roughness * mask
    images["metallic"] = mask
    images["basecolor"] = torch.tensor([0.9, 0.8, 0.6]) * mask
    wo = torch.stack([-cameras.rays(v)[1] for v in range(4)])
    names = ("basecolor", "roughness", "metallic")
    materials = [images[name].reshape(-1, images[name].shape[-1]) for name in names]
    pyramid = PyramidOperator.build(environment.shape[0], "exact")(environment)
    shading = shade(
        images["normal_world"].reshape(-1, 3),
        wo.reshape(-1, 3),
        *materials,
        pyramid,
        multiple_scattering=False,
    )
    images["radiance"] = shading.radiance.view_as(images["basecolor"]) * mask
    return MaterialViews(cameras=cameras, reference=3, **images)


def blurred_error(found: torch.Tensor, truth: torch.Tensor) -> float:
    blurred, expected = (
        blurred_latlong(latlong_from_octahedral(m, height=32), height=16) for m in (found, truth)
    )
    return float((blurred - expected).abs().sum() / expected.sum())


def test_recovers_a_known_environment(make_context):
    truth = smooth_environment()
    views = sphere_views(truth, roughness=0.2)
    light = ENV_PREOPT.run(views, config=TINY, ctx=make_context("env_preopt"))
    assert light.radiance.shape == (16, 16, 3)
    assert float(light.radiance.min()) > 0.0
    flat = truth.mean((0, 1)).expand_as(truth)
    assert blurred_error(flat, truth) > 0.5
    assert blurred_error(light.radiance, truth) < 0.1


def test_clipped_highlights_do_not_dim_the_light(make_context):
    truth = smooth_environment()
    views = sphere_views(truth, roughness=0.2)
    level = float(views.radiance.max()) / 2.0
    clipped = replace(views, radiance=views.radiance.clamp_max(level))
    light = ENV_PREOPT.run(clipped, config=TINY, ctx=make_context("env_preopt"))
    # Nothing says how bright the lamp is, but its surroundings must stay right.
    dim = truth.amax(-1) < 0.5
    ratio = light.radiance[dim].mean() / truth[dim].mean()
    assert float(ratio) == pytest.approx(1.0, abs=0.15)


def test_few_outliers_do_not_matter(make_context):
    truth = smooth_environment()
    views = sphere_views(truth, roughness=0.2)
    spoilt = views.radiance.clone()
    generator = torch.Generator().manual_seed(0)
    bad = torch.rand(views.mask.shape, generator=generator) < 0.05
    spoilt = torch.where(bad, 0.02 * spoilt, spoilt)
    spoilt[0, 12, 12] = float("nan")
    views = replace(views, radiance=spoilt)
    light = ENV_PREOPT.run(views, config=TINY, ctx=make_context("env_preopt"))
    assert blurred_error(light.radiance, truth) < 0.15


def artifact_digest(light: EnvironmentLight, folder: Path) -> str:
    folder.mkdir()
    light.save(folder)
    return hashlib.sha256((folder / "environment_octahedral.exr").read_bytes()).hexdigest()


def test_same_seed_gives_same_bytes_and_another_draw_other_pixels(make_context, tmp_path):
    views = sphere_views(smooth_environment(), roughness=0.3)
    config = TINY.model_copy(update={"steps": 8, "max_pixels": 200})
    digests = [
        artifact_digest(
            ENV_PREOPT.run(views, config=config, ctx=make_context(f"env_{name}", seed=seed)),
            tmp_path / name,
        )
        for name, seed in (("a", 0), ("b", 1))
    ]
    again = artifact_digest(
        ENV_PREOPT.run(views, config=config, ctx=make_context("env_a")), tmp_path / "again"
    )
    assert again == digests[0]
    assert digests[0] != digests[1]


def test_light_counts_each_pixel_by_its_confidence(make_context):
    config = TINY.model_copy(update={"steps": 4, "max_pixels": 100_000})
    views = sphere_views(smooth_environment(), roughness=0.2)

    def light(shown):
        return ENV_PREOPT.run(shown, config=config, ctx=make_context("env_preopt")).radiance

    assert torch.equal(light(trusted(views)), light(views))
    assert torch.equal(light(spoilt(views)), light(warned(views)))
    halved = replace(views, confidence=warned(views).confidence * 0.5 + 0.5)
    assert not torch.equal(light(halved), light(views))


@pytest.mark.parametrize("light", ["map", "spherical_gaussians"])
def test_resumed_run_ends_with_the_same_bytes(make_context, light):
    views = sphere_views(smooth_environment(), roughness=0.3)
    config = TINY.model_copy(update={"steps": 12, "light": light})
    whole = ENV_PREOPT.run(views, config=config, ctx=make_context("env_preopt"))

    class Killed(Exception):
        pass

    broken = make_context("env_preopt")
    broken.checkpoints.due = lambda: True
    report = broken.report

    def die_at_seven(step, total, terms):
        if step == 7:
            raise Killed
        report(step, total, terms)

    broken.report = die_at_seven
    with pytest.raises(Killed):
        ENV_PREOPT.run(views, config=config, ctx=broken)
    resumed_context = make_context("env_preopt")
    saved = resumed_context.checkpoints.load()
    assert saved is not None
    assert saved[0] == 6
    resumed = ENV_PREOPT.run(views, config=config, ctx=resumed_context)
    assert torch.equal(resumed.radiance, whole.radiance)


LOBED = TINY.model_copy(update={"light": "spherical_gaussians"})


def test_spherical_gaussians_find_a_white_lamp(make_context):
    truth = smooth_environment().mean(-1, keepdim=True).repeat(1, 1, 3)
    views = sphere_views(truth, roughness=0.2)
    light = ENV_PREOPT.run(views, config=LOBED, ctx=make_context("env_preopt")).radiance
    flat = truth.mean((0, 1)).expand_as(truth)
    assert blurred_error(flat, truth) > 0.5
    assert blurred_error(light, truth) < 0.15
    # The lamp is where it was.
    assert int(light[..., 0].argmax()) == int(truth[..., 0].argmax())


def test_spherical_gaussians_stay_white_under_a_coloured_light(make_context):
    views = sphere_views(smooth_environment(), roughness=0.2)
    light = ENV_PREOPT.run(views, config=LOBED, ctx=make_context("env_preopt")).radiance
    assert torch.equal(light, light[..., :1].expand(-1, -1, 3))


def test_views_without_a_usable_pixel_are_refused(make_context):
    views = sphere_views(smooth_environment(), roughness=0.3)
    empty = replace(views, mask=torch.zeros_like(views.mask))
    with pytest.raises(InputError, match="found none in 4 views"):
        ENV_PREOPT.run(empty, config=TINY, ctx=make_context("env_preopt"))


def test_paper_prefilter_runs_too(make_context):
    truth = smooth_environment()
    config = TINY.model_copy(update={"prefilter": "sampled", "steps": 20})
    views = sphere_views(truth, roughness=0.1)
    light = ENV_PREOPT.run(views, config=config, ctx=make_context("env_preopt"))
    assert blurred_error(light.radiance, truth) < 0.5


@pytest.mark.slow
def test_recovers_the_light_of_path_traced_spheres(make_context, data):
    folder = data / "orbits" / "spheres"
    views = MaterialViews.load(folder)
    light = ENV_PREOPT.run(views, config=EnvPreoptConfig(), ctx=make_context("env_preopt"))
    truth = blurred_latlong(torch.from_numpy(read_rgb(folder / "env_A.exr")), height=16)
    found = blurred_latlong(latlong_from_octahedral(light.radiance, height=128), height=16)
    assert float((found - truth).abs().sum() / truth.sum()) < 0.25
