"""Drawing an orbit of a photo: repeatable, placed in the world, chosen among samples."""

from dataclasses import replace

import pytest
import torch
from drawn_sphere import DISTANCE, drawn_cameras, drawn_sphere, sphere_photo
from pydantic import ValidationError
from tiny_model import TINY, tiny_model, write_tiny_model

from stages import orbit_drawing
from stages.artifacts import MaterialViews
from stages.errors import InputError
from stages.generation import run
from stages.orbit_drawing import camera_path, draw_samples, place_cameras
from stages.settings.generation import GenerationConfig
from svim3d.color import linear_from_srgb
from svim3d.diffusion.model import MaterialDiffusion
from svim3d.io.model_folder import BUNDLED
from svim3d.render.view_findings import SOFT_MASKS, view_findings

PHOTO = sphere_photo(48)
SIZE, VIEWS = 16, 5


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write_tiny_model(tmp_path_factory.mktemp("model"))


@pytest.fixture
def perfect(monkeypatch):
    """The tiny model decodes whatever it draws to the sphere, a little brighter or darker."""

    def decode(self, latents, sampling, conditioning):
        sphere = drawn_sphere(VIEWS, SIZE)
        # Far digits of the latents: as good as random, and the same for the same seed.
        shade = 1.0 - 0.3 * (1000.0 * latents[0, 0, 0, 0]).remainder(1.0)
        return replace(sphere, basecolor=sphere.basecolor * shade)

    monkeypatch.setattr(MaterialDiffusion, "decode", decode)


@pytest.fixture
def draw(folder, make_context, tmp_path):
    """`draw(seed, **settings)`: the stage's views of the photo."""

    def draw(seed=0, **settings) -> MaterialViews:
        context = make_context("generation", seed=seed)
        config = GenerationConfig(model=folder, **{"photo_view_size": SIZE} | settings)
        return run(tmp_path, PHOTO, config=config, ctx=context)

    return draw


def payload(views, folder):
    folder.mkdir()
    views.save(folder)
    return {file.name: file.read_bytes() for file in sorted(folder.iterdir())}


def orbits(make_context, seed=0, samples=1):
    config = GenerationConfig(samples=samples)
    context = make_context("generation", seed=seed)
    return draw_samples(tiny_model(), PHOTO, camera_path(config, VIEWS), config, context)


def equal(one, two):
    return all(torch.equal(image, getattr(two, name)) for name, image in vars(one).items())


def test_same_seed_same_orbit_and_sample_0_does_not_depend_on_their_number(make_context):
    first = orbits(make_context)
    assert equal(first[0], orbits(make_context)[0])
    three = orbits(make_context, samples=3)
    assert equal(first[0], three[0])
    assert not equal(three[0], three[1]) and not equal(three[1], three[2])
    assert not equal(first[0], orbits(make_context, seed=1)[0])


def test_same_seed_gives_byte_equal_artifacts(perfect, draw, tmp_path):
    first = payload(draw(), tmp_path / "first")
    assert {"orbit.json", "000.exr", "views.png"} <= set(first)
    assert payload(draw(), tmp_path / "again") == first
    assert payload(draw(seed=1), tmp_path / "other") != first


def test_views_stand_in_the_world_and_reload_to_the_same_bits(perfect, draw, tmp_path):
    views = draw()
    truth = drawn_cameras(VIEWS, SIZE)
    assert views.reference == VIEWS - 1
    # The sphere is 14 pixels wide: its size is known to half a pixel on each side.
    assert float(views.cameras.positions.norm(dim=1)[0]) == pytest.approx(DISTANCE, rel=0.08)
    torch.testing.assert_close(views.cameras.c2w[:, :3, :3], truth.c2w[:, :3, :3])
    inside = views.mask[..., 0] == 1.0
    # A sphere's normals point from its centre: the pixels' rays meet them from outside.
    for view in range(VIEWS):
        towards = views.cameras.c2w[view, :3, 2]
        assert float((views.normal_world[view][inside[view]] @ towards).min()) > 0.0
    assert views.depth is None
    views.save(tmp_path / "saved")
    again = MaterialViews.load(tmp_path / "saved")
    for name in ("radiance", "mask", "basecolor", "roughness", "metallic", "normal_world"):
        assert torch.equal(getattr(again, name), getattr(views, name)), name


def test_the_photo_tells_of_its_own_view_only(perfect, draw):
    kept, drawn = draw(), draw(keep_photo=False)
    for name in ("radiance", "mask", "basecolor", "roughness", "metallic", "normal_world"):
        assert torch.equal(getattr(kept, name)[:-1], getattr(drawn, name)[:-1]), name
    # 48 pixels to 16: in the middle the photo's own linear colours, averaged.
    photo = (linear_from_srgb(PHOTO.rgb) * PHOTO.mask).view(16, 3, 16, 3, 3).mean((1, 3))
    middle = slice(5, 11)
    torch.testing.assert_close(
        kept.radiance[-1, middle, middle], photo[middle, middle], rtol=0, atol=0.03
    )
    assert float((drawn.radiance[-1] - kept.radiance[-1]).abs().max()) > 0.1
    torch.testing.assert_close(
        kept.mask[-1], PHOTO.mask.view(16, 3, 16, 3, 1).mean((1, 3)), rtol=0, atol=0.155
    )


def test_the_photo_counts_as_often_as_asked(perfect, draw, tmp_path):
    views = draw(photo_weight=5.0)
    assert views.confidence is not None
    assert bool((views.confidence[-1] == 5.0).all() and (views.confidence[:-1] == 1.0).all())
    views.save(tmp_path / "saved")
    assert torch.equal(MaterialViews.load(tmp_path / "saved").confidence, views.confidence)
    assert draw(photo_weight=1.0).confidence is None
    assert draw(keep_photo=False).confidence is None


def test_views_of_a_small_model_are_enlarged_for_the_photo(perfect, draw):
    views = draw(photo_view_size=40)
    assert views.mask.shape == (VIEWS, 40, 40, 1)
    assert (views.cameras.height, views.cameras.width) == (40, 40)
    assert draw(photo_view_size=40, keep_photo=False).mask.shape[1] == SIZE


def test_nobody_is_told_to_sharpen_masks_that_were_drawn(perfect, draw, make_context):
    views = draw(photo_view_size=10 * SIZE)
    images = {name: image for name, image in vars(views).items() if torch.is_tensor(image)}
    assert SOFT_MASKS in dict(view_findings(views.cameras, images))
    assert SOFT_MASKS not in {event["kind"] for event in make_context("generation").events}


def test_of_several_samples_one_is_kept_with_its_confidence(perfect, draw, make_context, tmp_path):
    views = draw(samples=3, keep_photo=False)
    assert views.confidence is not None
    outside = views.mask == 0.0
    assert bool((views.confidence[outside] == 1.0).all())
    assert 0.5 < float(views.confidence[views.mask == 1.0].min()) < 1.0
    assert "sample_chosen" in [event["kind"] for event in make_context("generation").events]
    views.save(tmp_path / "saved")
    assert torch.equal(MaterialViews.load(tmp_path / "saved").confidence, views.confidence)
    # The confidence of half-float files is exact: what is averaged down later is the same.
    assert views.premultiplied(8)[1]["confidence"].shape == (VIEWS, 8, 8, 1)


def test_views_without_an_object_are_refused_with_advice(draw, monkeypatch):
    def decode(self, latents, sampling, conditioning):
        sphere = drawn_sphere(VIEWS, SIZE)
        return replace(sphere, mask=torch.ones_like(sphere.mask))

    monkeypatch.setattr(MaterialDiffusion, "decode", decode)
    with pytest.raises(InputError, match=r"cannot be used .*try another --seed"):
        draw()


def test_numbers_that_are_none_are_refused_with_advice(draw, monkeypatch):
    monkeypatch.setattr(
        MaterialDiffusion, "draw", lambda *_: torch.full((VIEWS, 8, 4, 4), torch.nan)
    )
    with pytest.raises(InputError, match=r"not finite; try --set generation.dtype=float32"):
        draw()


def test_a_model_of_colour_alone_is_refused_with_advice(draw, monkeypatch):
    colour = replace(TINY, groups=("rgb",))
    alone = MaterialDiffusion(colour, *tiny_model().parts.values())
    monkeypatch.setattr(orbit_drawing, "read_model", lambda *_: alone)
    with pytest.raises(InputError, match=r"has rgb alone; convert it with --groups 4"):
        draw()


@pytest.mark.parametrize(
    ("settings", "grows_by"),
    [
        ({}, "index"),
        ({"path": "list", "angles": [(0, 90), (0, 180), (0, 0)]}, "azimuth"),
        ({"path": "list", "angles": [(0, 90), (0, 180), (0, 0)], "guidance_by": "index"}, "index"),
    ],
)
def test_guidance_grows_as_the_cameras_ask(make_context, monkeypatch, settings, grows_by):
    used = []
    plain = MaterialDiffusion.guidance

    def guidance(self, conditioning, sampling):
        used.append(sampling.guidance_by)
        return plain(self, conditioning, sampling)

    monkeypatch.setattr(MaterialDiffusion, "guidance", guidance)
    config = GenerationConfig(sampler_steps=1, **settings)
    angles = camera_path(config, VIEWS)
    draw_samples(tiny_model(), PHOTO, angles, config, make_context("generation"))
    assert used == [grows_by]


def test_contradicting_silhouettes_bring_the_cameras_closer():
    sphere = drawn_sphere(VIEWS, SIZE)
    wide = sphere.mask.clone()
    wide[:, 6:10, :] = 1.0  # a bar across each view: no object of the height of these looks so
    cameras = place_cameras(replace(sphere, mask=wide), ANGLES, 33.8)
    bar = 1.0 / (2.0 * 16 / 2 / cameras.focal_px)
    assert float(cameras.positions[0].norm()) < 1.05 * bar


ANGLES = camera_path(GenerationConfig(), VIEWS)


def test_camera_paths():
    assert [e for e, _ in ANGLES] == [10.0] * 5 and ANGLES[-1][1] == 0.0
    sine = camera_path(GenerationConfig(path="sine", swing_deg=15.0), 21)
    assert max(e for e, _ in sine) > 24.0 and sine[-1] == (10.0, 0.0)
    listed = GenerationConfig(path="list", angles=[(5, -90), (40, 90), (10, 360)])
    assert camera_path(listed, 21) == [(5.0, 270.0), (40.0, 90.0), (10.0, 0.0)]


@pytest.mark.parametrize(
    ("settings", "complaint"),
    [
        ({"path": "list"}, "path list and angles belong together"),
        ({"angles": [(0, 90), (0, 180), (0, 0)]}, "path list and angles belong together"),
        ({"path": "list", "angles": [(0, 90), (0, 180), (0, 270)]}, "last stands at azimuth 0"),
        ({"path": "list", "angles": [(0, 90), (0, 0)]}, "at least 3 cameras"),
        ({"guidance_interval": (5.0, 0.3)}, "a smaller and a larger noise level"),
        ({"samples": 0}, "greater than or equal to 1"),
    ],
)
def test_impossible_drawings_are_refused(settings, complaint):
    with pytest.raises(ValidationError, match=complaint):
        GenerationConfig(**settings)


def test_the_weights_of_a_model_are_part_of_the_settings(folder, tmp_path):
    first = GenerationConfig(model=folder)
    assert {"model/model.json", "model/unet.safetensors"} <= set(first.digests)
    assert GenerationConfig(**first.model_dump()) == first
    other = write_tiny_model(tmp_path / "other", seed=1)
    assert GenerationConfig(model=other).digests != first.digests


def test_the_bundled_model_is_digested_and_read_from_one_place():
    assert GenerationConfig.bundled["model"].parts[-2:] == tuple(BUNDLED.split("/"))
